"""Success criteria of tasks, from poses alone."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.tabletop.scenes import BOOK, CIRCLE, COLUMNS, HEIGHT, TARGET, TRIANGLE, WHITE, outline, support, within
from ftl_lightning.domains.tabletop.tasks import BESIDE, PUSH_ON_BOOK, PUSHES, TO_BOOK, check_task

BOOK_MOVED = 0.02
"""Displacement in metres above which the book counts as moved."""
LEVEL = 0.008
"""Tolerance in metres of the circle's height on a surface."""
NEAR = 0.15
"""Maximum centre distance in metres between the circle and the object beside it."""


def judged(task: str, scene: NDArray[np.float32], told: Mapping[str, Any]) -> bool:
    """Whether a task is done.

    - Pushes to the triangle: circle and triangle touch (see the environment's ``TOUCH``); both are still on their initial surface.
    - Pushes to another object: the circle has touched only this object, and lies on the table.
    - Picks to the book and to the white surface: the circle was lifted and released; it lies on the surface, its centre over it.
    - Picks beside an object: the circle was lifted and released; it lies on the table, its centre within :data:`NEAR` of it.

    Args:
        task: known task.
        scene: ``(24,)``, initial scene.
        told: info of the environment's last step; empty if there was none.
    """
    check_task(task)
    if not told:
        return False
    circle = told["circle"]
    if task in PUSHES and TARGET[task] != TRIANGLE:
        return set(told["touches"]) == {TARGET[task]} and _lies(circle, 0.0)
    if task in PUSHES:
        surface = HEIGHT[BOOK] if task == PUSH_ON_BOOK else support(scene, CIRCLE)
        both = (circle, told["triangle"])
        return bool(told["touched"]) and all(place is not None and _lies(place, surface) for place in both)
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
    """Whether the centre of circle or triangle has the height of flat contact with a surface."""
    return abs(float(place[2]) - surface - HEIGHT[CIRCLE] / 2) <= LEVEL


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Judge episodes.

    Returns:
        ``(episode,)`` each: ``success``; ``book moved``, by more than 2 cm.
    """
    scenes = rollout.starts.require_scenes().numpy()
    success = [judged(goal, scene, info) for scene, info in zip(scenes, rollout.infos, strict=True)]
    moved = [info.get("book", 0.0) > BOOK_MOVED for info in rollout.infos]
    return {"success": torch.tensor(success) & ~rollout.failed, "book moved": torch.tensor(moved)}
