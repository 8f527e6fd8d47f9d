"""Reference lines: what trivial policies and oracles do on the tasks that were judged, from the same initial states."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.closed_loop import Following, Rollout, fixed_plans, roll_out
from ftl_lightning.evaluation.judged import Judged, executed
from ftl_lightning.tensor_file import bytes_hash

_ROLLOUTS: dict[tuple[str, str, str, int, str, str], Rollout | None] = {}
"""What policies did, by their names and all that it depends on: the cells of an ablation compare with the same."""


def references(
    judged: Sequence[Judged], domain: Domain, demonstrated: Callable[[str], Demonstrations | None], seed: int
) -> dict[str, list[Judged]]:
    """Each reference policy's behaviour by its name; executed where the method's was.

    Args:
        judged: what the method did.
        domain: whose policies they are.
        demonstrated: what a concept was learned from, by its name.
        seed: of the policies.
    """
    loop = None if all(one.rollout is None for one in judged) else domain.closed_loop
    found = {}
    for name, draw in domain.references.items():
        plans = [draw(one.task.goal, len(one.states), one.initial_states, seed) for one in judged]
        own = [Judged.of(one.task, states, one.initial_states, domain) for one, states in zip(judged, plans, strict=True)]
        if loop is not None:
            own = executed(own, Following(fixed_plans(torch.cat(plans)), loop.act, loop.steps), domain)
        found[name] = own
    if loop is None:
        return found
    for name, make in loop.policies.items():
        found[name] = []
        for one in judged:
            assert one.initial_states is not None
            known = demonstrated(one.task.learned) if one.task.learned else None
            key = (name, domain.name, one.task.goal, seed, _hash(one.initial_states), known.hash if known else "")
            if key not in _ROLLOUTS:
                policy = make(one.task.goal, one.initial_states, known, seed)
                _ROLLOUTS[key] = policy and roll_out(loop, one.initial_states, policy)
            if (rollout := _ROLLOUTS[key]) is not None:
                found[name].append(one.executed(rollout, domain))
    return found


def _hash(initial_states: Tensor) -> str:
    return bytes_hash(initial_states.numpy().tobytes())
