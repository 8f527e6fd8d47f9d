"""Pictures: plans from above, and films of episodes with the plans in them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.tabletop.interface import THRESHOLD, expect_simulator
from ftl_lightning.domains.tabletop.scenes import BOOK, CIRCLE, SIGHT, WHITE, outlines
from ftl_lightning.domains.tabletop.world import COLOUR, FRONT
from ftl_lightning.escape import figure_text

MAX_COLUMNS = 4
FRAMES = 60
"""At most, of an episode."""
_OPEN, _CLOSED = (0, 150, 255), (255, 0, 90)
"""Of a plan's places in a film, by what the gripper does there."""


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """A grid of tables from above with the hand's way, as far as it is planned.

    Args:
        states: plans ``(sample, horizon, 4)``.
        right: whether the task holds, one entry a sample (green and red frames); ``None`` for grey frames.
        title: above the grid.
        starts: with scenes, whose objects are drawn; without, the ways alone.
    """
    columns = min(len(states), MAX_COLUMNS)
    rows = -(-len(states) // columns)
    figure = Figure(figsize=(2.2 * columns, 1.8 * rows + 0.4), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=9)
    frames = ["#8a8a8a"] * len(states) if right is None else ["#2e9e46" if good else "#d03a3a" for good in right]
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for number, (axes, plan) in enumerate(zip(grid, states, strict=False)):
        scene = None if starts is None or starts.scenes is None else starts.scenes[number].numpy()
        _table(axes, plan.cpu().numpy(), scene, frames[number])
    for axes in grid[len(states) :]:
        axes.set_axis_off()
    return figure


def _table(axes: Axes, plan: NDArray[np.float32], scene: NDArray[np.float32] | None, frame: str) -> None:
    placed = {} if scene is None else outlines(scene)
    for name in sorted(placed, key=(BOOK, WHITE).__contains__, reverse=True):  # what lies on the book is drawn after it
        points = placed[name][:, ::-1]  # y to the left and x up, as the camera sees it
        axes.add_patch(Polygon(points, facecolor=COLOUR[name], edgecolor="#404040" if name != CIRCLE else "none", linewidth=0.5))
    axes.plot(plan[:, 1], plan[:, 0], color="#d0006f", linewidth=1.2)
    axes.plot(plan[0, 1], plan[0, 0], "o", color="#d0006f", markersize=3)
    (low, high), (right, left) = SIGHT
    axes.set(xlim=(left, right), ylim=(low, high), xticks=[], yticks=[], aspect="equal", facecolor="#d9cfc0")
    for spine in axes.spines.values():
        spine.set(color=frame, linewidth=2.0)


def film(rollout: Rollout, plans: Tensor) -> list[NDArray[np.uint8]]:
    """At most :data:`FRAMES` pictures ``(240, 320, 3)`` of an episode from the front, with the plan that was followed then.

    Args:
        rollout: of one episode.
        plans: ``(step, horizon, 4)``; blue where the gripper is to be open, red where it is to be closed.
    """
    expect_simulator()
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

    trace = rollout.infos[0].get("trace", [])
    times = np.unique(np.linspace(0, max(len(trace) - 1, 0), FRAMES).round().astype(int))
    env = TableTopEnvironment(arm_drawn=True)
    pictures = []
    try:
        env.reset(options={"scene": rollout.starts.require_scenes()[0].numpy()})
        for time in times:
            if trace:
                env.show(trace[time])
            pictures.append(_with_plan(env.render(), plans[min(time, len(plans) - 1)].numpy()))
    finally:
        env.close()
    return pictures


def _with_plan(picture: NDArray[np.uint8], plan: NDArray[np.float32]) -> NDArray[np.uint8]:
    drawn, (height, width) = picture.copy(), picture.shape[:2]
    if not np.isfinite(plan).all():
        return drawn
    for (column, row), opening in zip(FRONT.pixels(plan[:, :3].astype(np.float64)), plan[:, 3], strict=True):
        x, y = round(float(column)), round(float(row))
        if 1 <= x < width - 1 and 1 <= y < height - 1:
            drawn[y - 1 : y + 2, x - 1 : x + 2] = _OPEN if opening > THRESHOLD else _CLOSED
    return drawn
