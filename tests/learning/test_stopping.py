"""When an inversion stops: on losses that are known beforehand, and in real inversions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.data import InversionData
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.learning import InversionModule
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion import Inversion, invert
from ftl_lightning.learning.inversion_settings import InversionSettings
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.learning.stopping import IDLE, ROUND, Stopping
from ftl_lightning.trainer import Trainer
from tests.conftest import inversion_module

RING, BOTH = "circle, triangle and square in a circle of radius 1.25", "triangle right of circle and square above circle"


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
        goes_on = rule.stepped(step, here, here[..., 0], held_out)
        assert goes_on == bool(rule.going.any())
        assert not (rule.going & ~before).any()  # what has stopped does not begin again
        for run in (before & ~rule.going).nonzero().flatten().tolist():
            stopped[run] = (step + 1) // ROUND
        if not goes_on:
            break
    return rule, stopped


def middle(number: int) -> float:
    """The mean number of the steps of a round, numbered from 1."""
    return (number - 1) * ROUND + (ROUND - 1) / 2


def test_a_run_stops_after_two_rounds_that_gain_little_and_keeps_the_best_round() -> None:
    rule, stopped = follow([[1.0, 0.5, 0.4, 0.399, 0.398, 0.1]], tolerance=0.01)
    assert stopped == [4]  # gains of 0.001 of 0.6 in rounds three and four
    assert rule.least.tolist() == pytest.approx([0.398])
    assert rule.embeddings.item() == middle(4)
    assert rule.weights.item() == middle(4)


def test_a_round_that_gains_enough_begins_the_count_of_idle_rounds_anew() -> None:
    _, stopped = follow([[1.0, 0.5, 0.499, 0.4, 0.399, 0.398, 0.1]], tolerance=0.01)
    assert stopped == [5]


def test_a_round_that_is_worse_counts_as_idle_and_is_not_kept() -> None:
    rule, stopped = follow([[1.0, 0.5, 0.7, 0.6, 0.1]], tolerance=0.01)
    assert stopped == [3]
    assert rule.least.item() == pytest.approx(0.5)
    assert rule.embeddings.item() == middle(1)


def test_what_counts_as_little_is_a_share_of_all_that_was_gained() -> None:
    """The same gains in a loss ten times as large stop in the same round."""
    losses = [1.0, 0.8, 0.75, 0.747, 0.746, 0.745]
    _, stopped = follow([losses, [10 * loss for loss in losses], [5 + loss for loss in losses]], tolerance=0.02)
    assert stopped == [4, 4, 4]


def test_the_first_round_is_measured_from_the_start() -> None:
    rule, stopped = follow([[1.0, 1.1, 1.2, 0.1]], tolerance=0.01)
    assert stopped == [2]
    assert rule.least.item() == pytest.approx(1.0)
    assert rule.embeddings.item() == 0  # the start is better than any round


def test_with_tolerance_zero_only_rounds_that_gain_nothing_are_idle() -> None:
    falling = [1.0 - 0.01 * number for number in range(9)]
    _, stopped = follow([falling, [1.0, 0.5, 0.5, 0.5, *falling[:5]]], tolerance=0.0)
    assert stopped == [8, 3]


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
        assert rule.stepped(step, torch.ones(1, 1, 1), torch.ones(1, 1), lambda *_: pytest.fail("judged"))
    assert rule.embeddings.item() == 0


# In real inversions


@pytest.fixture(scope="module")
def model(tiny: Path) -> ConceptModel:
    return load_model(tiny)


def shown(*tasks: str) -> Demonstrations:
    from ftl_lightning.demonstrations.container import concatenate

    source = load_domain("object_rearrangement").source(None)
    return concatenate([source.draw(task, 5, 1) for task in tasks])


def learn(model: ConceptModel, *tasks: str, steps: int = 200, **changes: Any) -> tuple[Inversion, int]:
    """An inversion by hand, and the number of its steps."""
    inversion = Inversion(model, shown(*tasks), InversionSettings().changed(samples=8, **changes))
    optimizer, _ = inversion.optimizer(steps)
    for step in range(steps):
        optimizer.zero_grad()
        inversion.step_losses(step).sum().backward()
        optimizer.step()
        if not inversion.stepped(step):
            return inversion, step + 1
    return inversion, steps


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
    assert inversion.stopping is not None
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
    assert inversion.stopping is not None
    inversion.stopping.going[0] = False  # that of all demonstrations
    assert torch.allclose(inversion.step_losses(1), every[1:], atol=1e-5)


def test_runs_that_have_stopped_are_not_computed_any_more(model: ConceptModel) -> None:
    inversion = Inversion(model, shown(RING, BOTH), InversionSettings().changed(samples=4, tolerance=0.1))
    assert inversion.step_losses(0).shape == (2,)
    assert inversion.stopping is not None
    inversion.stopping.going[0] = False
    losses = inversion.step_losses(1)
    assert losses.shape == (1,)
    losses.sum().backward()
    assert inversion.embeddings.grad is not None
    assert not inversion.embeddings.grad[0].any()
    assert inversion.embeddings.grad[1].any()


# As a LightningModule


def fit(tiny: Path, steps: int, *, resume: str | None = None, every: int = 0, **options: Any) -> tuple[InversionModule, Trainer]:
    from lightning.pytorch.callbacks import ModelCheckpoint

    module = inversion_module(tiny, samples=8, **options)
    data = InversionData("object_rearrangement", suite="validation", steps=steps)
    settings: dict[str, Any] = {
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "limit_val_batches": 0,
    }
    keep = ModelCheckpoint(dirpath="kept", filename="{step}", every_n_train_steps=every, save_top_k=-1) if every else None
    trainer = Trainer(
        max_epochs=1, accelerator="cpu", callbacks=[keep] if keep else [], enable_checkpointing=bool(every), **settings
    )
    trainer.fit(module, datamodule=data, ckpt_path=resume)
    return module, trainer


@pytest.mark.parametrize(
    "options",
    [{"tolerance": 0.3}, {"tolerance": 0.3, "omega": "learned"}, {"tolerance": 0.3, "modes": "auto"}, {"modes": 2}],
    ids=str,
)
def test_with_a_trainer_the_same_is_learned_in_as_many_steps_to_the_bit(tiny: Path, options: dict[str, Any]) -> None:
    module, trainer = fit(tiny, 60, **options)
    told: list[float] = []
    data = InversionData("object_rearrangement", suite="validation", steps=60)
    found = invert(load_model(tiny), data.demonstrations, InversionSettings().changed(samples=8, **options), 60, told.append)
    assert trainer.global_step == len(told)
    assert (len(told) < 60) == ("tolerance" in options)
    for name, concept in module.learned().items():
        other = found[name]
        assert torch.equal(concept.embeddings, other.embeddings)
        assert torch.equal(concept.weights, other.weights)
        assert concept.origin == other.origin
        assert (concept.modes is None) == (other.modes is None) == ("modes" not in options)
        if concept.modes is not None and other.modes is not None:
            assert torch.equal(concept.modes.embeddings, other.modes.embeddings)
            assert torch.equal(concept.modes.weights, other.modes.weights)
            assert concept.modes.mixed == other.modes.mixed


@pytest.mark.parametrize("options", [{}, {"modes": "each"}], ids=str)
@pytest.mark.parametrize("after", [7, 10, 13])
def test_a_run_that_is_resumed_stops_where_the_unbroken_one_does_with_the_same_embeddings(
    tiny: Path, after: int, options: dict[str, Any]
) -> None:
    options = {"tolerance": 0.3, **options}
    unbroken, trainer = fit(tiny, 60, every=after, **options)
    resumed, again = fit(tiny, 60, resume=f"kept/step={after}.ckpt", **options)
    assert again.global_step == trainer.global_step < 60
    for name, concept in unbroken.learned().items():
        other = resumed.learned()[name]
        assert torch.equal(concept.embeddings, other.embeddings)
        assert concept.origin == other.origin


@pytest.mark.parametrize("options", [{"tolerance": 0.3, "omega": "learned"}, {"modes": "each"}], ids=str)
def test_a_checkpoint_of_embeddings_without_an_axis_of_knots_is_resumed_to_the_same_result(
    tiny: Path, options: dict[str, Any]
) -> None:
    unbroken, trainer = fit(tiny, 30, every=13, **options)
    content = torch.load("kept/step=13.ckpt", weights_only=True)
    moments = content["optimizer_states"][0]["state"][0]
    names = [name for name, value in content["state_dict"].items() if value.dim() == 4]
    for tensors, flat in ((content["state_dict"], names), (moments, ["exp_avg", "exp_avg_sq"])):
        tensors |= {name: tensors[name].flatten(-2) for name in flat}
    assert len(names) == (3 if "tolerance" in options else 1)
    torch.save(content, "flat.ckpt")
    resumed, again = fit(tiny, 30, resume="flat.ckpt", **options)
    assert again.global_step == trainer.global_step
    for name, concept in unbroken.learned().items():
        other = resumed.learned()[name]
        assert torch.equal(concept.embeddings, other.embeddings)
        assert torch.equal(concept.weights, other.weights)
        assert concept.origin == other.origin


def test_a_run_that_had_stopped_is_resumed_to_the_same_result(tiny: Path) -> None:
    done, trainer = fit(tiny, 60, every=10, tolerance=0.3)
    resumed, again = fit(tiny, 60, resume=f"kept/step={trainer.global_step}.ckpt", tolerance=0.3)
    assert again.global_step == trainer.global_step < 60
    for name, concept in done.learned().items():
        assert torch.equal(concept.embeddings, resumed.learned()[name].embeddings)


@pytest.mark.parametrize(
    ("changes", "key"), [({"tolerance": 0.2}, "tolerance"), ({"tolerance": None}, "tolerance"), ({"modes": 2}, "modes")], ids=str
)
def test_a_checkpoint_of_another_tolerance_or_of_other_modes_is_refused(tiny: Path, changes: dict[str, Any], key: str) -> None:
    fit(tiny, 3, every=3, tolerance=0.3)
    with pytest.raises(UserError, match=f"ckpt_path: key '{key}': expected"):
        fit(tiny, 3, resume="kept/step=3.ckpt", **{"tolerance": 0.3, **changes})
