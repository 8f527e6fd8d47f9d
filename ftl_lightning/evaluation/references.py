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
    loop = None if all(generated.rollout is None for generated in judged) else domain.closed_loop
    lines = {
        name: [_planned(name, generated, domain, loop, seed, environments) for generated in judged] for name in domain.references
    }
    if loop is not None:
        for name in loop.policies:
            acted = (_acted(name, generated, domain, loop, demonstrated, seed, environments) for generated in judged)
            lines[name] = [generated for generated in acted if generated is not None]
    return lines


def _planned(
    name: str, generated: Judged, domain: Domain, loop: ClosedLoop | None, seed: int, environments: Sequence[str]
) -> Judged:
    """A policy that makes its plan once."""
    key = (name, domain.name, generated.task.goal, len(generated.states), _hash(generated.starts), seed)
    if key not in _KNOWN:
        _KNOWN[key] = domain.references[name](generated.task.goal, len(generated.states), generated.starts, seed)
    plans = _KNOWN[key]
    if (expected := (len(generated.states), domain.plans.horizon, generated.states.shape[2])) != tuple(plans.shape):
        raise UserError(f"domain {domain.name}, reference {name!r}: expected plans {expected}, found {tuple(plans.shape)}")
    planned = Judged.of(generated.task, plans, generated.starts, domain)
    if loop is None:
        return planned
    starts = expect_starts(generated.starts)
    for place in ("", *environments):
        if (*key, "executed", place) not in _KNOWN:
            follower = PlanFollower(fixed_plans(plans), loop.act, loop.steps)
            _KNOWN[*key, "executed", place] = roll_out(loop.inside(place), starts, follower)
        planned = planned.executed(_KNOWN[*key, "executed", place], domain, place)
    return planned


def _acted(
    name: str,
    generated: Judged,
    domain: Domain,
    loop: ClosedLoop,
    demonstrated: Callable[[str], Demonstrations | None],
    seed: int,
    environments: Sequence[str],
) -> Judged | None:
    """A policy that acts as it goes; ``None`` where it would take too long."""
    starts = expect_starts(generated.starts)
    known = demonstrations_of(generated.task, demonstrated)
    acted = generated
    for place in ("", *environments):
        key = (name, domain.name, generated.task.goal, known.hash if known else "", _hash(starts), seed, place)
        if key not in _KNOWN:
            policy = loop.policies[name](generated.task.goal, starts, known, seed)
            _KNOWN[key] = policy and roll_out(loop.inside(place), starts, policy)
        rollout: Rollout | None = _KNOWN[key]
        if rollout is None:
            return None
        acted = acted.executed(rollout, domain, place)
    return acted


def _hash(starts: InitialStates | None) -> str:
    if starts is None:
        return ""
    parts = [*starts.observed.values(), *([] if starts.scenes is None else [starts.scenes])]
    return bytes_hash(b"".join(part.contiguous().numpy().tobytes() for part in parts))
