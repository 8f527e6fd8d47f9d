"""Driving without the simulator: observations, initial states, tasks, the paper's numbers, and shipped demonstrations."""

import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import Feature, InitialStates
from ftl_lightning.domains.comparison import published
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.services.errors import require
from ftl_lightning.services.shipped import check_extra

NAME = "driving"
HORIZON = 8  # states in a plan (paper)
MAX_STEPS = 30  # decisions in an episode
FEATURES = ("presence", "x", "y", "vx", "vy", "cos_h", "sin_h")
STATE = len(FEATURES)
STATE_NAMES = tuple(f"ego.{feature}" for feature in FEATURES)
STATE_UNITS = ("1", "m", "m", "m/s", "m/s", "1", "1")
VEHICLES = 5
"""Observed vehicles: the controlled vehicle and the four nearest that are not behind it."""
OBSERVED = VEHICLES * STATE
SCENE = OBSERVED + 2
"""Columns of a scene: the initial observation, scenario number and seed."""
TRAFFIC, SCENARIO = "traffic", "scenario"
"""Names of the observed features: vehicles ``(35,)`` and scenario number ``(1,)``, which views read."""
FEATURES_SEEN = {
    TRAFFIC: Feature((OBSERVED,), entities=tuple(tuple(range(start, start + STATE)) for start in range(STATE, OBSERVED, STATE))),
    SCENARIO: Feature((1,)),
}
SEEDS = 2**24  # upper bound, exact in float32
BELIEF, SIMULATION, STEP = "belief", "simulation", "step"
"""Names of the planner's vetoes, see :mod:`ftl_lightning.domains.driving.foresight`."""

TRAINING_CONCEPTS = ("highway", "exit", "merge", "intersection")
OTHER_ROUNDABOUTS = ("roundabout of three lanes", "roundabout of one lane")
RULES = ("red light", "give way", "ramp", "overtake")
WIDE_NAME = "driving_wide"
PRACTICE = ("stop and go", "narrow bridge", "parked car", "lane ends", "stop sign")
WIDE_CONCEPTS = (*TRAINING_CONCEPTS, *PRACTICE)
"""Training concepts of the wide model: also scenarios with rules, none of which is an evaluation task."""
BARRIER = "barrier"
FIRST_EXIT = "first exit"
NAMES = (*TRAINING_CONCEPTS, "roundabout", "roundabout third exit", *OTHER_ROUNDABOUTS, *RULES, *PRACTICE, BARRIER, FIRST_EXIT)
"""Scenario names; scenes contain the index."""


def check_simulator() -> None:
    """Check that highway-env is installed; the ``UserError`` has the command that installs it."""
    check_extra("driving", f"domain {NAME}: its simulator")


def check_scenario(name: str) -> str:
    """Return the name of a scenario; raise a ``UserError`` for any other."""
    require(name in NAMES, "driving task", f"one of {', '.join(NAMES)}", repr(name))
    return name


def decision_seconds(name: str) -> float:
    """Seconds between decisions of a scenario; raises a ``UserError`` for an unknown name."""
    return 0.5 if check_scenario(name) == "intersection" else 1.0


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
    """Scenario and seed of a scene; raises a ``UserError`` for a wrong size, or other numbers."""
    numbers = given.shape == (SCENE,) and np.isfinite(given).all()
    require(numbers, "driving scene", f"{SCENE} finite numbers", f"shape {given.shape}")
    number, seed = given[OBSERVED:].tolist()
    valid = number in range(len(NAMES)) and 0 <= seed < SEEDS and seed == int(seed)
    require(valid, "driving scene", f"a scenario from 0 to {len(NAMES) - 1} and a seed", f"{number:g} and {seed:g}")
    return NAMES[int(number)], int(seed)


NEW = "new initial state"
SUITES = {
    "training": training_suite(TRAINING_CONCEPTS),
    "paper": Suite((EvaluationTask(NEW, "roundabout", learned=("roundabout",)),)),
    "validation": Suite((EvaluationTask(NEW, "roundabout third exit", learned=("roundabout third exit",)),)),
    "more": Suite(tuple(EvaluationTask("new scenario", name, learned=(name,)) for name in RULES)),
    "other roundabouts": Suite(
        tuple(EvaluationTask("other roundabout", name, learned=("roundabout",)) for name in OTHER_ROUNDABOUTS)
    ),
}
"""``validation`` is another route through the same roundabout; ``more`` and ``other roundabouts`` are not used for tuning."""
WIDE_SUITES = SUITES | {
    "training": training_suite(WIDE_CONCEPTS),
    "more": Suite(
        tuple(
            EvaluationTask("new scenario", name, learned=(name,)) for name in (*RULES, "roundabout", FIRST_EXIT, *OTHER_ROUNDABOUTS)
        )
    ),
    "validation": Suite((EvaluationTask("new scenario", BARRIER, learned=(BARRIER,)),)),
}


SHIPPED = Path(__file__).parent / "demonstrations"  # a file of expert episodes per training scenario; see its data card
HELD_OUT = 10  # validation episodes per scenario, the last of its file


def training_set(
    name: Split, count: int, folder: Path | None = None, scenarios: Sequence[str] = TRAINING_CONCEPTS
) -> Demonstrations:
    """The first ``count`` shipped episodes per training scenario, or those of ``folder``; for ``'validation'``, held-out episodes.

    Raises:
        UserError: if there are fewer, or no file.
    """
    parts = []
    for scenario in scenarios:
        shipped = Demonstrations.load((folder or SHIPPED) / f"{scenario}.safetensors")
        rows = list(range(len(shipped)))
        pool = rows[-HELD_OUT:] if name == "validation" else rows[:-HELD_OUT]
        key = "samples_per_concept" if name == "train" else "validation_per_concept"
        require(count <= len(pool), f"data.{key}", f"at most {len(pool)} episodes of {scenario!r}", count)
        parts.append(shipped.rows(pool[:count]))
    return concatenate(parts)


PUBLISHED = published(Path(__file__).parent / "published.csv")
"""The paper's results, comparable with ours for one-step look-ahead; success is passing the roundabout, crashed or not."""
