"""Reference lines: what trivial policies and oracles do on the tasks that were judged, from the same initial states."""

from collections.abc import Callable, Sequence
from typing import Any

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates, expect_starts
from ftl_lightning.domains.domain import ClosedLoop, Domain
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.evaluation.evaluable import demonstrations_of
from ftl_lightning.evaluation.judged import Judged
from ftl_lightning.tensor_file import bytes_hash

_KNOWN: dict[tuple[Any, ...], Any] = {}
"""What they did, by their names and all that it depends on: the cells of an ablation compare with the same."""


def references(
    judged: Sequence[Judged],
    domain: Domain,
    demonstrated: Callable[[str], Demonstrations | None],
    seed: int,
    environments: Sequence[str] = (),
) -> dict[str, list[Judged]]:
    """Each reference policy's behaviour by its name; executed where the method's was.

    Args:
        judged: what the method did.
        domain: whose policies they are.
        demonstrated: what a concept was learned from, by its name.
        seed: of the policies.
        environments: of the domain's others, in which the method's was executed besides its own.
    """
    loop = None if all(one.rollout is None for one in judged) else domain.closed_loop
    lines = {name: [_planned(name, one, domain, loop, seed, environments) for one in judged] for name in domain.references}
    if loop is not None:
        for name in loop.policies:
            acted = (_acted(name, one, domain, loop, demonstrated, seed, environments) for one in judged)
            lines[name] = [one for one in acted if one is not None]
    return lines


def _planned(name: str, one: Judged, domain: Domain, loop: ClosedLoop | None, seed: int, environments: Sequence[str]) -> Judged:
    """A policy that makes its plan once."""
    key = (name, domain.name, one.task.goal, len(one.states), _hash(one.starts), seed)
    if key not in _KNOWN:
        _KNOWN[key] = domain.references[name](one.task.goal, len(one.states), one.starts, seed)
    plans = _KNOWN[key]
    if (expected := (len(one.states), domain.plans.horizon, one.states.shape[2])) != tuple(plans.shape):
        raise UserError(f"domain {domain.name}, reference {name!r}: expected plans {expected}, found {tuple(plans.shape)}")
    planned = Judged.of(one.task, plans, one.starts, domain)
    if loop is None:
        return planned
    starts = expect_starts(one.starts)
    for place in ("", *environments):
        if (*key, "executed", place) not in _KNOWN:
            follower = PlanFollower(fixed_plans(plans), loop.act, loop.steps)
            _KNOWN[*key, "executed", place] = roll_out(loop.inside(place), starts, follower)
        planned = planned.executed(_KNOWN[*key, "executed", place], domain, place)
    return planned


def _acted(
    name: str,
    one: Judged,
    domain: Domain,
    loop: ClosedLoop,
    demonstrated: Callable[[str], Demonstrations | None],
    seed: int,
    environments: Sequence[str],
) -> Judged | None:
    """A policy that acts as it goes; ``None`` where it would take too long."""
    starts = expect_starts(one.starts)
    known = demonstrations_of(one.task, demonstrated)
    for place in ("", *environments):
        key = (name, domain.name, one.task.goal, known.hash if known else "", _hash(starts), seed, place)
        if key not in _KNOWN:
            policy = loop.policies[name](one.task.goal, starts, known, seed)
            _KNOWN[key] = policy and roll_out(loop.inside(place), starts, policy)
        rollout: Rollout | None = _KNOWN[key]
        if rollout is None:
            return None
        one = one.executed(rollout, domain, place)
    return one


def _hash(starts: InitialStates | None) -> str:
    if starts is None:
        return ""
    parts = [*starts.observed.values(), *([] if starts.scenes is None else [starts.scenes])]
    return bytes_hash(b"".join(part.contiguous().numpy().tobytes() for part in parts))
