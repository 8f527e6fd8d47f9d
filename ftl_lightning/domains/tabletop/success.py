"""When a task is done, from poses alone."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.tabletop.scenes import BOOK, CIRCLE, COLUMNS, HEIGHT, TARGET, TRIANGLE, WHITE, outline, support, within
from ftl_lightning.domains.tabletop.tasks import BESIDE, PUSH_ON_BOOK, PUSHES, TO_BOOK, expect_task

BOOK_MOVED = 0.02
"""Metres beyond which the book counts as moved."""
LEVEL = 0.008
"""Metres by which the height of the circle's centre may be off, where it has to lie on something."""
NEAR = 0.15
"""Metres between the centres of the circle and of what it was put beside."""


def judged(task: str, scene: NDArray[np.float32], told: Mapping[str, Any]) -> bool:
    """Whether a task is done.

    - Pushes to the triangle: circle and triangle touch (see the environment's ``TOUCH``); neither has left the surface on which it
      stood.
    - Pushes to something else: the circle has touched that and nothing else, and lies on the table.
    - To the book and to the white surface: the circle was lifted and let go; it lies on the surface, its centre over it.
    - Beside something: the circle was lifted and let go; it lies on the table, its centre within :data:`NEAR` of that.

    Args:
        task: known.
        scene: ``(24,)``, how it started.
        told: by the environment's last step; empty if there was none.
    """
    expect_task(task)
    if not told:
        return False
    circle = told["circle"]
    if task in PUSHES and TARGET[task] != TRIANGLE:
        return set(told["touches"]) == {TARGET[task]} and _lies(circle, 0.0)
    if task in PUSHES:
        surface = HEIGHT[BOOK] if task == PUSH_ON_BOOK else support(scene, CIRCLE)
        both = (circle, told["triangle"])
        return bool(told["touched"]) and all(one is not None and _lies(one, surface) for one in both)
    if not (told["lifted"] and told["released"]):
        return False
    if task in BESIDE:
        thing = told["triangle"] if TARGET[task] == TRIANGLE else scene[COLUMNS[TARGET[task]]][1:4]
        return _lies(circle, 0.0) and float(np.linalg.norm(circle[:2] - thing[:2])) <= NEAR
    name = BOOK if task == TO_BOOK else WHITE
    x, y, yaw = map(float, scene[COLUMNS[name]][1:])
    moved = told["book place"] if task == TO_BOOK else None
    if moved is not None:
        x, y = float(moved[0]), float(moved[1])
    return _lies(circle, HEIGHT[name]) and within(circle[None, :2], outline(name, x, y, yaw))


def _lies(place: NDArray[np.float64], surface: float) -> bool:
    """Whether the centre of circle or triangle is as high as if it lay flat on a surface."""
    return abs(float(place[2]) - surface - HEIGHT[CIRCLE] / 2) <= LEVEL


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """What happened in episodes.

    Returns:
        ``(episode,)`` each: ``success``; ``book moved``, by more than 2 cm.
    """
    scenes = rollout.starts.require_scenes().numpy()
    success = [judged(goal, scene, told) for scene, told in zip(scenes, rollout.infos, strict=True)]
    moved = [told.get("book", 0.0) > BOOK_MOVED for told in rollout.infos]
    return {"success": torch.tensor(success) & ~rollout.failed, "book moved": torch.tensor(moved)}
