"""Novelty and coverage, which complement accuracy.

*Novelty* is the mean distance of a generated plan to the nearest demonstration of its concept: 0 for a method that replays
demonstrations. *Coverage* is the mean distance of a fresh sample of the task to the nearest generated plan: lower is better, and a
method that always generates the same plan has a high coverage even if the plan is right. Both use the domain's distance.

Novelty alone means little: wrong plans can be arbitrarily novel. Two reference lines give the scale: *demonstrations replayed* in
turn (right, nothing new) and *fresh samples*, an independent draw of the task (right, as novel as new behaviour is).

Coverage decreases with the number of plans: compare values with an equal column n of the results. The covered samples and the
reference line have n samples each.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.domains.distances import Distance, scaled_distance
from ftl_lightning.domains.domain import COVERAGE, NOVELTY, Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.evaluable import demonstrations_of
from ftl_lightning.evaluation.judged import TaskResult
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import FRESH_SEED

_LOG = logging.getLogger(__name__)

REPLAYED, FRESH = "demonstrations replayed", "fresh samples"
"""Names of the reference lines."""
_DRAWN: dict[tuple[Any, ...], Demonstrations | None] = {}
"""Cache of fresh samples by their arguments, shared by all methods."""


@dataclass(frozen=True)
class Real:
    """Real behaviour of a task, for comparison with generated plans.

    Attributes:
        task: evaluated task.
        domain: domain of the task.
        count: number of generated plans.
        demonstrations: demonstrations of the task's concept; ``None`` if novelty does not apply.
        fresh: ``count`` samples of the task to cover, and ``count`` more; ``None`` if the domain cannot draw any.
    """

    task: EvaluationTask
    domain: Domain
    count: int
    demonstrations: Demonstrations | None
    fresh: tuple[Demonstrations, Demonstrations] | None

    @classmethod
    def of(
        cls,
        task: EvaluationTask,
        domain: Domain,
        count: int,
        demonstrations: Demonstrations | None,
        root: Path | None = None,
        seed: int = 0,
    ) -> Self:
        """Collect the real behaviour of a task.

        Novelty applies if the demonstrations show the task itself, not to compositions with training concepts or single components.
        Nothing is compared for tasks that start in the demonstrations' initial states, where replaying a demonstration is right.

        Args:
            task: evaluated task.
            domain: domain of the task.
            count: number of generated plans.
            demonstrations: demonstrations of the task's learned concept, if any.
            root: folder of the user's copy of the data.
            seed: seed of the fresh samples.
        """
        if task.initial != "new":
            return cls(task, domain, count, None, None)
        shown = task.learned == (task.goal,) and demonstrations is not None and len(demonstrations) > 0
        drawn = _drawn(domain, task.goal, 2 * count, root, seed)
        fresh = None if drawn is None else (drawn.rows(list(range(count))), drawn.rows(list(range(count, 2 * count))))
        return cls(task, domain, count, demonstrations if shown else None, fresh)

    def _distance(self, behaviour: Demonstrations) -> Distance:
        """The domain's distance, or a distance with columns scaled by real behaviour."""
        if self.domain.distance is not None:
            return self.domain.distance
        return scaled_distance(self._windows(behaviour), self.domain.plans.resolution)

    def _windows(self, demonstrations: Demonstrations) -> Tensor:
        """First windows of plan length ``(demo, horizon, state)``."""
        rows = torch.arange(len(demonstrations))
        return demonstrations.windows(rows, torch.zeros_like(rows), self.domain.plans.horizon)[0]

    def values(self, plans: Tensor) -> dict[str, float]:
        """Novelty and coverage of plans ``(sample, horizon, state)`` by name, as far as they apply.

        Empty for plans of another length than the domain's, such as those of methods that plan step by step: the times would not
        match.

        Raises:
            UserError: for plans that do not fit the domain's distance, or a distance with an invalid result.
        """
        measured: dict[str, float] = {}
        behaviour = self.fresh[0] if self.fresh else self.demonstrations
        if behaviour is None or plans.shape[1] != self.domain.plans.horizon:
            return measured
        distance = self._distance(behaviour)
        if self.demonstrations is not None:
            known = self._windows(self.demonstrations)
            measured[NOVELTY] = novelty(self.domain.distances(plans, known, distance))
        if self.fresh:
            measured[COVERAGE] = coverage(self.domain.distances(plans, self._windows(self.fresh[0]), distance))
        return measured

    def lines(self) -> dict[str, TaskResult]:
        """Judge the reference lines, ``count`` replayed demonstrations and fresh samples, by name.

        Replayed demonstrations are omitted if only novelty is measured, as their novelty is 0.
        """
        judged = {}
        if (self.domain.metrics or self.fresh) and (replayed := self.replayed()) is not None:
            judged[REPLAYED] = replayed
        if self.fresh:
            judged[FRESH] = self._judged(self.fresh[1])
        return judged

    def replayed(self) -> TaskResult | None:
        """Judge ``count`` plans that repeat the demonstrations in turn; ``None`` without demonstrations."""
        if self.demonstrations is None:
            return None
        turns = torch.arange(self.count) % len(self.demonstrations)
        return self._judged(self.demonstrations.rows(turns.tolist()))

    def _judged(self, behaviour: Demonstrations) -> TaskResult:
        starts = behaviour.initial_states if self.domain.observed else None
        return self.added(TaskResult.of(self.task, self._windows(behaviour), starts, self.domain))

    def added(self, judged: TaskResult) -> TaskResult:
        """Add novelty and coverage to generated behaviour."""
        return judged.compared(self.values(judged.states))


def novelty(distances: Tensor) -> float:
    """Mean distance of a plan to the nearest demonstration, from distances ``(plan, demonstration)``."""
    return float(distances.amin(dim=1).mean())


def coverage(distances: Tensor) -> float:
    """Mean distance of a fresh sample to the nearest plan, from distances ``(plan, sample)``; adding plans never increases it."""
    return float(distances.amin(dim=0).mean())


def real_behaviour(
    judged: Sequence[TaskResult],
    domain: Domain,
    demonstrated: Callable[[str], Demonstrations | None],
    root: Path | None = None,
    seed: int = 0,
) -> list[Real]:
    """Collect the real behaviour of each task.

    Args:
        judged: generated behaviour.
        domain: domain of the tasks.
        demonstrated: function from a concept's name to its demonstrations.
        root: folder of the user's copy of the data.
        seed: seed of the fresh samples.
    """
    behaviour = []
    with bar(f"fresh samples of {len(judged)} tasks", len(judged), lines=False) as advance:
        for generated in judged:
            known = demonstrations_of(generated.task, demonstrated)
            behaviour.append(Real.of(generated.task, domain, len(generated.states), known, root, seed))
            advance()
    return behaviour


def lines(real: Sequence[Real]) -> dict[str, list[TaskResult]]:
    """Reference lines of all tasks, by name."""
    by_task = [behaviour.lines() for behaviour in real]
    return {name: judged for name in (REPLAYED, FRESH) if (judged := [line[name] for line in by_task if name in line])}


def _drawn(domain: Domain, goal: str, count: int, root: Path | None, seed: int) -> Demonstrations | None:
    """Draw fresh samples of a goal; ``None`` if the domain cannot."""
    if not domain.fresh or not domain.concepts.reads(goal):
        return None
    key = (domain.name, goal, count, root, seed)
    if key not in _DRAWN:
        try:
            _DRAWN[key] = domain.source(root).draw(goal, count, FRESH_SEED + seed)
        except Exception as error:  # any error of a domain's source: accuracy is already known
            _LOG.warning("domain %s: no coverage of %r, of which nothing can be drawn: %r", domain.name, goal, error)
            _DRAWN[key] = None
    return _DRAWN[key]
