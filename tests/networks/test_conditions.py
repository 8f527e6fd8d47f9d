"""Condition encoders: what is observed is read once a plan, by whatever network, learning or sampling."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.features import Feature
from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.agent.scenes import FEATURE, OBSERVED, scenes
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.closed_loop import sampled_plans
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import Loss
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.networks.conditions import CHOSEN, ENCODERS, EntityEncoder, PointEncoder, Sizes, condition_encoder
from ftl_lightning.networks.mlp import MLPDenoiser
from ftl_lightning.networks.temporal_unet import TemporalUNet
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.model_config import Prepared

STEPS = 6
OF_VECTORS = [name for name in ENCODERS if name != "points"]
"""Encoders that need no points of images."""


def model(denoiser: str, options: dict[str, Any], prediction: str = "epsilon", **observed: Feature) -> GenerativeModel:
    known: dict[str, Any] = {"denoiser": denoiser, "denoiser_args": options, "prediction": prediction, "diffusion_steps": 10}
    known |= {"horizon": 8, "state_dim": 13, "concept_dim": 6, "observed": {OBSERVED: FEATURE} | observed}
    config = DiffusionConfig(domain="agent", training_concepts=("a", "b"), encoder="none", **known)
    torch.manual_seed(0)
    limits = [Normalization(-torch.ones(count), torch.ones(count)) for count in (13, config.vector_dim)]
    return GenerativeModel(Prepared(config, load_domain("agent"), limits[0], torch.randn(3, 6), limits[1])).eval()


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[int]]:
    """Batch sizes with which each half of any encoder is called."""
    found: dict[str, list[int]] = {"observe": [], "attend": []}
    for kind in (condition_encoder(name, Sizes(4, 1, 2, {OBSERVED: FEATURE}), 8).__class__ for name in OF_VECTORS):
        for half in ("observe", "attend"):
            monkeypatch.setattr(kind, half, counted(getattr(kind, half), found[half]))
    return found


def counted(plain: Callable[..., Any], batches: list[int]) -> Callable[..., Any]:
    """A method that notes the length of its last argument."""

    def method(self: Any, *arguments: Any) -> Any:
        batches.append(len(arguments[-1]))
        return plain(self, *arguments)

    return method


NETWORKS = [
    ("MLPDenoiser", {"hidden_dim": 16, "depth": 2, "condition_dim": 8}, "epsilon"),
    ("TemporalUNet", {"width": 8, "multipliers": [1, 2]}, "epsilon"),
    ("TemporalUNet", {"width": 8, "multipliers": [1, 2], "broadcast": True}, "displacement"),
]


@pytest.mark.parametrize(("denoiser", "options", "prediction"), NETWORKS, ids=str)
@pytest.mark.parametrize("encoder", OF_VECTORS)
def test_what_is_observed_is_read_once_a_plan(
    denoiser: str, options: dict[str, Any], prediction: str, encoder: str, calls: dict[str, list[int]]
) -> None:
    net = model(denoiser, options | {"initial_encoder": encoder}, prediction)
    known = net.training_embeddings[:, None]
    compositions = [Composition(known, torch.ones(2)), Composition(known[:1], torch.ones(1))]
    seen = {OBSERVED: scenes("go to bowl", 6, 0)}
    draws = [generator("cpu", number) for number in range(2)]
    plans = net.sample(compositions, 3, Sampling("ddpm", STEPS, 0.5), draws, seen)
    assert plans.shape == (2, 3, 8, 13)
    assert calls["observe"] == [6]
    assert calls["attend"] == [3 * 6] * STEPS  # the empty concept and two components, at every step


def test_learning_reads_it_once_a_step_for_all_branches(calls: dict[str, list[int]]) -> None:
    net = model(*NETWORKS[0][:2])
    concepts = torch.randn(2, 3, 1, 6, requires_grad=True)
    draws = net.draws(4, 1.0, generator("cpu", 0))
    seen = {OBSERVED: scenes("go to bowl", 8, 0)}
    losses = net.losses(torch.zeros(8, 8, 13), seen, Composition(concepts, torch.ones(2, 3)), draws, Loss(kind="epsilon"))
    assert losses.shape == (2, 4)
    assert calls["observe"] == [8]
    assert calls["attend"] == [8, 3 * 8]
    losses.sum().backward()
    assert (concepts.grad.abs().amax(dim=-1) > 0).all()


def test_in_closed_loop_it_is_read_once_for_every_plan_that_is_made(calls: dict[str, list[int]]) -> None:
    net = model(*NETWORKS[0][:2])
    composition = Composition(net.training_embeddings[:, None], torch.ones(2))
    draws = [generator("cpu", number) for number in range(2)]
    make = sampled_plans(net, [composition] * 2, Sampling("ddim", STEPS, 0.5), draws)
    for made in (1, 2):
        make({OBSERVED: scenes("go to bowl", 2, made)}, [0, 1])
        assert calls["observe"] == [2] * made


def test_several_features_stand_one_after_another_and_keep_their_entities_and_state() -> None:
    sizes = Sizes(
        horizon=4,
        state_dim=2,
        concept_dim=6,
        observed={
            "first": Feature((3,)),
            "photo": Feature((3, 8, 8), "image"),
            "boxes": Feature((6,), entities=((0, 1, 2), (3, 4, 5)), attributes=(2,)),
            "pose": Feature((2,), state=(1, 0)),
        },
    )
    assert sizes.vector_dim == 11
    assert sizes.entities == ((3, 4, 5), (6, 7, 8))
    assert sizes.attributes == (2,)
    assert sizes.state_columns == (10, 9)
    encoder = EntityEncoder(sizes, 8)
    vector, concept = torch.randn(5, 11), torch.randn(5, 6)
    swapped = vector[:, [0, 1, 2, 6, 7, 8, 3, 4, 5, 9, 10]]
    out, other = (encoder.attend(encoder.observe(one), concept) for one in (vector, swapped))
    torch.testing.assert_close(out, other)
    assert not torch.allclose(out, encoder.attend(encoder.observe(vector[:, [1, 0, *range(2, 11)]]), concept), atol=1e-4)


def test_features_may_come_in_any_order_and_others_do_not_matter() -> None:
    net = model(*NETWORKS[0][:2], speed=Feature((2,)))
    world, speed = scenes("go to bowl", 3, 0), torch.rand(3, 2)
    expected = torch.cat((world, speed), dim=1)
    for seen in ({OBSERVED: world, "speed": speed}, {"other": torch.zeros(3), "speed": speed, OBSERVED: world}):
        found = net.vector(seen)
        torch.testing.assert_close(found, expected)
    with pytest.raises(UserError, match="key 'observed': expected the feature 'speed'"):
        net.vector({OBSERVED: world})
    expected = r"key 'observed/speed': expected float32 of shape \(2,\) a sample, found float32 of shape \(3,\)"
    with pytest.raises(UserError, match=expected):
        net.vector({OBSERVED: world, "speed": torch.zeros(3, 3)})


def of_points(plane: tuple[int, ...] = (0, 1), count: int = 3) -> Sizes:
    observed = {"photo": Feature((3, 8, 8), "image"), "pose": Feature((2,))}
    return Sizes(horizon=5, state_dim=3, concept_dim=6, observed=observed, image_dim=4 * count, plane=plane)


def scene(direction: float = 0.0) -> Tensor:
    """A measured vector and three points ``(1, 14)``, all turned by an angle."""
    xy = torch.tensor([[0.1, 0.2], [0.4, -0.1], [-0.3, 0.5]]) @ rotation(direction).T
    heights, seen = torch.tensor([0.01, 0.02, 0.05]), torch.tensor([3.0, 3.0, -3.0])
    return torch.cat((torch.tensor([0.3, 0.7]), xy.T.flatten(), heights, seen))[None]


def rotation(angle: float) -> Tensor:
    return torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


@pytest.mark.parametrize("angle", [0.4, 2.0, -3.0])
def test_plans_turn_with_the_points_that_a_concept_chooses(angle: float) -> None:
    torch.manual_seed(0)
    net = MLPDenoiser(of_points(), hidden_dim=16, depth=2, condition_dim=8, initial_encoder="points", initial_dim=8).eval()
    concept, x = torch.randn(1, 1, 6), torch.randn(1, 5, 3)
    turned_x = torch.cat((x[..., :2] @ rotation(angle).T, x[..., 2:]), dim=-1)
    here, there = (
        net(noisy, torch.tensor([3]), concept, torch.tensor([0]), net.observe(seen))
        for noisy, seen in ((x, scene()), (turned_x, scene(angle)))
    )
    expected = torch.cat((here[..., :2] @ rotation(angle).T, here[..., 2:]), dim=-1)
    torch.testing.assert_close(there, expected, atol=2e-4, rtol=0)
    # What a plan without a plane is, depends on the direction.
    plain = MLPDenoiser(of_points(()), hidden_dim=16, depth=2, condition_dim=8, initial_encoder="points", initial_dim=8).eval()
    before, after = (
        plain(x, torch.tensor([3]), concept, torch.tensor([0]), plain.observe(seen)) for seen in (scene(), scene(angle))
    )
    assert not torch.allclose(before, after, atol=1e-3)


def test_a_concept_decides_which_points_matter() -> None:
    torch.manual_seed(0)
    encoder = PointEncoder(of_points(), 8)
    with torch.no_grad():
        encoder.choice.bias.zero_()
        encoder.choice.weight.zero_()
        for choice in range(CHOSEN):  # the first number of a concept asks for point 0, the second for point 1
            for point in range(2):
                encoder.choice.weight[choice * 3 + point, point] = 100
    first, second = 6**0.5 * torch.eye(6)[:2, None]
    _, points = encoder.observe(scene())
    for concept, point in ((first, 0), (second, 1)):
        chosen = encoder._chosen(points, concept)
        assert chosen.shape == (1, CHOSEN, 4)
        torch.testing.assert_close(chosen[0, :, :3], points[0, [point] * CHOSEN, :3], atol=2e-3, rtol=0)
        assert torch.allclose(chosen[..., 3], points[0, point, 3], atol=1e-3)
    # What is not seen is no part of a mean: the third point hardly is, wherever it is said to be.
    asked = 6**0.5 * torch.eye(6)[2:3]
    elsewhere = scene()
    elsewhere[0, [4, 7]] += 5.0
    means = [encoder._chosen(encoder.observe(seen)[1], asked)[..., :2] for seen in (scene(), elsewhere)]
    torch.testing.assert_close(*means, atol=0.2, rtol=0)
    assert not torch.allclose(*means, atol=1e-4)


def test_points_have_to_be_read_of_images_and_a_name_that_is_no_encoder_is_refused() -> None:
    with pytest.raises(UserError, match=r"initial_encoder: expected flat, found points: the image encoder has no head of points"):
        condition_encoder("points", Sizes(4, 1, 2, {OBSERVED: FEATURE}), 8)
    with pytest.raises(UserError, match=r"denoiser_args.initial_encoder: expected points without a plane"):
        TemporalUNet(replace(of_points(), horizon=8), initial_encoder="points")
    with pytest.raises(UserError, match="initial_encoder: expected one of flat, joint, entities, set, points, found 'deep'"):
        condition_encoder("deep", Sizes(4, 1, 2, {OBSERVED: FEATURE}), 8)
