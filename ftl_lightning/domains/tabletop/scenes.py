"""Scenes: 24 numbers, of each object (present, x, y, yaw) and of the initial hand (x, y, z, yaw), in metres and radians.

The robot's base is the origin, the table's top is z = 0.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.tabletop.interface import (
    AROUND_BOWL,
    BESIDE,
    BESIDE_BOOK,
    BESIDE_BOWL,
    BESIDE_TRIANGLE,
    BESIDE_WHITE,
    LIFT,
    PUSH,
    PUSH_ON_BOOK,
    PUSH_TO_BOOK,
    PUSH_TO_BOWL,
    PUSH_TO_WHITE,
    PUSHES,
    TO_BOOK,
    TO_BOWL,
    TO_TRIANGLE,
    TO_WHITE,
    check_task,
)
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.randomness import task_key

CIRCLE, TRIANGLE, BOOK, WHITE, BOWL = OBJECTS = ("green circle", "orange triangle", "book", "white surface", "purple bowl")
COLUMNS = {name: slice(4 * number, 4 * number + 4) for number, name in enumerate(OBJECTS)}
"""Columns (present, x, y, yaw) of each object."""
HAND = slice(4 * len(OBJECTS), 4 * len(OBJECTS) + 4)  # Columns (x, y, z, yaw) of the hand
SCENE = HAND.stop

TARGET = {
    TO_BOOK: BOOK,
    TO_WHITE: WHITE,
    BESIDE_BOWL: BOWL,
    BESIDE_TRIANGLE: TRIANGLE,
    BESIDE_BOOK: BOOK,
    BESIDE_WHITE: WHITE,
    TO_TRIANGLE: TRIANGLE,
    TO_BOWL: BOWL,
    LIFT: CIRCLE,
    PUSH: TRIANGLE,
    AROUND_BOWL: TRIANGLE,
    PUSH_ON_BOOK: TRIANGLE,
    PUSH_TO_BOWL: BOWL,
    PUSH_TO_WHITE: WHITE,
    PUSH_TO_BOOK: BOOK,
}
"""Object to which a task brings the circle; the circle itself for the lift."""
BESIDE_AT = {BOWL: 0.12, TRIANGLE: 0.12, WHITE: 0.16, BOOK: 0.2}
"""Centre distance in metres between an object and the circle placed beside it; leaves room for open fingers."""

RADIUS = {CIRCLE: 0.025, BOWL: 0.05, TRIANGLE: 0.07 / math.sqrt(3)}
"""Radii of circle and bowl, and circumradius of the triangle with sides of 7 cm."""
SIZE = {BOOK: (0.22, 0.16), WHITE: (0.13, 0.13)}
HEIGHT = {CIRCLE: 0.03, TRIANGLE: 0.03, BOOK: 0.03, WHITE: 0.06, BOWL: 0.045}
WORKSPACE = ((0.36, 0.66), (-0.24, 0.24))  # x and y ranges of the centres of circle and triangle
SIGHT = ((0.22, 0.78), (-0.34, 0.34))  # x and y ranges that contain every object: seen by the camera, not touched by the arm
START = ((0.39, 0.45), (-0.03, 0.03), (0.17, 0.23), (-0.1, 0.1))  # Ranges of the hand's initial pose
RING = RADIUS[BOWL] + RADIUS[CIRCLE] + 0.028  # Radius in metres of the circle's path around the bowl
BOWL_BESIDE = (0.008, 0.03)
"""Range in metres of the bowl's offset from the line from circle to triangle; its side decides which path is shorter."""
APART = 0.002  # Minimum gap in metres between objects

Points = NDArray[np.float64]  # Corners (n, 2) of a convex outline, counter-clockwise


def outline(name: str, x: float, y: float, yaw: float) -> Points:
    """Outline from above; circles are polygons of 24 corners."""
    if name in SIZE:
        length, width = SIZE[name]
        corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (length / 2, width / 2)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return corners @ np.array([(cos, sin), (-sin, cos)]) + (x, y)
    count = 3 if name == TRIANGLE else 24
    angles = yaw + 2 * math.pi * np.arange(count) / count
    return RADIUS[name] * np.stack((np.cos(angles), np.sin(angles)), axis=-1) + (x, y)


def _normals(points: Points) -> Points:
    along = np.roll(points, -1, axis=0) - points
    return np.stack((along[:, 1], -along[:, 0]), axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)


def gap(first: Points, second: Points) -> float:
    """Gap between convex outlines in metres: negative for overlap, a lower bound of the distance between corners."""
    pairs = ((first, second, _normals(first)), (second, first, _normals(second)))
    return float(max(((b @ normals.T).min(axis=0) - (a @ normals.T).max(axis=0)).max() for a, b, normals in pairs))


def within(inner: Points, outer: Points) -> bool:
    """Whether an outline lies inside another."""
    normals = _normals(outer)
    return bool(((inner @ normals.T).max(axis=0) <= (outer @ normals.T).max(axis=0) + 1e-9).all())


def outlines(scene: NDArray[np.float32]) -> dict[str, Points]:
    """Outlines of the objects of a scene, by name."""
    return {name: outline(name, *map(float, scene[columns][1:])) for name, columns in COLUMNS.items() if scene[columns][0] > 0.5}


def support(scene: NDArray[np.float32], name: str) -> float:
    """Height in metres of the surface under an object: the book's top or the table's."""
    placed = outlines(scene)
    on_book = name in (CIRCLE, TRIANGLE) and BOOK in placed and within(placed[name], placed[BOOK])
    return HEIGHT[BOOK] if on_book else 0.0


def check(scene: Sequence[float] | NDArray[np.float32]) -> NDArray[np.float32]:
    """Validate a scene and return it as an array.

    A ``UserError`` for a wrong size, numbers that are not finite, no circle, objects that overlap (circle and triangle may lie on
    the book, as a whole) or leave the workspace, or a hand outside its initial range.
    """
    array = np.asarray(scene, dtype=np.float32)
    require(array.shape == (SCENE,), "table-top scene", f"{SCENE} numbers", f"shape {array.shape}")
    require(np.isfinite(array).all(), "table-top scene", "finite numbers", "others")
    for name, columns in COLUMNS.items():
        allowed, present = (1,) if name == CIRCLE else (0, 1), array[columns][0]
        require(present in allowed, f"table-top scene: {name}, present", " or ".join(map(str, allowed)), f"{present:g}")
    placed = outlines(array)
    for name, points in placed.items():
        free = name in (CIRCLE, TRIANGLE)
        where = array[COLUMNS[name]][None, 1:3] if free else points
        for axis, values, (low, high) in zip("xy", where.T, WORKSPACE if free else SIGHT, strict=True):
            if values.min() < low - 1e-6 or values.max() > high + 1e-6:
                outside = values.min() if values.min() < low else values.max()
                raise UserError(f"table-top scene: {name} leaves the workspace: expected {axis} {low}..{high}, found {outside:.3f}")
    for second, name in itertools.combinations(placed, 2):
        if name == BOOK and second in (CIRCLE, TRIANGLE) and within(placed[second], placed[BOOK]):
            continue  # on the book
        if (distance := gap(placed[name], placed[second])) < APART:
            raise UserError(f"table-top scene: {second} and {name} overlap: expected {APART} m between them, found {distance:.3f}")
    for axis, value, (low, high) in zip(("x", "y", "z", "yaw"), array[HAND], START, strict=True):
        require(low - 1e-6 <= value <= high + 1e-6, "table-top scene: hand", f"{axis} {low}..{high}", f"{value:.3f}")
    return array


Rng = np.random.Generator
Pose = tuple[float, float, float]  # x, y and yaw
_Placed = dict[str, Pose]  # Poses by object name
PRESENT = 0.7  # Probability of a distractor, if it fits; without distractors the image reveals the task
TRIES = 30  # Maximum number of positions tried per object


def anywhere(rng: Rng) -> tuple[float, float]:
    """Draw a position ``(x, y)`` in the workspace."""
    return float(rng.uniform(*WORKSPACE[0])), float(rng.uniform(*WORKSPACE[1]))


def random_yaw(rng: Rng, name: str) -> float:
    """Draw a yaw in radians; boxes are roughly aligned with the table."""
    return float(rng.uniform(-0.4, 0.4)) if name in SIZE else float(rng.uniform(-math.pi, math.pi))


def _pick(rng: Rng, target: str) -> _Placed:
    return {name: (*anywhere(rng), random_yaw(rng, name)) for name in (CIRCLE, target)}


def _pair(rng: Rng, near: float, far: float) -> _Placed:
    """Draw circle and triangle at a distance, in any direction."""
    x, y = anywhere(rng)
    angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(near, far)
    end = (x + distance * math.cos(angle), y + distance * math.sin(angle))
    return {CIRCLE: (x, y, 0.0), TRIANGLE: (float(end[0]), float(end[1]), random_yaw(rng, TRIANGLE))}


def _push_to(rng: Rng, target: str, near: float, far: float) -> _Placed:
    """Draw circle and target at a centre distance."""
    placed = _pair(rng, near, far)
    x, y, _ = placed.pop(TRIANGLE)
    return {**placed, target: (x, y, random_yaw(rng, target))}


def _around(rng: Rng) -> _Placed:
    """Draw the bowl between circle and triangle, with room for the circle's path."""
    while True:
        placed = _pair(rng, 0.23, 0.30)
        start, end = (np.array(placed[name][:2]) for name in (CIRCLE, TRIANGLE))
        along = (end - start) / np.linalg.norm(end - start)
        across = np.array([-along[1], along[0]])
        beside = rng.choice((-1, 1)) * rng.uniform(*BOWL_BESIDE)
        bowl = (start + end) / 2 + rng.uniform(-0.02, 0.02) * along + beside * across
        farthest = bowl - np.sign(beside) * RING * across
        if all(low <= value <= high for value, (low, high) in zip(farthest, WORKSPACE, strict=True)):
            return {**placed, BOWL: (float(bowl[0]), float(bowl[1]), 0.0)}


def _on_book(rng: Rng) -> _Placed:
    placed = _pair(rng, 0.09, 0.15)
    middle = np.mean([placed[name][:2] for name in (CIRCLE, TRIANGLE)], axis=0) + rng.uniform(-0.03, 0.03, 2)
    return {**placed, BOOK: (float(middle[0]), float(middle[1]), random_yaw(rng, BOOK))}


NEEDED: Mapping[str, Callable[[Rng], _Placed]] = {
    TO_BOOK: partial(_pick, target=BOOK),
    TO_WHITE: partial(_pick, target=WHITE),
    BESIDE_BOWL: partial(_pick, target=BOWL),
    BESIDE_TRIANGLE: partial(_pick, target=TRIANGLE),
    BESIDE_BOOK: partial(_pick, target=BOOK),
    BESIDE_WHITE: partial(_pick, target=WHITE),
    TO_TRIANGLE: partial(_pick, target=TRIANGLE),
    TO_BOWL: partial(_pick, target=BOWL),
    LIFT: partial(_pick, target=CIRCLE),
    PUSH: partial(_pair, near=0.12, far=0.24),
    PUSH_TO_BOWL: partial(_push_to, target=BOWL, near=0.14, far=0.26),
    PUSH_TO_WHITE: partial(_push_to, target=WHITE, near=0.17, far=0.28),
    PUSH_TO_BOOK: partial(_push_to, target=BOOK, near=0.19, far=0.30),
    AROUND_BOWL: _around,
    PUSH_ON_BOOK: _on_book,
}
"""Random poses of the objects that a task needs, not yet validated."""


def _way(placed: _Placed, target: str, half_width: float) -> Points:
    """Area swept by the hand in a straight push of the circle to an object."""
    start, end = (np.array(placed[name][:2]) for name in (CIRCLE, target))
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    across = np.array([-along[1], along[0]]) * half_width
    behind = start - 0.09 * along
    return np.stack((behind - across, end - across, end + across, behind + across))


def _clear(task: str, placed: _Placed) -> bool:
    """Whether a task is feasible: needed objects are in place, and no object is in the way."""
    shapes = {name: outline(name, *pose) for name, pose in placed.items()}
    needed = set(NEEDED[task](np.random.default_rng(0)))
    on_book = task == PUSH_ON_BOOK
    if on_book and not (within(shapes[CIRCLE], shapes[BOOK]) and within(shapes[TRIANGLE], shapes[BOOK])):
        return False
    for name, shape in shapes.items():
        room = 0.10 if name == WHITE else 0.06
        for second, points in shapes.items():
            if name == second or (on_book and BOOK in (name, second) and {name, second} & {CIRCLE, TRIANGLE}):
                continue
            near = room if CIRCLE in (name, second) or {BOOK, WHITE, BOWL} >= {name, second} else 0.03
            if task in PUSHES and {CIRCLE, TARGET[task]} == {name, second}:
                near = 0.02 if TARGET[task] == TRIANGLE else 0.04  # required by the task
            if {CIRCLE, BOWL} == {name, second} and task == AROUND_BOWL:
                near = 0.03
            if task in BESIDE and second == TARGET[task]:
                near = 0.10  # goal of the circle
            if gap(shape, points) < near:
                return False
        if task in PUSHES and name not in needed:
            half = 0.17 if task == AROUND_BOWL else 0.10 if name == WHITE else 0.06
            if gap(shape, _way(placed, TARGET[task], half)) < 0:
                return False
    return True


def draw_scene(task: str, rng: Rng) -> NDArray[np.float32]:
    """Draw a scene of a task: needed objects, and distractors where they fit."""
    while True:
        placed = NEEDED[task](rng)
        hand = [float(rng.uniform(*limits)) for limits in START]
        if _clear(task, placed) and _valid(placed, hand):
            break
    for name in OBJECTS:
        if name in placed or rng.uniform() > PRESENT:
            continue
        for _ in range(TRIES):
            more = {**placed, name: (*anywhere(rng), random_yaw(rng, name))}
            if _clear(task, more) and _valid(more, hand):
                placed = more
                break
    return scene_of(placed, hand)


def scene_of(placed: Mapping[str, Pose], hand: Sequence[float] = (0.42, 0.0, 0.2, 0.0)) -> NDArray[np.float32]:
    """Numbers of a scene, without validation, from x, y and yaw of the present objects, and x, y, z and yaw of the hand."""
    scene = np.zeros(SCENE, dtype=np.float32)
    for name, pose in placed.items():
        scene[COLUMNS[name]] = (1, *pose)
    scene[HAND] = hand
    return scene


def _valid(placed: _Placed, hand: Sequence[float]) -> bool:
    try:
        check(scene_of(placed, hand))
    except UserError:
        return False
    return True


def scenes(task: str, count: int, seed: int) -> Tensor:
    """Draw scenes of a task ``(count, 24)``; smaller counts give the first scenes of larger ones."""
    check_task(task)
    drawn = [draw_scene(task, np.random.default_rng([seed, task_key(task), number])) for number in range(count)]
    return torch.from_numpy(np.stack(drawn))


SURFACES = (BOOK, WHITE)  # Objects that can carry the triangle
RAISED = 0.5  # Probability of a triangle on a surface, if one is visible
CLOSE = 0.05  # Maximum distance in metres, in x and y, of an object from the lifted circle that covers it

HIDDEN: Pose = (-5.0, 0.0, 0.0)  # Position of objects that an image does not show


def free_pose(
    rng: np.random.Generator, name: str, taken: Mapping[str, Points], near: NDArray[np.float64] | None = None
) -> tuple[float, Pose]:
    """Draw height and pose of a distractor without overlap; :data:`HIDDEN` if none fits. The triangle may lie on a surface.

    ``near (2,)``, in metres: the pose is drawn on the table around it, up to :data:`CLOSE` in x and in y.
    """
    below = [surface for surface in SURFACES if surface in taken] if name == TRIANGLE else []
    if below and near is None and rng.uniform() < RAISED:
        under = below[rng.integers(len(below))]
        low, high = taken[under].min(axis=0), taken[under].max(axis=0)
        for _ in range(TRIES):
            x, y = map(float, rng.uniform(low, high))
            pose = (x, y, random_yaw(rng, name))
            points = outline(name, *pose)
            if within(points, taken[under]) and _apart(points, {key: shape for key, shape in taken.items() if key != under}):
                return HEIGHT[under], pose
    low, high = np.transpose(SIGHT)
    for _ in range(TRIES):
        x, y = anywhere(rng) if near is None else map(float, near + rng.uniform(-CLOSE, CLOSE, 2))
        pose = (x, y, random_yaw(rng, name))
        points = outline(name, *pose)
        if (points > low).all() and (points < high).all() and _apart(points, taken):
            return 0.0, pose
    return 0.0, HIDDEN


def _apart(points: Points, taken: Mapping[str, Points]) -> bool:
    return all(gap(points, shape) >= APART for shape in taken.values())
