import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.concepts.composition import Composition, Context, Denoiser, composed_epsilon, parse_composition
from ftl_lightning.demonstrations.features import Feature
from ftl_lightning.diffusion import MLPDenoiser
from ftl_lightning.diffusion.denoiser import Sizes
from ftl_lightning.errors import UserError

torch.manual_seed(0)
SIZES = Sizes(horizon=2, state_dim=3, concept_dim=4, observed={"place": Feature((5,))})
DENOISER = MLPDenoiser(SIZES, hidden_dim=16, depth=2, condition_dim=8)
EMPTY = torch.randn(4)


def inputs(count: int, seed: int, batch: int = 3) -> dict[str, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    return {
        "x": torch.randn((batch, 2, 3), generator=draw),
        "t": torch.randint(100, (batch,), generator=draw),
        "concepts": torch.randn((batch, count, 4), generator=draw),
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
    assert close(composed(of), plain(of, EMPTY.expand(3, -1)))


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
    empty = plain(of, EMPTY.expand(3, -1))
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


def test_compositions_in_words() -> None:
    assert parse_composition("") == []
    assert parse_composition("a right of b:1.2 + c above d") == [("a right of b", 1.2), ("c above d", 1.0)]
    for wrong in ("a:heavy", "a:nan", "a:inf", ":1", "a + "):
        with pytest.raises(UserError, match="expected 'concept:weight"):
            parse_composition(wrong)
