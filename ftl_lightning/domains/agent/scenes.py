"""Scenes: objects, goals, pairs of objects per task, the layout of initial states, and constants of the physics.

Axes: x right, y up, z forward; metres. The agent starts at :data:`AGENT_START`; object 1 stands to its right, object 2 to its left.
"""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import Feature
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.randomness import task_key
from ftl_lightning.services.shipped import check_extra

COLOURS = {"red": (255, 87, 34), "yellow": (217, 191, 119), "purple": (149, 56, 158), "green": (148, 252, 19)}
"""RGB colours of the paper, 0 to 255."""
SHAPES = ("cone", "sphere", "bowl", "cube")
TYPES = ("agent", "object 1", "object 2")
TRAINING_CONCEPTS = ("go to red object", "go to yellow object", "go to bowl", "go to cube")

HEIGHT = 0.102  # of centres above the ground
AGENT_START = (0.0, HEIGHT, -3.806)
OBJECT_X, OBJECT_Z = (0.0, 1.66), (-4.355, -3.257)
"""Range of object 1; the range of object 2 is its mirror image in x."""
REACH = 0.365
"""Distance of centres at which an object is reached (paper)."""
AGENT_CLEARANCE, OBJECT_CLEARANCE = 0.55, 0.8
"""Minimum distance between centres in drawn scenes: bodies do not touch, and only one object is within reach."""
LEAST_DISTANCE = 0.2
"""Minimum distance between centres in any scene; nearer bodies would overlap."""

STATE = 13
"""Columns of the agent's state: position 3, quaternion (x, y, z, w) 4, velocity 3, angular velocity 3."""
_TAIL = len(TYPES) + 4 + len(SHAPES)
_OBJECT = 3 + _TAIL
INITIAL = STATE + _TAIL + 2 * _OBJECT
"""Columns of an initial state, 52: the agent's state, type, rgba and shape; each object's position, type, rgba and shape."""
OBJECT_COLUMNS = tuple(slice(start, start + _OBJECT) for start in range(STATE + _TAIL, INITIAL, _OBJECT))
PLANE = (0, 2)  # columns x and z of a position
OBSERVED = "world"  # the observed feature: the agent and both objects
FEATURE = Feature(
    shape=(INITIAL,),
    # Position, colour and shape (as attributes) of each object; the type would break their symmetry.
    entities=tuple(
        (*range(columns.start, columns.start + 3), *range(columns.start + 3 + len(TYPES), columns.stop))
        for columns in OBJECT_COLUMNS
    ),
    attributes=tuple(range(3, 3 + _TAIL - len(TYPES))),
    state=tuple(range(STATE)),
)

STEP = 0.05  # seconds between states
SUBSTEPS = 6
MAX_STEPS = 128
LOOKAHEAD = 5
"""An action is the displacement to the plan's state so many steps ahead (paper: a_t = tau_{t+5} - s_t)."""
DRAG = 16.0
"""Decay rate of the agent's speed per second, high enough to avoid overshooting."""
MASS = LOOKAHEAD * STEP / DRAG
"""Mass in kg with which the displacement in metres, applied as a force in newtons, keeps the agent at the plan's speed: a plan at
speed v is LOOKAHEAD * STEP * v ahead, and drag is MASS * DRAG * v."""
MAX_FORCE = 0.2  # newtons; larger forces are scaled down
RADIUS = {"cone": 0.11, "sphere": HEIGHT, "bowl": 0.13, "cube": HEIGHT}
"""Radius of the bodies' footprints in metres; half the edge of a cube."""
MARGIN = 0.001
"""Gap in metres that the simulator keeps between cone and ground; the ground is lowered by it to avoid hopping."""

TRAINING_GROUPS = (
    tuple(itertools.product(("red", "yellow"), ("cone", "sphere"))),
    tuple(itertools.product(("purple", "green"), ("bowl", "cube"))),
)
"""Colour and shape of pretraining objects; both objects of a training scene belong to the same group (paper)."""
_TRAINING_LOOKS = tuple(itertools.chain(*TRAINING_GROUPS))

Look = tuple[str, str]  # colour and shape


@dataclass(frozen=True)
class Goal:
    """Target attributes: a key of :data:`COLOURS` and a key of :data:`SHAPES`; ``None`` for any."""

    colour: str | None
    shape: str | None

    def matches(self, look: Look) -> bool:
        """Whether a look is that of a target."""
        return self.colour in (None, look[0]) and self.shape in (None, look[1])


_GRAMMAR = re.compile(rf"go to (?:({'|'.join(COLOURS)}) )?(object|{'|'.join(SHAPES)})")


def parse(task: str) -> Goal:
    """Read 'go to red object', 'go to bowl' or 'go to red bowl'; raises a ``UserError`` for anything else."""
    match = _GRAMMAR.fullmatch(task)
    if not match or match.groups() == (None, "object"):
        raise UserError(
            f"agent task: expected 'go to [{'|'.join(COLOURS)}] [object|{'|'.join(SHAPES)}]' with a colour, a shape or both, "
            f"found {task!r}"
        )
    colour, shape = match.groups()
    return Goal(colour, None if shape == "object" else shape)


def pairs(goal: Goal) -> list[tuple[Look, Look]]:
    """Looks of target and distractor for a goal (paper, appendix on data).

    For goals of a single attribute, both are from the same group of pretraining; for goals of two, distractors are from pretraining
    and share an attribute of the target.
    """
    if goal.colour and goal.shape:
        target = (goal.colour, goal.shape)
        return [(target, look) for look in _TRAINING_LOOKS if look != target and (look[0] == target[0] or look[1] == target[1])]
    return [
        (target, distractor)
        for group in TRAINING_GROUPS
        for target, distractor in itertools.permutations(group, 2)
        if goal.matches(target) and not goal.matches(distractor)
    ]


def scenes(task: str, count: int, seed: int) -> Tensor:
    """Draw initial states ``(count, 52)`` of a task, with pairs of looks and sides of the target balanced; deterministic."""
    goal = parse(task)
    # Two streams: fewer scenes are a prefix of more.
    order, place = (np.random.default_rng([seed, task_key(task), stream]) for stream in range(2))
    looks: list[tuple[Look, Look]] = []
    while len(looks) < count:
        both_sides = [pair[::side] for pair in pairs(goal) for side in (1, -1)]
        looks += [both_sides[index] for index in order.permutation(len(both_sides))]
    drawn = [initial_state(pair, _positions(place)) for pair in looks[:count]]
    return torch.from_numpy(np.stack(drawn))


def _positions(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Positions ``(x, z)`` of both objects, uniform subject to clearances."""
    agent = np.array([AGENT_START[0], AGENT_START[2]])
    while True:
        place = np.stack((rng.uniform(*OBJECT_X, 2) * (1, -1), rng.uniform(*OBJECT_Z, 2)), axis=-1)
        to_agent = np.linalg.norm(place - agent, axis=-1).min()
        if to_agent >= AGENT_CLEARANCE and np.linalg.norm(place[0] - place[1]) >= OBJECT_CLEARANCE:
            return [(float(x), float(z)) for x, z in place]


def initial_state(looks: Sequence[Look], positions: Sequence[tuple[float, float]]) -> NDArray[np.float32]:
    """Initial state ``(52,)`` with a resting agent, from looks and positions ``(x, z)`` of objects 1 and 2."""
    state = np.zeros(INITIAL, dtype=np.float32)
    state[:3] = AGENT_START
    state[6] = 1  # no rotation
    state[STATE : STATE + _TAIL] = _tail(0, ("yellow", "cone"))
    for number, (look, (x, z)) in enumerate(zip(looks, positions, strict=True)):
        state[OBJECT_COLUMNS[number]] = (x, HEIGHT, z, *_tail(1 + number, look))
    return state


def _tail(kind: int, look: Look) -> list[float]:
    """One-hot type, rgba and one-hot shape."""
    colour, shape = look
    rgba = [*(value / 255 for value in COLOURS[colour]), 1.0]
    return [*(float(kind == index) for index in range(len(TYPES))), *rgba, *(float(shape == name) for name in SHAPES)]


def looks(initial: Sequence[float] | NDArray[np.float32]) -> list[Look]:
    """Colour and shape of both objects of an initial state."""
    values = np.asarray(initial, dtype=np.float32)
    names = []
    for columns in OBJECT_COLUMNS:
        tail = values[columns][3:]
        rgb = tail[len(TYPES) : len(TYPES) + 3] * 255
        colour = min(COLOURS, key=lambda name: float(np.abs(rgb - COLOURS[name]).sum()))
        names.append((colour, SHAPES[int(tail[-len(SHAPES) :].argmax())]))
    return names


def target(task: str, initial_states: Tensor) -> Tensor:
    """Index of the target ``(scene,)`` in initial states ``(scene, 52)``, int64 0 or 1.

    Raises:
        UserError: if a scene does not contain exactly one target.
    """
    goal = parse(task)
    indices = []
    for row, state in enumerate(initial_states.tolist()):
        matching = [index for index, look in enumerate(looks(state)) if goal.matches(look)]
        if len(matching) != 1:
            both = " and ".join(" ".join(look) for look in looks(state))
            raise UserError(f"agent task {task!r}: expected one target in initial state {row}, found {len(matching)} ({both})")
        indices.append(matching[0])
    return torch.tensor(indices)


def object_positions(initial_states: Tensor) -> Tensor:
    """Positions ``(scene, 2 objects, 3)`` in initial states ``(scene, 52)``."""
    return torch.stack([initial_states[:, columns][:, :3] for columns in OBJECT_COLUMNS], dim=1)


def check(initial: Sequence[float] | NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an initial state as an array.

    Raises:
        UserError: for a wrong size, numbers that are not finite, or bodies that overlap.
    """
    state = np.asarray(initial, dtype=np.float32)
    require(state.shape == (INITIAL,), "initial state", f"{INITIAL} numbers", f"shape {state.shape}")
    require(np.isfinite(state).all(), "initial state", "finite numbers", "others")
    centres = {"the agent": state[:3]} | {f"object {1 + i}": state[columns][:3] for i, columns in enumerate(OBJECT_COLUMNS)}
    for (a, first), (b, second) in itertools.combinations(centres.items(), 2):
        distance = float(np.linalg.norm(first - second))
        expected = f"centres {LEAST_DISTANCE} m apart"
        require(distance >= LEAST_DISTANCE, f"initial state: {a} and {b} overlap", expected, f"{distance:.3f}")
    return state


def check_simulator() -> None:
    """Raise a ``UserError`` with the command that installs pybullet, if it is missing."""
    check_extra("navigation", "domain agent: its simulator")
