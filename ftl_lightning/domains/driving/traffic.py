"""What of traffic is known without the simulator: the scenarios by name, what is observed in them, and where episodes start."""

import zlib

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.features import Feature, InitialStates
from ftl_lightning.errors import UserError
from ftl_lightning.extras import expect_extra

NAME = "driving"
HORIZON = 8
"""States in a plan; the paper's number."""
MAX_STEPS = 30
"""Decisions of an episode at most."""

FEATURES = ("presence", "x", "y", "vx", "vy", "cos_h", "sin_h")
STATE = len(FEATURES)
STATE_NAMES = tuple(f"ego.{feature}" for feature in FEATURES)
STATE_UNITS = ("1", "m", "m", "m/s", "m/s", "1", "1")
VEHICLES = 5
"""Of which states are observed: the controlled vehicle and the four nearest that it does not have behind it."""
OBSERVED = VEHICLES * STATE
SCENE = OBSERVED + 2
"""Columns of a scene: what is observed at its start, the scenario's number, and the seed of the start."""
TRAFFIC, SCENARIO = "traffic", "scenario"
"""Names of the observed features: vehicles ``(35,)`` and the scenario's number ``(1,)``, by which views know the time between two
decisions and which road is one of pretraining."""
FEATURES_SEEN = {
    TRAFFIC: Feature((OBSERVED,), entities=tuple(tuple(range(start, start + STATE)) for start in range(STATE, OBSERVED, STATE))),
    SCENARIO: Feature((1,)),
}
SEEDS = 2**24
"""Seeds are below, so that float32 holds them exactly."""

BELIEF, SIMULATION, STEP = "belief", "simulation", "step"
"""The planner's vetoes by name, see :mod:`ftl_lightning.domains.driving.foresight`."""

DECISIONS = {
    "highway": 1,
    "exit": 1,
    "merge": 1,
    "intersection": 2,
    "roundabout": 1,
    "roundabout third exit": 1,
    "roundabout of three lanes": 1,
    "roundabout of one lane": 1,
}
"""Decisions a second, by scenario."""
NAMES = tuple(DECISIONS)
"""The scenarios; a scene knows its own by the number."""


def expect_simulator() -> None:
    """Refuse to go on without highway-env.

    Raises:
        UserError: with the command that installs it.
    """
    expect_extra("driving", f"domain {NAME}: its simulator")


def expect_scenario(name: str) -> str:
    """The name itself.

    Raises:
        UserError: for one that is no scenario's.
    """
    if name not in DECISIONS:
        raise UserError(f"driving task: expected one of {', '.join(NAMES)}, found {name!r}")
    return name


def decision_seconds(name: str) -> float:
    """Seconds between two decisions.

    Raises:
        UserError: for a name that is no scenario's.
    """
    return 1 / DECISIONS[expect_scenario(name)]


def episode_seed(seed: int, number: int) -> int:
    """Seed of the simulation of an episode, below 2^24."""
    return zlib.crc32(f"{seed} {number}".encode()) % SEEDS


def scene(seen: NDArray[np.float32], name: str, seed: int) -> NDArray[np.float32]:
    """The 37 numbers of a start ``(..., 5, 7)`` of this scenario and seed."""
    hidden = np.broadcast_to(np.array((NAMES.index(name), seed), dtype=np.float32), (*seen.shape[:-2], 2))
    return np.concatenate((seen.reshape(*seen.shape[:-2], OBSERVED), hidden), axis=-1)


def initial_states(scenes: Tensor) -> InitialStates:
    """Scenes ``(scene, 37)`` and what is observed in them."""
    return InitialStates({TRAFFIC: scenes[:, :OBSERVED], SCENARIO: scenes[:, OBSERVED : OBSERVED + 1]}, scenes)


def origin(given: NDArray[np.float32]) -> tuple[str, int]:
    """Scenario and seed of a scene.

    Raises:
        UserError: for another size, or numbers that are none of a scenario and seed.
    """
    if given.shape != (SCENE,) or not np.isfinite(given).all():
        raise UserError(f"driving scene: expected {SCENE} finite numbers, found shape {given.shape}")
    number, seed = given[OBSERVED:].tolist()
    if number not in range(len(NAMES)) or not (0 <= seed < SEEDS and seed == int(seed)):
        raise UserError(f"driving scene: expected a scenario from 0 to {len(NAMES) - 1} and a seed, found {number:g} and {seed:g}")
    return NAMES[int(number)], int(seed)
