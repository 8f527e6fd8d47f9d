"""Pictures of an episode in which what its task does not need lies elsewhere each time.

Few demonstrations show few layouts, and where the distractors lie tells these apart: a network learns them by heart. Distractors
that lie elsewhere in every picture tell nothing (domain randomisation, Tobin et al., 2017).
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.tabletop.scenes import APART, NEEDED, PRESENT, SIGHT, TRIES, Points, anywhere, gap, outline, random_yaw
from ftl_lightning.domains.tabletop.world import OVERHEAD, turned

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

HIDDEN = (-5.0, 0.0, 0.0)
"""Where what a picture does not show is."""


def scattered(
    env: "TableTopEnvironment", task: str, trace: Sequence[NDArray[np.float64]], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The overhead camera's pictures ``(time, 3, 64, 64)`` of an episode that is over.

    Args:
        env: in which it took place; its objects are moved about.
        task: known.
        trace: what the environment told of it.
        rng: draws places, and whether a distractor is seen.
    """
    needed = NEEDED[task](np.random.default_rng(0))
    others = [name for name in env.bodies.objects if name not in needed]
    pictures = []
    for moment in trace:
        env.show(moment)
        taken = [env.outline(name) for name in env.bodies.objects if name in needed]
        for name in others:
            height = env.places()[name][2]
            x, y, yaw = _free(rng, name, taken) if rng.uniform() < PRESENT else HIDDEN
            env.client.resetBasePositionAndOrientation(env.bodies.objects[name], (x, y, height), turned(yaw))
            taken.append(outline(name, x, y, yaw))
        pictures.append(OVERHEAD.picture(env.client).transpose(2, 0, 1))
    return np.stack(pictures)


def _free(rng: np.random.Generator, name: str, taken: Sequence[Points]) -> tuple[float, float, float]:
    """A place where an object overlaps nothing, or out of sight if none is found."""
    low, high = np.transpose(SIGHT)
    for _ in range(TRIES):
        found = (*anywhere(rng), random_yaw(rng, name))
        points = outline(name, *found)
        if (points > low).all() and (points < high).all() and all(gap(points, other) >= APART for other in taken):
            return found
    return HIDDEN
