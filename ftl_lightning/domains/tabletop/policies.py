"""Reference policies of pushes: the expert, an expert without height, and an expert without feedback, from the same starts."""

import logging
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.execution import Policy
from ftl_lightning.domains.tabletop.experts import PUSH_HEIGHT, perform
from ftl_lightning.domains.tabletop.interface import ACTION, check_simulator
from ftl_lightning.domains.tabletop.tasks import PUSH, PUSH_ON_BOOK, TASKS, check_task
from ftl_lightning.services.errors import UserError

_LOG = logging.getLogger(__name__)

_Make = Callable[[str, InitialStates, Demonstrations | None, int], Policy | None]


def _repeated(tasks: tuple[str, ...], height: float | None = None, feedback: bool = True) -> _Make:
    """Policy that replays actions of an expert, recorded in a separate simulation; bitwise equal to running the expert.

    Args:
        tasks: tasks with this reference.
        height, feedback: see :func:`ftl_lightning.domains.tabletop.experts.moves`.
    """

    def make(goal: str, starts: InitialStates, known: Demonstrations | None, seed: int) -> Policy | None:
        if check_task(goal) not in tasks:
            return None
        check_simulator()
        from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

        actions: list[Tensor] = []
        env = TableTopEnvironment()
        try:
            for row, scene in enumerate(starts.require_scenes().numpy()):
                try:
                    done = perform(env, goal, scene, np.random.default_rng([seed, row]), height, feedback)
                    actions.append(torch.from_numpy(done.actions))
                except (UserError, MemoryError, OSError):
                    raise
                except Exception as error:  # any error of the simulator: other episodes continue
                    _LOG.warning("table-top %r, episode %d: %r; the reference line has no action there", goal, row, error)
                    actions.append(torch.full((1, ACTION), torch.nan))
                    env.close()
                    env = TableTopEnvironment()
        finally:
            env.close()
        return lambda observed, rows, step: torch.stack([actions[row][min(step, len(actions[row]) - 1)] for row in rows])

    return make


POLICIES = {
    "expert (oracle)": _repeated(TASKS),
    "table-height push": _repeated((PUSH_ON_BOOK,), height=PUSH_HEIGHT),
    "straight push": _repeated((PUSH, PUSH_ON_BOOK), feedback=False),
}
"""``table-height push`` pushes on the book at table height; ``straight push`` has no feedback."""
