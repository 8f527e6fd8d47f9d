"""Traffic without the simulator: scenario names, observed features and initial states."""

import zlib

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import Feature, InitialStates
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import check_extra

NAME = "driving"
HORIZON = 8
"""States in a plan (paper)."""
MAX_STEPS = 30
"""Maximum number of decisions in an episode."""

FEATURES = ("presence", "x", "y", "vx", "vy", "cos_h", "sin_h")
STATE = len(FEATURES)
STATE_NAMES = tuple(f"ego.{feature}" for feature in FEATURES)
STATE_UNITS = ("1", "m", "m", "m/s", "m/s", "1", "1")
VEHICLES = 5
"""Number of observed vehicles: the controlled vehicle and the four nearest that are not behind it."""
OBSERVED = VEHICLES * STATE
SCENE = OBSERVED + 2
"""Columns of a scene: the initial observation, scenario number and seed."""
TRAFFIC, SCENARIO = "traffic", "scenario"
"""Names of the observed features: vehicles ``(35,)`` and scenario number ``(1,)``, from which views derive the seconds per
decision and whether the road is part of pretraining."""
FEATURES_SEEN = {
    TRAFFIC: Feature((OBSERVED,), entities=tuple(tuple(range(start, start + STATE)) for start in range(STATE, OBSERVED, STATE))),
    SCENARIO: Feature((1,)),
}
SEEDS = 2**24
"""Upper bound of seeds, exact in float32."""

BELIEF, SIMULATION, STEP = "belief", "simulation", "step"
"""Names of the planner's vetoes, see :mod:`ftl_lightning.domains.driving.foresight`."""

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
"""Decisions per second by scenario."""
NAMES = tuple(DECISIONS)
"""Scenario names; scenes contain the index."""


def check_simulator() -> None:
    """Check that highway-env is installed.

    Raises:
        UserError: with the command that installs it.
    """
    check_extra("driving", f"domain {NAME}: its simulator")


def check_scenario(name: str) -> str:
    """Return the name if it is a scenario's.

    Raises:
        UserError: for an unknown name.
    """
    if name not in DECISIONS:
        raise UserError(f"driving task: expected one of {', '.join(NAMES)}, found {name!r}")
    return name


def decision_seconds(name: str) -> float:
    """Seconds between decisions of a scenario.

    Raises:
        UserError: for an unknown name.
    """
    return 1 / DECISIONS[check_scenario(name)]


def episode_seed(seed: int, number: int) -> int:
    """Simulation seed of an episode, below 2^24."""
    return zlib.crc32(f"{seed} {number}".encode()) % SEEDS


def scene(seen: NDArray[np.float32], name: str, seed: int) -> NDArray[np.float32]:
    """Scene ``(..., 37)`` of an initial observation ``(..., 5, 7)``, scenario and seed."""
    hidden = np.broadcast_to(np.array((NAMES.index(name), seed), dtype=np.float32), (*seen.shape[:-2], 2))
    return np.concatenate((seen.reshape(*seen.shape[:-2], OBSERVED), hidden), axis=-1)


def initial_states(scenes: Tensor) -> InitialStates:
    """Initial states of scenes ``(scene, 37)``."""
    return InitialStates({TRAFFIC: scenes[:, :OBSERVED], SCENARIO: scenes[:, OBSERVED : OBSERVED + 1]}, scenes)


def origin(given: NDArray[np.float32]) -> tuple[str, int]:
    """Scenario and seed of a scene.

    Raises:
        UserError: for a wrong size, or numbers that are not a scenario and seed.
    """
    if given.shape != (SCENE,) or not np.isfinite(given).all():
        raise UserError(f"driving scene: expected {SCENE} finite numbers, found shape {given.shape}")
    number, seed = given[OBSERVED:].tolist()
    if number not in range(len(NAMES)) or not (0 <= seed < SEEDS and seed == int(seed)):
        raise UserError(f"driving scene: expected a scenario from 0 to {len(NAMES) - 1} and a seed, found {number:g} and {seed:g}")
    return NAMES[int(number)], int(seed)
