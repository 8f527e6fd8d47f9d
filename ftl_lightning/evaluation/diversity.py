"""Novelty and coverage: what accuracy does not see.

*Novelty* is the mean distance of a generated plan to the nearest demonstration of the concept that it was learned from: 0 for a
method that replays them. *Coverage* is the mean distance of fresh behaviour of the task to the nearest generated plan: less is
better, and a method that generates one plan again and again has a large one however right that is. Both in the domain's distance.

Neither is read alone: wrong plans are as novel as you like. Two lines stand beside every number: *demonstrations replayed* in turn
(right, nothing new) and *fresh samples*, an independent draw of the task (right, and as novel as new behaviour is).

Coverage falls with the number of plans, so that numbers are comparable where as many plans were generated: the column n of results.
As many samples are drawn to be covered, and as many for the line.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.distances import Distance, scaled_distance
from ftl_lightning.domains.domain import COVERAGE, NOVELTY, Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.evaluable import demonstrations_of
from ftl_lightning.evaluation.judged import TaskResult
from ftl_lightning.progress import bar
from ftl_lightning.seeding import FRESH_SEED

_LOG = logging.getLogger(__name__)

REPLAYED, FRESH = "demonstrations replayed", "fresh samples"
"""Names of the reference lines."""
_DRAWN: dict[tuple[Any, ...], Demonstrations | None] = {}
"""Fresh behaviour by all that decides it: every method is compared with the same."""


@dataclass(frozen=True)
class Real:
    """Real behaviour of one task, which generated plans are compared with.

    Attributes:
        task: that it shows.
        domain: whose it is.
        count: of plans that are generated.
        demonstrations: that the task's concept was learned from; ``None`` where a plan is not to be like them.
        fresh: ``count`` samples of the task that are to be covered, and as many others; ``None`` where none can be drawn.
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
        """What there is.

        A plan is to be like the demonstrations, though none of them, where the task is what they show: not where it is composed
        with training concepts, nor generated from a single component. Where behaviour starts in the demonstrations' initial states,
        there is nothing to compare: there a good plan is one of them, and there are as few as they are.

        Args:
            task: what is generated.
            domain: whose task it is.
            count: of plans that are generated.
            demonstrations: of the task's learned concept, if there are any.
            root: folder of the user's copy of the data.
            seed: of the fresh samples.
        """
        if task.initial != "new":
            return cls(task, domain, count, None, None)
        shown = task.learned == (task.goal,) and demonstrations is not None and len(demonstrations) > 0
        drawn = _drawn(domain, task.goal, 2 * count, root, seed)
        fresh = None if drawn is None else (drawn.rows(list(range(count))), drawn.rows(list(range(count, 2 * count))))
        return cls(task, domain, count, demonstrations if shown else None, fresh)

    def _distance(self, behaviour: Demonstrations) -> Distance:
        """The domain's, or that of plans whose columns are scaled as those of real behaviour."""
        if self.domain.distance is not None:
            return self.domain.distance
        return scaled_distance(self._windows(behaviour), self.domain.plans.resolution)

    def _windows(self, demonstrations: Demonstrations) -> Tensor:
        """Their first windows, as long as a plan ``(demo, horizon, state)``."""
        rows = torch.arange(len(demonstrations))
        return demonstrations.windows(rows, torch.zeros_like(rows), self.domain.plans.horizon)[0]

    def values(self, plans: Tensor) -> dict[str, float]:
        """Novelty and coverage of plans ``(sample, horizon, state)``, by name, so far as there is something to compare with.

        Nothing for plans of another length than the domain's, such as those of methods that plan a step at a time: their distances
        would be those of other times.

        Raises:
            UserError: for plans that the domain's distance does not fit, or a distance that returns something else.
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
        """The reference lines by name, judged as a method's plans are: as many demonstrations in turn, and fresh samples.

        Where nothing but novelty is measured, there is nothing to say of demonstrations: theirs is 0.
        """
        judged = {}
        if (self.domain.metrics or self.fresh) and (replayed := self.replayed()) is not None:
            judged[REPLAYED] = replayed
        if self.fresh:
            judged[FRESH] = self._judged(self.fresh[1])
        return judged

    def replayed(self) -> TaskResult | None:
        """As many plans as are generated, which are the demonstrations in turn; ``None`` without any."""
        if self.demonstrations is None:
            return None
        turns = torch.arange(self.count) % len(self.demonstrations)
        return self._judged(self.demonstrations.rows(turns.tolist()))

    def _judged(self, behaviour: Demonstrations) -> TaskResult:
        starts = behaviour.initial_states if self.domain.observed else None
        return self.added(TaskResult.of(self.task, self._windows(behaviour), starts, self.domain))

    def added(self, judged: TaskResult) -> TaskResult:
        """Behaviour with its novelty and coverage."""
        return judged.compared(self.values(judged.states))


def novelty(distances: Tensor) -> float:
    """Mean distance of a plan to the nearest demonstration, of distances ``(plan, demonstration)``."""
    return float(distances.amin(dim=1).mean())


def coverage(distances: Tensor) -> float:
    """Mean distance of a fresh sample to the nearest plan, of distances ``(plan, sample)``; more plans never have a larger one."""
    return float(distances.amin(dim=0).mean())


def real_behaviour(
    judged: Sequence[TaskResult],
    domain: Domain,
    demonstrated: Callable[[str], Demonstrations | None],
    root: Path | None = None,
    seed: int = 0,
) -> list[Real]:
    """The real behaviour that the plans of each task are compared with.

    Args:
        judged: what was generated.
        domain: whose tasks they are.
        demonstrated: what a concept was learned from, by its name.
        root: folder of the user's copy of the data.
        seed: of the fresh samples.
    """
    behaviour = []
    with bar(f"fresh samples of {len(judged)} tasks", len(judged), lines=False) as advance:
        for generated in judged:
            known = demonstrations_of(generated.task, demonstrated)
            behaviour.append(Real.of(generated.task, domain, len(generated.states), known, root, seed))
            advance()
    return behaviour


def lines(real: Sequence[Real]) -> dict[str, list[TaskResult]]:
    """The reference lines of some tasks, by name."""
    by_task = [behaviour.lines() for behaviour in real]
    return {name: judged for name in (REPLAYED, FRESH) if (judged := [line[name] for line in by_task if name in line])}


def _drawn(domain: Domain, goal: str, count: int, root: Path | None, seed: int) -> Demonstrations | None:
    """Fresh samples of a goal; ``None`` where the domain has none."""
    if not domain.fresh or not domain.concepts.reads(goal):
        return None
    key = (domain.name, goal, count, root, seed)
    if key not in _DRAWN:
        try:
            _DRAWN[key] = domain.source(root).draw(goal, count, FRESH_SEED + seed)
        except Exception as error:  # whatever a domain's source raises: accuracy is known already
            _LOG.warning("domain %s: no coverage of %r, of which nothing can be drawn: %r", domain.name, goal, error)
            _DRAWN[key] = None
    return _DRAWN[key]
