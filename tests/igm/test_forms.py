"""Forms of a concept beyond the paper's: over time (knots), on some columns of a state, with an adapter in its own branch."""

import copy
import functools
import operator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import Feature
from ftl_lightning.data.normalization import Normalization
from ftl_lightning.domains.domain import OWN
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Concept, Origin
from ftl_lightning.igm.forms.adapter import LowRank, adaptable
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.igm.inversion import invert
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.networks import TemporalUNet
from ftl_lightning.networks.conditions import Sizes
from ftl_lightning.networks.temporal_unet import over_time
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.model_config import Prepared

SIZES = Sizes(horizon=8, state_dim=3, concept_dim=4, observed={"place": Feature((5,))})
ORIGIN = Origin("new", "own", "e", "p", "d", 5, "fixed", 0.15)


@pytest.fixture(scope="module")
def network() -> TemporalUNet:
    torch.manual_seed(0)
    net = TemporalUNet(SIZES, width=8, multipliers=(1, 2), film=True, broadcast=True, clock=2, skip=True)
    return net.eval().requires_grad_(False)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


X, T, EMPTY = normal(3, 8, 3), torch.tensor([0, 40, 90]), normal(4, seed=1)
PLACE = normal(3, 5, seed=2)
WALK = Composition(normal(1, 1, 4), torch.tensor([0.8]))
WAVE = Composition(normal(2, 1, 4, seed=1), torch.tensor([1.2, 0.5]))


def noise(network: TemporalUNet, composition: Composition) -> Tensor:
    """Of the three plans, each by the same composition ``(K, ...)``."""
    together, own = batched([composition], 3, [torch.Generator()])
    return composed_epsilon(network, X, T, together, EMPTY, network.observe(PLACE), own)


def adapter(network: TemporalUNet, seed: int = 3, size: float = 0.3) -> LowRank:
    sizes, after = adaptable(network).items(), seed + 1
    return LowRank({name: (size * normal(out, 2, seed=seed), normal(2, into, seed=after)) for name, (out, into) in sizes})


def adapted(own: Composition, change: LowRank) -> Composition:
    return replace(own, adapters=(change,), adapter=torch.ones(len(own.weights), dtype=torch.int64))


def test_what_knots_say_is_linear_between_them_and_does_not_vary_where_they_are_alike(network: TemporalUNet) -> None:
    still = Composition(normal(2, 1, 4), torch.tensor([1.2, 0.6]))
    said = Composition(still.embeddings.repeat(1, 5, 1), still.weights)
    assert torch.allclose(noise(network, still), noise(network, said), atol=1e-5)
    values = over_time(torch.tensor([[[0.0], [1.0], [3.0]]]), 5)
    assert torch.allclose(values, torch.tensor([[[0.0, 0.5, 1.0, 2.0, 3.0]]]))
    moving = Composition(normal(1, 2, 4), torch.ones(1))
    turned = replace(moving, embeddings=moving.embeddings.flip(1))
    assert (noise(network, moving) - noise(network, turned)).abs().max() > 0.01


def test_concepts_of_one_knot_compose_with_those_of_several_and_others_are_refused(network: TemporalUNet) -> None:
    still, moving = Composition(normal(1, 1, 4), torch.ones(1)), Composition(normal(1, 3, 4, seed=1), torch.ones(1))
    both = still + moving
    assert both.knots == 3
    assert torch.equal(both.embeddings[0], still.embeddings[0].repeat(3, 1))
    other = noise(network, Composition(still.embeddings.repeat(1, 3, 1), still.weights) + moving)
    assert torch.equal(noise(network, both), other)
    four = Composition(normal(1, 4, 4), torch.ones(1))
    with pytest.raises(UserError, match="expected concepts with equal numbers of knots \\(or 1 knot\\), found 3 and 4"):
        moving + four
    together, own = batched([still, moving], 2, [torch.Generator(), torch.Generator()])
    assert together.embeddings.shape == (2, 1, 3, 4)
    assert own.tolist() == [0, 0, 1, 1]


def test_modes_stay_in_compositions_of_concepts_that_vary_over_time(network: TemporalUNet) -> None:
    def several(count: int, knots: int, seed: int) -> Composition:
        modes = Modes(normal(count, 1, knots, 4, seed=seed), torch.ones(count, 1))
        return Composition(normal(1, knots, 4), torch.ones(1), modes=modes)

    still, walk = Composition(normal(1, 1, 4, seed=5), torch.tensor([0.8])), several(3, 1, 6)
    assert (walk + still).modes is None
    wave, kick = several(2, 3, 7), several(3, 3, 8)
    both = (wave.on((0,), 3) + still.on((1, 2), 3)) * 0.5
    assert both.modes.embeddings.shape == (2, 2, 3, 4)
    assert torch.equal(both.modes.embeddings[1, 0], wave.modes.embeddings[1, 0])
    assert torch.equal(both.modes.embeddings[1, 1], still.embeddings[0].repeat(3, 1))
    assert torch.allclose(both.modes.weights, torch.tensor([[0.5, 0.4]]).expand(2, 2))
    pairs = (wave + kick + walk).modes
    assert pairs.embeddings.shape == (6, 3, 3, 4)
    assert len(torch.unique(pairs.embeddings[:, :2].flatten(1), dim=0)) == 6
    together, own = batched([both], 8, [torch.Generator().manual_seed(0)])
    assert together.embeddings.shape == (2, 2, 3, 4)
    assert set(own.tolist()) == {0, 1}


def test_a_weight_on_some_columns_changes_those_alone(network: TemporalUNet) -> None:
    nothing = noise(network, 0.0 * WALK)
    both = noise(network, WALK.on((0, 2), 3) + WAVE.on((1,), 3))
    assert torch.allclose(both[..., [0, 2]], noise(network, WALK)[..., [0, 2]], atol=1e-5)
    assert torch.allclose(both[..., 1], noise(network, WAVE)[..., 1], atol=1e-5)
    legs = noise(network, WALK.on((0,), 3))
    assert torch.allclose(legs[..., 1:], nothing[..., 1:], atol=1e-5)
    assert torch.allclose(noise(network, WALK.on((0,), 3) + WAVE)[..., 1:], noise(network, WAVE)[..., 1:], atol=1e-5)


def test_an_adapter_that_adds_nothing_changes_nothing(network: TemporalUNet) -> None:
    own = Composition(normal(2, 1, 4), torch.tensor([1.2, 0.6]))
    assert torch.allclose(noise(network, own), noise(network, adapted(own, adapter(network, size=0.0))), atol=1e-5)


def test_an_adapter_changes_its_own_branch_and_no_other(network: TemporalUNet) -> None:
    change, nothing = adapter(network), noise(network, Composition(torch.zeros(0, 1, 4), torch.zeros(0)))
    waved = noise(network, adapted(WAVE, change)) - nothing
    assert (waved - (noise(network, WAVE) - nothing)).abs().max() > 0.01
    expected = nothing + (noise(network, WALK) - nothing) + waved
    for both in (WALK + adapted(WAVE, change), adapted(WAVE, change) + WALK):
        assert torch.allclose(noise(network, both), expected, atol=1e-4)
    two = adapted(WAVE, change) + adapted(WALK, adapter(network, seed=9))
    assert len(two.adapters) == 2
    assert two.adapter.tolist() == [1, 1, 2]
    # Side by side with one that has none, and twice with the same one, each as alone.
    draws = [torch.Generator() for _ in range(3)]
    three = [WALK, adapted(WAVE, change), WALK + adapted(WAVE, change)]
    together, own = batched(three, 1, draws)
    assert together.adapters == (change,)
    each = composed_epsilon(network, X, T, together, EMPTY, network.observe(PLACE), own)
    alone = torch.cat([noise(network, one)[row][None] for row, one in enumerate(three)])
    assert torch.allclose(each, alone, atol=1e-4)


def test_a_denoiser_that_is_no_network_and_embeddings_without_an_axis_of_knots_are_refused(network: TemporalUNet) -> None:
    with pytest.raises(TypeError, match="expected a network, whose weights can be changed, found function"):
        adapter(network)(lambda x, t, concepts, index, context: x)
    with pytest.raises(UserError, match=r"expected embeddings \(..., K, knots, n\) and weights .*, found \(2, 4\) and \(2,\)"):
        Composition(normal(2, 4), torch.ones(2))


def test_an_adapter_that_changes_everything_is_another_network(network: TemporalUNet) -> None:
    change = replace(adapter(network), everywhere=True)
    tuned = copy.deepcopy(network)
    for name in change.factors:
        tuned.get_parameter(name).data = change.changed(name, network.get_parameter(name))
    tuned.requires_grad_(False)
    for together, plain in ((adapted(WAVE, change), WAVE), (WALK + adapted(WAVE, change), WALK + WAVE)):
        # What is observed is read before, by the network as it is.
        own, rows = batched([plain], 3, [torch.Generator()])
        expected = composed_epsilon(tuned, X, T, own, EMPTY, network.observe(PLACE), rows)
        assert torch.allclose(noise(network, together), expected, atol=1e-4)
    each, rows = batched([WALK, adapted(WAVE, change)], 1, [torch.Generator(), torch.Generator()])
    sample = composed_epsilon(network, X[:2], T[:2], each, EMPTY, network.observe(PLACE[:2]), rows)
    assert torch.allclose(sample[0], noise(network, WALK)[0], atol=1e-4)
    with pytest.raises(UserError, match="expected at most 1 concept whose adapter changes the whole network, found 2"):
        adapted(WAVE, change) + adapted(WALK, change)


@pytest.mark.parametrize("modes", [False, True])
@pytest.mark.parametrize(("knots", "adapters"), [(3, False), (1, True), (3, True)])
def test_every_form_comes_back_from_its_file(network: TemporalUNet, knots: int, adapters: bool, modes: bool) -> None:
    several = Modes(normal(2, 2, knots, 4), torch.ones(2, 2), mixed=True) if modes else None
    own = Concept(normal(2, knots, 4), torch.tensor([1.2, 0.6]), ORIGIN, several, adapter(network) if adapters else None)
    own.save("c.safetensors")
    found = Concept.load("c.safetensors")
    assert found.knots == knots
    assert torch.equal(found.embeddings, own.embeddings)
    assert (found.adapter is not None) == adapters
    assert torch.equal(noise(network, replace(found, modes=None).composition), noise(network, replace(own, modes=None).composition))
    assert (found.modes is not None) == modes
    before = Path("c.safetensors").read_bytes()
    found.save("c.safetensors")
    assert Path("c.safetensors").read_bytes() == before
    assert ("component 1, knot 3" in found.parts()) == (knots == 3)
    assert {len(part.embedding) for part in found.parts().values()} == {4}


@pytest.fixture(scope="module")
def model() -> GenerativeModel:
    """Of strokes, untrained."""
    states = torch.from_numpy(strokes("square", 4, 0))
    lengths, concepts = torch.full((4,), 40), ("one", "one", "two", "two")
    examples = Demonstrations(states, lengths, OWN, ("x", "y"), ("cm", "cm"), concepts)
    domain = own_domain(examples, ("one", "two"), 40, {})
    sizes = {"horizon": 40, "state_dim": 2, "concept_dim": 6, "denoiser_args": {"width": 8, "multipliers": [1, 2], "film": True}}
    torch.manual_seed(0)
    config = DiffusionConfig(domain=OWN, training_concepts=("one", "two"), encoder="none", denoiser="TemporalUNet", **sizes)
    found = GenerativeModel(Prepared(config, domain, Normalization.fit(states), normal(3, 6)))
    found.examples = examples
    return found.requires_grad_(False).eval()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{"knots": 4}, {"adapter": 2}, {"adapter": 2, "adapter_scope": "all"}, {"knots": 4, "adapter": 2, "omega": "learned"}],
    ids=str,
)
def test_every_form_is_learned_lowers_the_loss_and_generates(model: GenerativeModel, options: dict[str, object]) -> None:
    learner = FewShot(model, ModelSettings(InversionSettings().changed(samples=8), 40, Sampling(steps=2), 1))
    before = {name: parameter.clone() for name, parameter in model.named_parameters()}
    demonstrations = learner.demonstrations(strokes("heart", 3, 0), name="heart")
    short, long = (learner.learn(demonstrations, name="heart", steps=steps, form="paper", **options) for steps in (1, 40))
    assert long.concept.origin.loss < short.concept.origin.loss
    assert long.knots == options.get("knots", 1)
    assert (long.concept.adapter is None) == ("adapter" not in options)
    assert all(torch.equal(before[name], parameter) for name, parameter in model.named_parameters())
    both = functools.reduce(operator.add, (long, learner["one"]))
    for own in (long, both):
        assert learner.sample(own, 2).states.isfinite().all()
    long.save("heart.safetensors")
    again = learner.load("heart.safetensors")
    assert [one.everywhere for one in again.concept.composition.adapters] == ["adapter_scope" in options] * ("adapter" in options)
    assert torch.equal(learner.sample(again, 2).states, learner.sample(long, 2).states)
    assert long.explain().nearest


def test_what_is_learned_with_an_adapter_does_not_depend_on_what_is_learned_beside_it(model: GenerativeModel) -> None:
    learner = FewShot(model, ModelSettings(InversionSettings().changed(samples=8), 40, Sampling(steps=2), 1))
    one = learner.demonstrations(strokes("heart", 3, 0), name="heart")
    other = learner.demonstrations(strokes("square", 3, 0), name="square")
    settings = InversionSettings().changed(samples=8, adapter=2)
    alone, beside = invert(model, one, settings, 5), invert(model, concatenate([other, one]), settings, 5)
    assert torch.allclose(alone["heart"].embeddings, beside["heart"].embeddings, atol=1e-5)
    first, second = alone["heart"].adapter, beside["heart"].adapter
    for name, factors in first.factors.items():
        assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(factors, second.factors[name], strict=True))


def test_knots_are_refused_where_a_plan_is_a_single_state(shipped: Path) -> None:
    learner = FewShot.from_pretrained(shipped)
    scene = learner.domain.source(None).draw("circle right of square", 1, 0)
    with pytest.raises(UserError, match=r"model\.embeddings\.knots: expected 1 for this model"):
        learner.learn(scene, steps=1, knots=4)
