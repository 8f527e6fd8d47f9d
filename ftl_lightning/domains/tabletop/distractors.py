"""Pictures of an episode in which what its task does not need lies elsewhere each time.

Few demonstrations show few layouts, and where the distractors lie tells these apart: a network learns them by heart. Distractors
that lie elsewhere in every picture tell nothing (domain randomisation, Tobin et al., 2017). The triangle also lies on book and
block, where it looks larger.
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
"""On which the triangle may lie."""
RAISED = 0.5
"""How often it does, where one of them is seen."""

Pose = tuple[float, float, float]
"""x, y and yaw."""
HIDDEN: Pose = (-5.0, 0.0, 0.0)
"""Where what a picture does not show is."""


def scattered(
    env: "TableTopEnvironment", task: str, trace: Sequence[NDArray[np.float64]], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Pictures ``(time, 3, 64, 64)`` of the overhead camera of an episode that is over, and what is where in them.

    Args:
        env: in which it took place; its objects are moved about.
        task: known.
        trace: what the environment told of it.
        rng: draws places, and whether a distractor is seen.

    Returns:
        Pictures, and places ``(time, 5, 4)``, see :meth:`~ftl_lightning.domains.tabletop.environment.TableTopEnvironment.seen`.
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
    """A height and a place where an object overlaps nothing, or out of sight if none is found."""
    below = [one for one in SURFACES if one in taken] if name == TRIANGLE else []
    if below and rng.uniform() < RAISED:
        under = below[rng.integers(len(below))]
        low, high = taken[under].min(axis=0), taken[under].max(axis=0)
        for _ in range(TRIES):
            x, y = map(float, rng.uniform(low, high))
            found = (x, y, random_yaw(rng, name))
            points = outline(name, *found)
            if within(points, taken[under]) and _clear(points, {key: one for key, one in taken.items() if key != under}):
                return HEIGHT[under], found
    low, high = np.transpose(SIGHT)
    for _ in range(TRIES):
        found = (*anywhere(rng), random_yaw(rng, name))
        points = outline(name, *found)
        if (points > low).all() and (points < high).all() and _clear(points, taken):
            return 0.0, found
    return 0.0, HIDDEN


def _clear(points: Points, taken: Mapping[str, Points]) -> bool:
    return all(gap(points, other) >= APART for other in taken.values())
