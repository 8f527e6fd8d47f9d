"""Images of an episode with random distractor positions in each image.

Few demonstrations have few layouts, and a network memorises demonstrations by their distractors. Random distractors carry no
information (domain randomisation, Tobin et al., 2017). The triangle also lies on book and block, where it looks larger.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.tabletop.scenes import (
    APART,
    BOOK,
    HEIGHT,
    NEEDED,
    PRESENT,
    SIGHT,
    TRIANGLE,
    TRIES,
    WHITE,
    Points,
    anywhere,
    gap,
    outline,
    random_yaw,
    within,
)
from ftl_lightning.domains.tabletop.world import OVERHEAD, turned

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

SURFACES = (BOOK, WHITE)
"""Objects that can carry the triangle."""
RAISED = 0.5
"""Probability of a triangle on a surface, if one is visible."""

Pose = tuple[float, float, float]
"""x, y and yaw."""
HIDDEN: Pose = (-5.0, 0.0, 0.0)
"""Position of objects that an image does not show."""


def scattered(
    env: "TableTopEnvironment", task: str, trace: Sequence[NDArray[np.float64]], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Images ``(time, 3, 64, 64)`` of the overhead camera of a finished episode, and object positions.

    Args:
        env: environment of the episode; its objects are moved.
        task: known task.
        trace: ``trace`` of the episode's last info.
        rng: random generator of positions and visibility.

    Returns:
        Images, and positions ``(time, 5, 4)``, see :meth:`~ftl_lightning.domains.tabletop.environment.TableTopEnvironment.seen`.
    """
    needed = NEEDED[task](np.random.default_rng(0))
    objects = env.bodies.objects
    others = sorted((name for name in objects if name not in needed), key=lambda name: name not in SURFACES)
    pictures, places = [], []
    for moment in trace:
        env.show(moment)
        taken = {name: env.outline(name) for name in objects if name in needed}
        for name in others:
            base, (x, y, yaw) = 0.0, HIDDEN
            if rng.uniform() < PRESENT:
                base, (x, y, yaw) = _free(rng, name, taken)
            env.client.resetBasePositionAndOrientation(objects[name], (x, y, base + HEIGHT[name] / 2), turned(yaw))
            if x != HIDDEN[0]:
                taken[name] = outline(name, x, y, yaw)
        pictures.append(OVERHEAD.picture(env.client).transpose(2, 0, 1))
        places.append(env.seen())
    return np.stack(pictures), np.stack(places)


def _free(rng: np.random.Generator, name: str, taken: Mapping[str, Points]) -> tuple[float, Pose]:
    """Draw a height and a pose without overlap; hidden if none fits."""
    below = [surface for surface in SURFACES if surface in taken] if name == TRIANGLE else []
    if below and rng.uniform() < RAISED:
        under = below[rng.integers(len(below))]
        low, high = taken[under].min(axis=0), taken[under].max(axis=0)
        for _ in range(TRIES):
            x, y = map(float, rng.uniform(low, high))
            pose = (x, y, random_yaw(rng, name))
            points = outline(name, *pose)
            if within(points, taken[under]) and _clear(points, {key: shape for key, shape in taken.items() if key != under}):
                return HEIGHT[under], pose
    low, high = np.transpose(SIGHT)
    for _ in range(TRIES):
        pose = (*anywhere(rng), random_yaw(rng, name))
        points = outline(name, *pose)
        if (points > low).all() and (points < high).all() and _clear(points, taken):
            return 0.0, pose
    return 0.0, HIDDEN


def _clear(points: Points, taken: Mapping[str, Points]) -> bool:
    return all(gap(points, shape) >= APART for shape in taken.values())
