"""Several sets of embeddings of one concept: what samples are generated from."""

from collections.abc import Sequence
from typing import Any, cast

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.evaluation.closed_loop import sampled_plans
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.forms.modes import STRETCH, Modes
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.training.concept_model import ConceptModel

seeds = st.integers(0, 2**31)


def modes(count: int = 5, mixed: bool = False, seed: int = 0) -> Modes:
    """K = 2, one knot, n = 3."""
    draw = torch.Generator().manual_seed(seed)
    return Modes(torch.randn(count, 2, 1, 3, generator=draw), torch.rand(count, 2, generator=draw), mixed)


def concept(own: Modes) -> Composition:
    """Modes beside embeddings that are none of them."""
    return Composition(torch.full((2, 1, 3), 9.0), torch.tensor([1.2, 0.6]), modes=own)


def samples(own: Modes, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Embeddings ``(count, 2, 1, 3)`` and weights ``(count, 2)`` of every sample."""
    embeddings, weights, row = own.draw(count, torch.Generator().manual_seed(seed))
    return embeddings[row], weights[row]


def test_a_drawn_sample_is_generated_from_one_of_the_modes_with_its_own_weights() -> None:
    own = modes()
    embeddings, weights = samples(own, 200)
    for embedding, weight in zip(embeddings, weights, strict=True):
        same = (own.embeddings == embedding).flatten(1).all(dim=1)
        assert same.sum() == 1
        assert torch.equal(own.weights[same][0], weight)
    numbers = (embeddings[:, None] == own.embeddings).flatten(2).all(dim=2).sum(dim=0)
    assert numbers.sum() == 200
    assert numbers.min() > 20  # each of the five is expected 40 times


@settings(max_examples=20, deadline=None)
@given(seed=seeds, count=st.integers(1, 6))
def test_a_mixture_lies_in_the_span_of_the_modes_with_shares_that_sum_to_one(seed: int, count: int) -> None:
    own = modes(count, mixed=True, seed=seed)
    embeddings, weights = samples(own, 40, seed)
    # Unit vectors as modes give the shares themselves.
    unit = Modes(torch.eye(count)[:, None, None], torch.ones(count, 1), mixed=True)
    shares = samples(unit, 40, seed)[0][:, 0, 0]
    assert torch.allclose(shares.sum(dim=1), torch.ones(40), atol=1e-5)
    assert shares.min() >= (1 - STRETCH) / count - 1e-6
    assert shares.max() <= STRETCH + (1 - STRETCH) / count + 1e-6
    assert torch.allclose(embeddings, torch.einsum("sm,mktn->sktn", shares, own.embeddings), atol=1e-5)
    assert torch.allclose(weights, shares @ own.weights, atol=1e-5)


def test_mixtures_vary_about_the_mean_of_the_modes_as_far_as_stretched_even_shares_do() -> None:
    unit = Modes(torch.eye(5)[:, None, None], torch.ones(5, 1), mixed=True)
    shares = samples(unit, 20_000)[0][:, 0, 0]
    assert torch.allclose(shares.mean(dim=0), torch.full((5,), 0.2), atol=0.01)
    # Of Dirichlet(1) over m the variance of a share is (m - 1) / (m^2 (m + 1)).
    assert torch.allclose(shares.var(dim=0), torch.full((5,), STRETCH**2 * 4 / 150), rtol=0.05)


def test_a_mixture_of_equal_modes_is_that_mode() -> None:
    one = modes(1)
    same = Modes(one.embeddings.expand(4, -1, -1, -1), one.weights.expand(4, -1), mixed=True)
    embeddings, weights = samples(same, 10)
    assert torch.allclose(embeddings, one.embeddings.expand(10, -1, -1, -1), atol=1e-5)
    assert torch.allclose(weights, one.weights.expand(10, -1), atol=1e-5)


@pytest.mark.parametrize("mixed", [False, True])
def test_a_seed_repeats_the_draw_and_the_order_of_modes_does_not_change_what_is_generated(mixed: bool) -> None:
    own, order = modes(mixed=mixed), torch.tensor([3, 1, 4, 0, 2])
    assert torch.equal(samples(own, 20, 1)[0], samples(own, 20, 1)[0])
    assert not torch.equal(samples(own, 20, 1)[0], samples(own, 20, 2)[0])
    other = Modes(own.embeddings[order], own.weights[order], mixed)
    count = 20_000
    found = [samples(each, count, seed)[0].flatten(1) for each, seed in ((own, 1), (other, 2))]
    assert torch.allclose(found[0].mean(dim=0), found[1].mean(dim=0), atol=0.05)
    assert torch.allclose(found[0].T.cov(), found[1].T.cov(), atol=0.08)
    if not mixed:  # the same set, and each as often
        for each in found:
            _, numbers = each.unique(dim=0, return_counts=True)
            assert len(numbers) == 5
            assert (numbers / count - 0.2).abs().max() < 0.02


def test_nothing_is_drawn_where_there_are_no_modes() -> None:
    draw = torch.Generator().manual_seed(3)
    before = draw.get_state()
    own = Composition(torch.zeros(2, 1, 3), torch.ones(2))
    rows, row = own.draw(4, draw)
    assert rows.embeddings.shape == (1, 2, 1, 3)
    assert row.tolist() == [0, 0, 0, 0]
    assert own.drawn(draw) is own
    assert torch.equal(draw.get_state(), before)


def test_a_multiple_multiplies_the_modes_weights_alone_and_a_sum_is_composed_of_the_centre_and_has_no_modes() -> None:
    own = concept(modes(mixed=True))
    for double in (2 * own, own * 2):
        assert torch.equal(double.weights, 2 * own.weights)
        assert torch.equal(double.modes.weights, 2 * own.modes.weights)
        assert torch.equal(double.modes.embeddings, own.modes.embeddings)
        assert double.modes.mixed
    own, other = concept(modes()), Composition(torch.zeros(1, 1, 3), torch.ones(1))
    for both in (own + other, own - 0.5 * other, own + own):
        assert both.modes is None
        assert torch.equal(both.embeddings[:2], own.embeddings)
        assert torch.equal(both.weights[:2], own.weights)
    assert (other + own).modes is None


def test_concepts_with_and_without_modes_are_generated_in_one_batch() -> None:
    own, plain = concept(modes()), Composition(torch.full((1, 1, 3), 7.0), torch.ones(1))
    draws = [torch.Generator().manual_seed(seed) for seed in range(3)]
    together, rows = batched([plain, own, concept(modes(2, mixed=True))], 4, draws)
    assert together.embeddings.shape == (1 + 5 + 4, 2, 1, 3)
    assert rows[:4].tolist() == [0] * 4
    assert set(rows[4:8].tolist()) <= set(range(1, 6))
    assert rows[8:].tolist() == [6, 7, 8, 9]
    assert together.weights[0, 1] == 0  # padded
    expected, chosen = own.draw(4, torch.Generator().manual_seed(1))
    assert torch.equal(together.embeddings[rows[4:8]], expected.embeddings[chosen])


@pytest.mark.parametrize("mixed", [False, True])
def test_an_episode_keeps_the_mode_that_it_began_with(mixed: bool) -> None:
    seen: list[Sequence[Composition]] = []

    class Recorder:
        device = torch.device("cpu")

        def sample(self, compositions: Sequence[Composition], *_: Any) -> torch.Tensor:
            seen.append(compositions)
            return torch.zeros(len(compositions), 1, 1, 1)

    draws = [torch.Generator().manual_seed(seed) for seed in range(8)]
    own = concept(modes(mixed=mixed))
    make = sampled_plans(cast(ConceptModel, Recorder()), [own] * 8, Sampling(), draws)
    for rows in (list(range(8)), [1, 5], list(range(8))):
        make({}, rows)
    first, some, last = seen
    assert all(one.modes is None for one in first)  # drawn once, not at every plan
    assert all(torch.equal(one.embeddings, two.embeddings) for one, two in zip(first, last, strict=True))
    assert torch.equal(some[1].embeddings, first[5].embeddings)
    assert len({one.embeddings.sum().item() for one in first}) > 1
    assert len({one.embeddings.sum().item() for one in first}) == 8 or not mixed
