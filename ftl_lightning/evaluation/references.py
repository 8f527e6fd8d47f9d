"""Reference lines: behaviour of trivial policies and oracles on the same tasks and initial states."""

from collections.abc import Callable, Sequence
from typing import Any

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, check_starts
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.evaluation.evaluable import demonstrations_of
from ftl_lightning.evaluation.judged import TaskResult
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import bytes_hash

_KNOWN: dict[tuple[Any, ...], Any] = {}
"""Cache of reference behaviour by name and all arguments, shared by the cells of an ablation."""


def references(
    judged: Sequence[TaskResult],
    domain: Domain,
    demonstrated: Callable[[str], Demonstrations | None],
    seed: int,
    environments: Sequence[str] = (),
) -> dict[str, list[TaskResult]]:
    """Behaviour of each reference policy by name, executed if the method's behaviour was executed.

    Args:
        judged: behaviour of the method.
        domain: domain of the policies.
        demonstrated: function from a concept's name to its demonstrations.
        seed: seed of the policies.
        environments: alternative environments in which the method's behaviour was executed.
    """
    loop = None if all(behaviour.rollout is None for behaviour in judged) else domain.closed_loop
    by_policy = {
        name: [_planned(name, like, domain, loop, seed, environments) for like in judged] for name in domain.comparison.references
    }
    if loop is not None:
        for name in loop.policies:
            acted = (_acted(name, like, domain, loop, demonstrated, seed, environments) for like in judged)
            by_policy[name] = [behaviour for behaviour in acted if behaviour is not None]
    return by_policy


def _planned(
    name: str, like: TaskResult, domain: Domain, loop: ClosedLoop | None, seed: int, environments: Sequence[str]
) -> TaskResult:
    """Run a policy that plans once, for the task and initial states of ``like``."""
    task, starts, (count, _, columns) = like.task, like.starts, like.states.shape
    key = (name, domain.name, task.goal, count, _hash(starts), seed)
    if key not in _KNOWN:
        _KNOWN[key] = domain.comparison.references[name](task.goal, count, starts, seed)
    plans = _KNOWN[key]
    if (expected := (count, domain.plans.horizon, columns)) != tuple(plans.shape):
        raise UserError(f"domain {domain.name}, reference {name!r}: expected plans {expected}, found {tuple(plans.shape)}")
    behaviour = TaskResult.of(task, plans, starts, domain)
    if loop is None:
        return behaviour
    initial = check_starts(starts)
    for place in ("", *environments):
        if (*key, "executed", place) not in _KNOWN:
            follower = PlanFollower(fixed_plans(plans), loop.act, loop.steps)
            _KNOWN[*key, "executed", place] = roll_out(loop.inside(place), initial, follower)
        behaviour = behaviour.executed(_KNOWN[*key, "executed", place], domain, place)
    return behaviour


def _acted(
    name: str,
    like: TaskResult,
    domain: Domain,
    loop: ClosedLoop,
    demonstrated: Callable[[str], Demonstrations | None],
    seed: int,
    environments: Sequence[str],
) -> TaskResult | None:
    """Run a policy that acts step by step from the initial states of ``like``; ``None`` if it would take too long."""
    task, starts = like.task, check_starts(like.starts)
    demonstrations, behaviour = demonstrations_of(task, demonstrated), like
    for place in ("", *environments):
        key = (name, domain.name, task.goal, demonstrations.hash if demonstrations else "", _hash(starts), seed, place)
        if key not in _KNOWN:
            policy = loop.policies[name](task.goal, starts, demonstrations, seed)
            _KNOWN[key] = policy and roll_out(loop.inside(place), starts, policy)
        rollout: Rollout | None = _KNOWN[key]
        if rollout is None:
            return None
        behaviour = behaviour.executed(rollout, domain, place)
    return behaviour


def _hash(starts: InitialStates | None) -> str:
    if starts is None:
        return ""
    parts = [*starts.observed.values(), *([] if starts.scenes is None else [starts.scenes])]
    return bytes_hash(b"".join(part.contiguous().numpy().tobytes() for part in parts))
