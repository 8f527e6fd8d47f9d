"""Comparison of generated behaviour: references, novelty and coverage.

*References* are the behaviour of trivial policies and oracles on the same tasks and initial states.

*Novelty* is the mean distance of a generated plan to the nearest demonstration of its concept: 0 for a method that replays
demonstrations. *Coverage* is the mean distance of a fresh sample of the task to the nearest generated plan: lower is better, and a
method that always generates the same plan has a high coverage even if the plan is right. Both use the domain's distance.

Novelty alone means little: wrong plans can be arbitrarily novel. Two references give the scale: *demonstrations replayed* in
turn (right, nothing new) and *fresh samples*, an independent draw of the task (right, as novel as new behaviour is).

Coverage decreases with the number of plans: compare values with an equal column n of the results. The covered samples and the
reference have n samples each.
"""

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import scaled_distance
from ftl_lightning.data.features import InitialStates, check_starts
from ftl_lightning.data.places import first_windows
from ftl_lightning.domains.domain import COVERAGE, NOVELTY, Domain
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.services.errors import require
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import FRESH_SEED
from ftl_lightning.services.tensor_file import bytes_hash

_LOG = logging.getLogger(__name__)

T = TypeVar("T")
REPLAYED, FRESH = "demonstrations replayed", "fresh samples"
"""Names of the references of novelty and coverage."""
KEPT = 500  # plans, rollouts and fresh samples in the cache: several times those of an evaluation
_CACHE: dict[Hashable, Any] = {}
"""Reference behaviour by name and all arguments, shared by the cells of an ablation."""


def _cached(key: Hashable, compute: Callable[[], T]) -> T:
    """Value from the cache, which drops its oldest value when full."""
    if key not in _CACHE:
        if len(_CACHE) >= KEPT:
            del _CACHE[next(iter(_CACHE))]
        _CACHE[key] = compute()
    value: T = _CACHE[key]
    return value


def references(
    judged: Sequence[TaskResult], domain: Domain, seed: int, environments: Sequence[str] = ()
) -> dict[str, list[TaskResult]]:
    """Behaviour of each reference policy by name, executed if the method's behaviour (``judged``) was executed.

    ``environments`` are the alternative environments of that execution.
    """
    loop = None if all(behaviour.rollout is None for behaviour in judged) else domain.closed_loop
    by_policy = {
        name: [_planned(name, like, domain, loop, seed, environments) for like in judged] for name in domain.comparison.references
    }
    if loop is not None:
        for name in loop.policies:
            acted = (_acted(name, like, domain, loop, seed, environments) for like in judged)
            by_policy[name] = [behaviour for behaviour in acted if behaviour is not None]
    return by_policy


def _planned(
    name: str, like: TaskResult, domain: Domain, loop: ClosedLoop | None, seed: int, environments: Sequence[str]
) -> TaskResult:
    """Run a policy that plans once, for the task and initial states of ``like``."""
    task, starts, (count, _, columns) = like.task, like.starts, like.states.shape
    key = (name, domain.name, task.goal, count, _hash(starts), seed)
    plans = _cached(key, partial(domain.comparison.references[name], task.goal, count, starts, seed))
    shape, expected = tuple(plans.shape), (count, domain.plans.horizon, columns)
    require(shape == expected, f"domain {domain.name}, reference {name!r}", f"plans {expected}", shape)
    behaviour = TaskResult.of(task, plans, starts, domain)
    if loop is None:
        return behaviour
    for place in ("", *environments):
        follower = PlanFollower(fixed_plans(plans), loop.act, loop.steps)
        rollout = _cached((*key, place), partial(roll_out, loop.inside(place), check_starts(starts), follower))
        behaviour = behaviour.executed(rollout, domain, place)
    return behaviour


def _acted(
    name: str, like: TaskResult, domain: Domain, loop: ClosedLoop, seed: int, environments: Sequence[str]
) -> TaskResult | None:
    """Run a policy that acts step by step from the initial states of ``like``; ``None`` if it would take too long."""
    task, starts, demonstrations = like.task, check_starts(like.starts), like.demonstrations

    def run(place: str) -> Rollout | None:
        policy = loop.policies[name](task.goal, starts, demonstrations, seed)
        return policy and roll_out(loop.inside(place), starts, policy)

    behaviour, learned_from = like, demonstrations.hash if demonstrations else ""
    for place in ("", *environments):
        key = (name, domain.name, task.goal, learned_from, _hash(starts), seed, place)
        rollout = _cached(key, partial(run, place))
        if rollout is None:
            return None
        behaviour = behaviour.executed(rollout, domain, place)
    return behaviour


def _hash(starts: InitialStates | None) -> str:
    if starts is None:
        return ""
    parts = [*starts.observed.values(), *([] if starts.scenes is None else [starts.scenes])]
    return bytes_hash(b"".join(part.contiguous().numpy().tobytes() for part in parts))


@dataclass(frozen=True)
class Real:
    """Real behaviour of a task, for comparison with generated plans.

    Attributes:
        task: evaluated task.
        domain: domain of the task.
        count: number of generated plans.
        demonstrations: demonstrations of the task's concept; ``None`` if novelty does not apply.
        fresh: two sets of ``count`` real samples, to cover and as a reference; ``None`` if the domain cannot draw any.
    """

    task: EvaluationTask
    domain: Domain
    count: int
    demonstrations: Demonstrations | None = None
    fresh: tuple[Demonstrations, Demonstrations] | None = None

    @classmethod
    def of(cls, generated: TaskResult, domain: Domain, root: Path | None = None, seed: int = 0) -> Self:
        """Collect the real behaviour of a task; arguments as in :func:`real_behaviour`.

        Novelty applies if the demonstrations show the task itself, not to compositions with training concepts or single components.
        Tasks that start in the demonstrations' initial states are not compared: replaying a demonstration solves them.
        """
        task, count, demonstrations = generated.task, len(generated.states), generated.demonstrations
        if task.initial != "new":
            return cls(task, domain, count)
        novel = task.learned == (task.goal,) and demonstrations is not None and len(demonstrations) > 0
        key = (FRESH, domain.name, task.goal, count, root, seed)
        drawn = _cached(key, partial(_draw, domain, task.goal, 2 * count, root, seed))
        fresh = None if drawn is None else (drawn.rows(list(range(count))), drawn.rows(list(range(count, 2 * count))))
        return cls(task, domain, count, demonstrations if novel else None, fresh)

    def values(self, plans: Tensor) -> dict[str, float]:
        """Novelty and coverage of plans ``(sample, horizon, state)`` by name, as far as they apply.

        Without a distance of the domain, columns are scaled by real behaviour. Empty for plans of another length than the domain's,
        such as those of methods that plan step by step: the times would not match.

        Raises:
            UserError: for plans that do not fit the domain's distance, or a distance with an invalid result.
        """
        measured: dict[str, float] = {}
        behaviour = self.fresh[0] if self.fresh else self.demonstrations
        horizon, domain = self.domain.plans.horizon, self.domain
        if behaviour is None or plans.shape[1] != horizon:
            return measured
        distance = domain.comparison.distance or scaled_distance(first_windows(behaviour, horizon), domain.plans.resolution)
        if self.demonstrations is not None:
            measured[NOVELTY] = novelty(domain.distances(plans, first_windows(self.demonstrations, horizon), distance))
        if self.fresh:
            measured[COVERAGE] = coverage(domain.distances(plans, first_windows(self.fresh[0], horizon), distance))
        return measured

    def added(self, judged: TaskResult) -> TaskResult:
        """Add novelty and coverage to generated behaviour."""
        return replace(judged, diversity=self.values(judged.states))

    def replayed(self) -> TaskResult | None:
        """Judge the demonstrations, repeated to ``count`` plans; ``None`` without demonstrations."""
        if self.demonstrations is None:
            return None
        turns = torch.arange(self.count) % len(self.demonstrations)
        return self._judged(self.demonstrations.rows(turns.tolist()))

    def lines(self) -> dict[str, TaskResult]:
        """Judge the references by name: ``count`` replayed demonstrations, and as many fresh samples.

        Replayed demonstrations, whose novelty is 0, are omitted if only novelty is measured.
        """
        judged = {}
        if (self.domain.metrics or self.fresh) and (replayed := self.replayed()) is not None:
            judged[REPLAYED] = replayed
        if self.fresh:
            judged[FRESH] = self._judged(self.fresh[1])
        return judged

    def _judged(self, behaviour: Demonstrations) -> TaskResult:
        starts = behaviour.initial_states if self.domain.observed else None
        plans = first_windows(behaviour, self.domain.plans.horizon)
        return self.added(TaskResult.of(self.task, plans, starts, self.domain))


def novelty(distances: Tensor) -> float:
    """Mean distance of a plan to the nearest demonstration, from distances ``(plan, demonstration)``."""
    return float(distances.amin(dim=1).mean())


def coverage(distances: Tensor) -> float:
    """Mean distance of a fresh sample to the nearest plan, from distances ``(plan, sample)``; adding plans never increases it."""
    return float(distances.amin(dim=0).mean())


def real_behaviour(judged: Sequence[TaskResult], domain: Domain, root: Path | None = None, seed: int = 0) -> list[Real]:
    """Collect the real behaviour of each task of generated behaviour.

    Args:
        judged, domain: generated behaviour, and its domain.
        root: folder of the user's copy of the data.
        seed: seed of the fresh samples.
    """
    behaviour = []
    with bar(f"fresh samples of {len(judged)} tasks", len(judged), lines=False) as advance:
        for generated in judged:
            behaviour.append(Real.of(generated, domain, root, seed))
            advance()
    return behaviour


def lines(real: Sequence[Real]) -> dict[str, list[TaskResult]]:
    """References of all tasks, by name."""
    by_task = [behaviour.lines() for behaviour in real]
    return {name: judged for name in (REPLAYED, FRESH) if (judged := [line[name] for line in by_task if name in line])}


def _draw(domain: Domain, goal: str, count: int, root: Path | None, seed: int) -> Demonstrations | None:
    """Draw fresh samples of a goal; ``None`` if the domain cannot."""
    if not domain.comparison.fresh or not domain.concepts.reads(goal):
        return None
    try:
        return domain.source(root).draw(goal, count, FRESH_SEED + seed)
    except Exception as error:  # any error of a domain's source: accuracy is already known
        _LOG.warning("domain %s: no coverage of %r, of which nothing can be drawn: %r", domain.name, goal, error)
        return None
