import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.data.features import Feature
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.diffusion import Context, Denoiser
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.networks import MLPDenoiser
from ftl_lightning.networks.conditions import Sizes

torch.manual_seed(0)
SIZES = Sizes(horizon=2, state_dim=3, concept_dim=4, observed={"place": Feature((5,))})
DENOISER = MLPDenoiser(SIZES, hidden_dim=16, depth=2, condition_dim=8)
EMPTY = torch.randn(4)


def inputs(count: int, seed: int, batch: int = 3) -> dict[str, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    return {
        "x": torch.randn((batch, 2, 3), generator=draw),
        "t": torch.randint(100, (batch,), generator=draw),
        "concepts": torch.randn((batch, count, 1, 4), generator=draw),
        "weights": torch.randn((batch, count), generator=draw),
        "place": torch.randn((batch, 5), generator=draw),
    }


def composed(of: dict[str, torch.Tensor], denoiser: Denoiser = DENOISER) -> torch.Tensor:
    """What the formula gives."""
    composition = Composition(of["concepts"], of["weights"])
    return composed_epsilon(denoiser, of["x"], of["t"], composition, EMPTY, DENOISER.observe(of["place"]))


def plain(of: dict[str, torch.Tensor], concept: torch.Tensor) -> torch.Tensor:
    noise: torch.Tensor = DENOISER(of["x"], of["t"], concept, torch.arange(len(of["x"])), DENOISER.observe(of["place"]))
    return noise


def close(one: torch.Tensor, other: torch.Tensor) -> bool:
    return torch.allclose(one, other, atol=1e-5)


seeds = st.integers(0, 2**31)


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_one_component_of_weight_one_is_the_conditional_prediction(seed: int) -> None:
    of = inputs(1, seed) | {"weights": torch.ones(3, 1)}
    assert close(composed(of), plain(of, of["concepts"][:, 0]))


@settings(max_examples=25, deadline=None)
@given(seed=seeds, count=st.integers(0, 4))
def test_zero_weights_are_the_empty_prediction(seed: int, count: int) -> None:
    of = inputs(count, seed) | {"weights": torch.zeros(3, count)}
    assert close(composed(of), plain(of, EMPTY.expand(3, 1, -1)))


@settings(max_examples=25, deadline=None)
@given(seed=seeds, order=st.permutations(range(3)))
def test_the_order_of_components_does_not_matter(seed: int, order: list[int]) -> None:
    of = inputs(3, seed)
    shuffled = of | {"concepts": of["concepts"][:, order], "weights": of["weights"][:, order]}
    assert close(composed(of), composed(shuffled))


@settings(max_examples=15, deadline=None)
@given(seed=seeds, count=st.integers(1, 3))
def test_one_batched_call_equals_the_formula_branch_by_branch(seed: int, count: int) -> None:
    of = inputs(count, seed)
    empty = plain(of, EMPTY.expand(3, 1, -1))
    expected = empty.clone()
    for k in range(count):
        expected += of["weights"][:, k, None, None] * (plain(of, of["concepts"][:, k]) - empty)
    with torch.no_grad():
        assert close(composed(of), expected)
    assert close(composed(of), expected)


def test_consecutive_samples_share_a_composition() -> None:
    of = inputs(2, 3, batch=6)
    shared = of | {"concepts": of["concepts"][::3], "weights": of["weights"][::3]}
    apart = shared | {name: shared[name].repeat_interleave(3, dim=0) for name in ("concepts", "weights")}
    assert close(composed(shared), composed(apart))


def test_the_empty_branch_is_evaluated_without_gradient_and_the_rest_in_one_call() -> None:
    calls = []

    def spy(x: torch.Tensor, t: torch.Tensor, concepts: torch.Tensor, index: torch.Tensor, context: Context) -> torch.Tensor:
        calls.append((len(x), torch.is_grad_enabled()))
        noise: torch.Tensor = DENOISER(x, t, concepts, index, context)
        return noise

    of = inputs(2, 0)
    composed(of, spy)
    assert calls == [(3, False), (6, True)]
    calls.clear()
    with torch.no_grad():
        composed(of, spy)
    assert calls == [(9, False)]


def drawn(count: int, seed: int) -> Composition:
    draw = torch.Generator().manual_seed(seed)
    return Composition(torch.randn(count, 1, 4, generator=draw), torch.randn(count, generator=draw))


def score(composition: Composition, of: dict[str, torch.Tensor]) -> torch.Tensor:
    """What a composition ``(K, 1, 4)`` adds to the noise of the empty concept, of every sample."""
    together, _ = batched([composition], 1, [torch.Generator()])
    everywhere = of | {"concepts": together.embeddings, "weights": together.weights}
    return composed(everywhere) - plain(of, EMPTY.expand(len(of["x"]), 1, -1))


@settings(max_examples=20, deadline=None)
@given(seed=seeds, counts=st.tuples(st.integers(0, 3), st.integers(0, 3)), factor=st.floats(-3, 3))
def test_sums_differences_and_multiples_are_those_of_what_their_parts_do(seed: int, counts: tuple[int, int], factor: float) -> None:
    of, one, other = inputs(1, seed), drawn(counts[0], seed), drawn(counts[1], seed + 1)
    assert close(score(one + other, of), score(one, of) + score(other, of))
    assert close(score(one + other, of), score(other + one, of))
    assert close(score(factor * one, of), factor * score(one, of))
    both = factor * (one + other)
    apart = factor * one + other * factor
    assert torch.equal(both.embeddings, apart.embeddings)
    assert torch.equal(both.weights, apart.weights)
    assert close(score(one - factor * other, of), score(one, of) - factor * score(other, of))
    assert torch.equal((-one).weights, -1 * one.weights)
    assert torch.equal((one - 0.5 * other).weights, torch.cat((one.weights, -0.5 * other.weights)))


def test_sums_and_multiples_leave_their_parts_as_they_were() -> None:
    one, other = drawn(2, 0), drawn(1, 1)
    before = one.weights.clone()
    both = 2 * one + other
    assert both.embeddings.shape == (3, 1, 4)
    assert torch.equal(both.weights, torch.cat((2 * before, other.weights)))
    assert torch.equal(one.weights, before)
    assert torch.equal((one + other).embeddings, torch.cat((one.embeddings, other.embeddings)))
    runs = Composition(torch.zeros(5, 2, 1, 4), torch.ones(5, 2))  # leading dimensions are kept
    assert (runs + runs).embeddings.shape == (5, 4, 1, 4)
    assert (3 * runs).weights.shape == (5, 2)
    assert both.to(torch.device("cpu")).weights.device.type == "cpu"


def test_compositions_of_different_lengths_in_one_batch_are_those_alone() -> None:
    parts = [drawn(count, count) for count in (1, 3, 0, 2)]
    together, own = batched(parts, 2, [torch.Generator()] * 4)
    assert own.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert together.embeddings.shape == (4, 3, 1, 4)
    of = inputs(1, 5, batch=8)
    whole = composed(of | {"concepts": together.embeddings, "weights": together.weights})
    for number, part in enumerate(parts):
        rows = slice(2 * number, 2 * number + 2)
        own = {name: of[name][rows] for name in ("x", "t", "place")}
        alone = composed(own | {"concepts": part.embeddings[None], "weights": part.weights[None]})
        assert close(whole[rows], alone)
