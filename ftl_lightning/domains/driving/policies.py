"""Reference policies: what one decision always, chance, a look-up and the expert achieve from the same starts."""

from collections.abc import Callable

import torch

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import Policy
from ftl_lightning.domains.driving.environment import STATE, TRAFFIC, origin
from ftl_lightning.domains.driving.generation import episode
from ftl_lightning.domains.driving.scenarios import make
from ftl_lightning.domains.driving.shipped import training_set
from ftl_lightning.domains.driving.tasks import TRAINING_CONCEPTS
from ftl_lightning.seeding import generator

SHOWN = 100
"""Demonstrations of a training scenario that the look-up knows."""


def _decision(goal: str, name: str) -> float:
    return float(make(goal).action_type.actions_indexes[name])


def _always(name: str) -> Callable[[str, InitialStates, Demonstrations | None, int], Policy]:
    """The same decision, replaced by a random one that does not crash where it would."""

    def policy(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
        number = _decision(goal, name)
        return lambda observed, rows, step: torch.full((len(rows), 1), number)

    return policy


def _random(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """Any decision, replaced likewise."""
    count = int(make(goal).action_space.n)
    draws = [generator("cpu", seed, row) for row in range(len(starts))]
    return lambda observed, rows, step: torch.stack([torch.randint(count, (1,), generator=draws[row]).float() for row in rows])


def _nearest(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """What comes next in the demonstration that was nearest to what is seen now, from here."""
    known = training_set("train", SHOWN).select(goal) if demonstrations is None else demonstrations
    pairs = [(row, time) for row, length in enumerate(known.lengths.tolist()) for time in range(length - 1)]
    seen = torch.stack([known.observed[TRAFFIC][row, time, :STATE] for row, time in pairs])
    following = torch.stack([known.states[row, time + 1] for row, time in pairs])
    return lambda observed, rows, step: following[torch.cdist(observed[TRAFFIC][:, :STATE], seen).argmin(dim=1)]


def _expert(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy | None:
    """The expert's next state; not in the training scenarios, where it takes minutes (its rates there are in the data card)."""
    if goal in TRAINING_CONCEPTS:
        return None
    drives = [torch.from_numpy(episode(*origin(start))[0][:, 0]) for start in starts.require_scenes().numpy()]
    return lambda observed, rows, step: torch.stack([drives[row][min(step + 1, len(drives[row]) - 1)] for row in rows])


POLICIES = {
    "IDLE": _always("IDLE"),
    "random": _random,
    "FASTER": _always("FASTER"),
    "nearest demonstration": _nearest,
    "expert (oracle)": _expert,
}
"""All pass the planner's veto of crashes."""
