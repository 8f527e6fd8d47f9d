"""When an inversion stops: on losses that are known beforehand, and in real inversions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.forms.stopping import IDLE, ROUND, Stopping
from ftl_lightning.igm.inversion import Inversion, invert
from ftl_lightning.igm.settings import PAPER, InversionSettings
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.training.trainer import Trainer
from tests.conftest import inversion_module

RING, BOTH = "circle, triangle and square in a circle of radius 1.25", "triangle right of circle and square above circle"
NEXT = "square diagonal to triangle"


def follow(losses: Sequence[Sequence[float]], tolerance: float) -> tuple[Stopping, list[int]]:
    """Runs whose held-out loss before the first step and after every round is known; their only number is the step's.

    Args:
        losses: of each run, the start's first.
        tolerance: see :class:`Stopping`.

    Returns:
        What is kept, and after how many rounds each run stopped (all of them if it did not).
    """
    runs, rounds = len(losses), len(losses[0]) - 1
    known = torch.tensor(losses)
    rule = Stopping(torch.zeros(runs, 1, 1), torch.zeros(runs, 1), tolerance)
    rule.begin(known[:, 0])
    stopped = [rounds] * runs
    for step in range(rounds * ROUND):
        here = torch.full((runs, 1, 1), float(step))

        def held_out(embeddings: torch.Tensor, weights: torch.Tensor, chosen: torch.Tensor, step: int = step) -> torch.Tensor:
            assert torch.equal(embeddings[..., 0], weights)
            return known[chosen, (step + 1) // ROUND]

        before = rule.going.clone()
        goes_on = rule.after_step(step, here, here[..., 0], held_out)
        assert goes_on == bool(rule.going.any())
        assert not (rule.going & ~before).any()  # what has stopped does not begin again
        for run in (before & ~rule.going).nonzero().flatten().tolist():
            stopped[run] = (step + 1) // ROUND
        if not goes_on:
            break
    return rule, stopped


def middle(number: int) -> float:
    """The mean number of the steps of a round, numbered from 1; 0 is the start."""
    return (number - 1) * ROUND + (ROUND - 1) / 2 if number else 0.0


SHARES = [1.0, 0.8, 0.75, 0.747, 0.746, 0.745]
FALLING = [1.0 - 0.01 * number for number in range(9)]


@pytest.mark.parametrize(
    ("losses", "tolerance", "expected"),
    [
        pytest.param([[1.0, 0.5, 0.4, 0.399, 0.398, 0.1]], 0.01, [4], id="gains of 0.001 of 0.6 in rounds three and four"),
        pytest.param([[1.0, 0.5, 0.499, 0.4, 0.399, 0.398, 0.1]], 0.01, [5], id="a round that gains enough begins the count anew"),
        pytest.param([[1.0, 0.5, 0.7, 0.6, 0.1]], 0.01, [3], id="a round that is worse counts as idle and is not kept"),
        pytest.param(
            [SHARES, [10 * loss for loss in SHARES], [5 + loss for loss in SHARES]],
            0.02,
            [4, 4, 4],
            id="what counts as little is a share of all that was gained",
        ),
        pytest.param([[1.0, 1.1, 1.2, 0.1]], 0.01, [2], id="the start is better than any round"),
        pytest.param([FALLING, [1.0, 0.5, 0.5, 0.5, *FALLING[:5]]], 0.0, [8, 3], id="at zero only what gains nothing is idle"),
    ],
)
def test_a_run_stops_after_two_rounds_that_gain_little_and_keeps_the_best_round(
    losses: list[list[float]], tolerance: float, expected: list[int]
) -> None:
    rule, stopped = follow(losses, tolerance)
    assert stopped == expected
    for run, (own, rounds) in enumerate(zip(losses, stopped, strict=True)):
        least = min(own[: rounds + 1])
        assert rule.least[run].item() == pytest.approx(least)
        assert rule.embeddings[run].item() == rule.weights[run].item() == middle(own.index(least))


@pytest.mark.parametrize("tolerance", [0.0, 0.05, 0.5])
def test_what_is_kept_is_never_worse_than_any_round_that_was_seen(tolerance: float) -> None:
    losses = torch.rand(50, 12, generator=torch.Generator().manual_seed(0))
    rule, stopped = follow(losses.tolist(), tolerance)
    seen = torch.stack([own[: rounds + 1].min() for own, rounds in zip(losses, stopped, strict=True)])
    assert torch.equal(rule.least, seen)
    assert min(stopped) >= IDLE
    assert len(set(stopped)) > 2  # they stop one by one


def test_a_run_that_has_stopped_keeps_its_result_while_others_go_on() -> None:
    alone, _ = follow([[1.0, 0.5, 0.5, 0.5]], tolerance=0.01)
    beside, stopped = follow([[1.0, 0.5, 0.5, 0.5, 0.1, 0.0], [1.0, 0.8, 0.6, 0.4, 0.2, 0.1]], tolerance=0.01)
    assert stopped == [3, 5]
    assert beside.embeddings[0].item() == alone.embeddings.item() == middle(1)
    assert beside.least[0] == alone.least[0]
    assert beside.embeddings[1].item() == middle(5)


def test_within_a_round_nothing_is_judged() -> None:
    rule = Stopping(torch.zeros(1, 1, 1), torch.zeros(1, 1), 0.1)
    rule.begin(torch.ones(1))
    for step in range(ROUND - 1):
        assert rule.after_step(step, torch.ones(1, 1, 1), torch.ones(1, 1), lambda *_: pytest.fail("judged"))
    assert rule.embeddings.item() == 0


# In real inversions


@pytest.fixture(scope="module")
def model(tiny: Path) -> ConceptModel:
    return load_model(tiny)


def shown(*tasks: str) -> Demonstrations:
    source = load_domain("object_rearrangement").source(None)
    return concatenate([source.draw(task, 5, 1) for task in tasks])


def learn(model: ConceptModel, *tasks: str, steps: int = 200, **changes: Any) -> tuple[Inversion, int]:
    """An inversion by hand, and the number of its steps."""
    demonstrations, settings, losses = shown(*tasks), InversionSettings().changed(samples=8, **changes), list[float]()
    inversion = Inversion(model, demonstrations, settings)
    invert(model, demonstrations, settings, steps, losses.append, start=inversion)
    return inversion, len(losses)


def test_without_a_tolerance_all_steps_are_made_and_the_last_embeddings_are_learned(model: ConceptModel) -> None:
    inversion, steps = learn(model, RING, steps=30)
    assert steps == 30
    assert inversion.stopping is None
    assert torch.equal(inversion.learned()[RING].embeddings, inversion.embeddings[0].detach())


def test_fewer_steps_than_a_round_has_are_not_lost(model: ConceptModel) -> None:
    few = InversionSettings().changed(samples=8, tolerance=0.05)
    at_all = [invert(model, shown(RING), few, steps)[RING].embeddings for steps in (1, ROUND - 1)]
    start = Inversion(model, shown(RING), few).embeddings[0]
    assert not torch.equal(at_all[0], start)
    assert not torch.equal(at_all[0], at_all[1])


def test_a_tolerance_ends_learning_early_at_the_best_round(model: ConceptModel) -> None:
    inversion, steps = learn(model, RING, tolerance=0.3)
    assert ROUND * IDLE <= steps < 200
    assert steps % ROUND == 0
    learned = inversion.learned()[RING]
    assert torch.equal(learned.embeddings, inversion.stopping.embeddings[0])
    assert not torch.equal(learned.embeddings, inversion.embeddings[0].detach())
    with torch.no_grad():
        start = Inversion(model, shown(RING), InversionSettings().changed(samples=8)).learned()[RING]
    assert learned.origin.loss < start.origin.loss


@pytest.mark.parametrize("tolerance", [0.1, 0.2])
def test_a_concept_is_the_same_alone_as_beside_one_that_is_learned_longer(model: ConceptModel, tolerance: float) -> None:
    alone = {task: learn(model, task, tolerance=tolerance) for task in (RING, BOTH)}
    together, steps = learn(model, RING, BOTH, tolerance=tolerance)
    counts = [count for _, count in alone.values()]
    assert counts[0] != counts[1]
    assert steps == max(counts)
    for task, (own, _) in alone.items():
        one, other = own.learned()[task], together.learned()[task]
        assert torch.allclose(one.embeddings, other.embeddings, atol=2e-4)
        assert one.origin.loss == pytest.approx(other.origin.loss, abs=1e-5)


def test_what_modes_learn_from_does_not_depend_on_which_other_runs_go_on(model: ConceptModel) -> None:
    inversion = Inversion(model, shown(RING), InversionSettings().changed(samples=8, tolerance=0.1, modes="each", mode_samples=4))
    inversion.step_losses(0)
    every = inversion.step_losses(1)
    inversion.stopping.going[0] = False  # that of all demonstrations
    assert torch.allclose(inversion.step_losses(1), every[1:], atol=1e-5)


def test_runs_that_have_stopped_are_not_computed_any_more(model: ConceptModel) -> None:
    inversion = Inversion(model, shown(RING, BOTH), InversionSettings().changed(samples=4, tolerance=0.1))
    assert inversion.step_losses(0).shape == (2,)
    inversion.stopping.going[0] = False
    losses = inversion.step_losses(1)
    assert losses.shape == (1,)
    losses.sum().backward()
    assert not inversion.embeddings.grad[0].any()
    assert inversion.embeddings.grad[1].any()


# As a LightningModule


def fit(tiny: Path, steps: int, **options: Any) -> dict[str, Concept]:
    """Concepts that a trainer learns from three demonstrated concepts."""
    quiet = dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing"), False)
    trainer = Trainer(max_epochs=1, accelerator="cpu", limit_val_batches=0, **quiet)
    form = "" if "modes" in options else PAPER  # of demonstrations of one's own the form is chosen where nothing is said
    module = inversion_module(tiny, samples=8, form=form, **options)
    shown(RING, BOTH, NEXT).save("shown.safetensors")
    trainer.fit(module, datamodule=InversionData("object_rearrangement", demonstrations="shown.safetensors", steps=steps))
    return module.learned()


def expect_same(found: dict[str, Concept], expected: dict[str, Concept]) -> None:
    """The same concepts in the same order, to the bit."""
    assert list(found) == list(expected)
    for name, one in expected.items():
        other = found[name]
        assert torch.equal(other.embeddings, one.embeddings)
        assert torch.equal(other.weights, one.weights)
        assert other.origin == one.origin
        assert (other.modes is None) == (one.modes is None)
        if one.modes is not None and other.modes is not None:
            assert torch.equal(other.modes.embeddings, one.modes.embeddings)
            assert torch.equal(other.modes.weights, one.modes.weights)
            assert other.modes.mixed == one.modes.mixed


MORE_OPTIONS: list[dict[str, Any]] = [
    {"off_span": 0.1, "restarts": 2, "loss": "v", "timestep_power": 3.0},
    {"start": "concepts", "restarts": 3, "screening": 2},
    {"tolerance": 0.3},
    {"tolerance": 0.3, "omega": "learned"},
    {"modes": 2},
]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"omega": "learned", "components": 3},
        {"tolerance": 0.3, "modes": "auto"},
        *(pytest.param(options, marks=pytest.mark.slow) for options in MORE_OPTIONS),
    ],
    ids=str,
)
def test_with_a_trainer_the_same_is_learned_to_the_bit(tiny: Path, options: dict[str, Any]) -> None:
    steps = 60 if "tolerance" in options else 7
    learned = fit(tiny, steps, seed=3, **options)
    losses: list[float] = []
    settings = InversionSettings().changed(samples=8, seed=3, **options)
    expect_same(learned, invert(load_model(tiny), shown(RING, BOTH, NEXT), settings, steps, losses.append))
    assert (len(losses) < steps) == ("tolerance" in options)
    assert torch.tensor(losses).isfinite().all()
    assert all((concept.modes is not None) == ("modes" in options) for concept in learned.values())
