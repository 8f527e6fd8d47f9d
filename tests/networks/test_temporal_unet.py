"""The temporal U-Net and the condition encoders."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.features import Feature
from ftl_lightning.igm.diffusion import LOSSES, Prediction, add_noise, cosine_alpha_bar, loss_weights
from ftl_lightning.networks import MLPDenoiser, TemporalUNet
from ftl_lightning.networks.conditions import EntityEncoder, Sizes
from ftl_lightning.services.errors import UserError

ENTITIES = ((4, 5), (7, 8))
"""Columns of two entities among ten; 6 and 9 tell which is which and are constant in use."""
FEATURE = Feature((10,), entities=ENTITIES)
SIZES = Sizes(horizon=16, state_dim=5, concept_dim=7, observed={"world": FEATURE})


def inputs(batch: int = 3, horizon: int = 16) -> tuple[Tensor, ...]:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(batch, horizon, 5, generator=draw)
    initial = torch.randn(batch, 10, generator=draw)
    initial[:, [6, 9]] = 0
    t, index = torch.arange(batch), torch.tensor([0, 1, 0])[:batch]
    return x, t, torch.randn(2, 1, 7, generator=draw), index, initial


def noise(net: TemporalUNet | MLPDenoiser, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, initial: Tensor) -> Tensor:
    """What a network estimates, with what it reads of the observed vectors."""
    out: Tensor = net(x, t, concepts, index, net.observe(initial))
    return out


def unet(**options: object) -> TemporalUNet:
    torch.manual_seed(0)
    return TemporalUNet(SIZES, width=8, **options).eval()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options",
    [
        {"initial_encoder": "flat"},
        {"initial_encoder": "entities"},
        {"initial_encoder": "set"},
        {"film": True},
        {"clock": 4, "broadcast": True},
        {"skip": True, "smooth": 1},
    ],
    ids=str,
)
def test_shape_and_every_part_of_the_condition_matters(options: dict[str, object]) -> None:
    net = unet(**options)
    x, t, concepts, index, initial = inputs()
    out = noise(net, x, t, concepts, index, initial)
    assert out.shape == x.shape
    for changed in (
        noise(net, x + 1, t, concepts, index, initial),
        noise(net, x, t + 50, concepts, index, initial),
        noise(net, x, t, concepts + 1, index, initial),
        noise(net, x, t, concepts, 1 - index, initial),
        noise(net, x, t, concepts, index, initial + 1),
    ):
        assert not torch.allclose(out, changed, atol=1e-5)


def test_samples_do_not_see_each_other() -> None:
    net = unet()
    x, t, concepts, index, initial = inputs()
    whole = noise(net, x, t, concepts, index, initial)
    alone = noise(net, x[1:2], t[1:2], concepts, index[1:2], initial[1:2])
    torch.testing.assert_close(whole[1:2], alone)


def test_exchanging_entities_changes_nothing_unless_the_encoder_is_flat() -> None:
    x, t, concepts, index, initial = inputs()
    swapped = initial.clone()
    swapped[:, [4, 5, 7, 8]] = initial[:, [7, 8, 4, 5]]
    for encoder, same in (("entities", True), ("set", True), ("flat", False), ("joint", False)):
        net = unet(initial_encoder=encoder)
        out = noise(net, x, t, concepts, index, initial)
        assert torch.allclose(out, noise(net, x, t, concepts, index, swapped), atol=1e-6) == same
    mlp = MLPDenoiser(SIZES, initial_encoder="entities")
    torch.testing.assert_close(noise(mlp, x, t, concepts, index, initial), noise(mlp, x, t, concepts, index, swapped))


def test_a_gradient_reaches_the_concept_through_the_attention_alone() -> None:
    encoder = EntityEncoder(SIZES, 8)
    concept = torch.randn(3, 7, requires_grad=True)
    encoder.attend(encoder.observe(inputs()[-1]), concept).sum().backward()
    assert concept.grad.abs().max() > 0


def test_a_concept_tells_entities_apart_by_their_attributes() -> None:
    *_, initial = inputs()
    initial[:, 8] = initial[:, 5]  # the second of two columns is the same for both entities
    one, other = torch.randn(2, len(initial), 7)
    for attributes, same in (((1,), True), ((), False)):
        encoder = EntityEncoder(replace(SIZES, observed={"world": replace(FEATURE, attributes=attributes)}), 8)
        seen = encoder.observe(initial)
        assert torch.allclose(encoder.attend(seen, one), encoder.attend(seen, other), atol=1e-6) == same
        changed = initial.clone()
        changed[:, [5, 8]] += 1  # of both alike: it does not tell which, and attributes are not read
        assert torch.allclose(encoder.attend(seen, one), encoder.attend(encoder.observe(changed), one), atol=1e-6) == same


@pytest.mark.parametrize(
    ("sizes", "options", "expected"),
    [
        ({"horizon": 12}, {}, "horizon: expected a multiple of 8"),
        ({}, {"width": 12}, "width: expected a multiple of 8"),
        ({}, {"initial_encoder": "deep"}, "initial_encoder: expected one of flat, joint, entities, set"),
        ({"observed": {"world": Feature((10,))}}, {"initial_encoder": "entities"}, "expected flat"),
        ({"observed": {"world": Feature((10,))}}, {"initial_encoder": "set"}, "expected flat"),
    ],
)
def test_sizes_that_do_not_fit(sizes: dict[str, object], options: dict[str, object], expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        TemporalUNet(replace(SIZES, **sizes), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["v", "clean", "displacement"])
def test_what_the_network_puts_out_is_turned_into_noise(kind: str) -> None:
    alpha_bar = cosine_alpha_bar(100)
    clean, noise, t = torch.randn(4, 16, 5), torch.randn(4, 16, 5), torch.tensor([0, 30, 70, 95])
    signal, spread = alpha_bar[t].sqrt()[:, None, None], (1 - alpha_bar[t]).sqrt()[:, None, None]
    net = torch.nn.Module()
    initial, columns = torch.randn(4, 8), [1, 0, 3, 7, 5]
    right = {"v": signal * noise - spread * clean, "clean": clean, "displacement": clean - initial[:, None, columns]}[kind]
    net.forward = lambda *_: right  # type: ignore[assignment]
    net.observe = lambda vector: (vector,)  # type: ignore[assignment]
    prediction = Prediction(net, kind, 100, columns)
    found = prediction(
        add_noise(clean, noise, alpha_bar[t]), t, torch.zeros(1, 2), torch.zeros(4, dtype=torch.int64), prediction.observe(initial)
    )
    torch.testing.assert_close(found, noise, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", LOSSES)
def test_loss_weights_turn_the_error_of_the_noise_into_that_of_the_kind(kind: str) -> None:
    alpha_bar = cosine_alpha_bar(100)[[5, 40, 90]].double()
    clean, guess, noise = torch.randn(3, 3, 4, dtype=torch.float64)
    signal, spread = alpha_bar.sqrt()[:, None], (1 - alpha_bar).sqrt()[:, None]
    x = signal * clean + spread * noise
    other = (x - signal * guess) / spread  # the noise that another clean plan would imply
    error = {
        "epsilon": other - noise,
        "v": (signal * other - spread * guess) - (signal * noise - spread * clean),
        "clean": guess - clean,
    }[kind]
    weighted = (other - noise).square() * loss_weights(kind, alpha_bar)[:, None]
    torch.testing.assert_close(weighted, error.square())


def test_an_unknown_prediction_is_refused() -> None:
    with pytest.raises(UserError, match="expected one of epsilon, v, clean, found 'displacement'"):
        loss_weights("displacement", torch.ones(1))
    with pytest.raises(UserError, match="what this domain observes holds no state"):
        Prediction(torch.nn.Module(), "displacement", 100)
