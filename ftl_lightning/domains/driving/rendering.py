"""Pictures from above: roads, vehicles and plans."""

import functools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates, Observed, take
from ftl_lightning.domains.driving.environment import NAMES, SCENARIO, TRAFFIC
from ftl_lightning.domains.driving.scenarios import VEHICLES, make
from ftl_lightning.domains.rollout import Rollout

MAX_COLUMNS = 4
EGO, OTHER, ROAD, PLAN = "#4c9f70", "#3f6fb5", "#d8d8d8", "#e4704a"
LENGTH, WIDTH = 5.0, 2.0
MARGIN = 30.0
"""Metres of road that are shown around what moves."""


@functools.cache
def _lanes(name: str) -> tuple[NDArray[np.float64], ...]:
    """Centre lines ``(points, 2)`` of a scenario's lanes."""
    env = make(name)
    env.reset(seed=0)
    lanes = [
        np.array([lane.position(s, 0) for s in np.linspace(0, min(lane.length, 1000), 60)])
        for lane in env.road.network.lanes_list()
    ]
    env.close()
    return tuple(lanes)


def _draw(axes: Axes, seen: Observed, plan: NDArray[np.float32] | None, around: NDArray[np.float32]) -> None:
    """What is observed in one scene; ``around (points, 2)`` decides what part of the map is shown."""
    low, high = around.min(axis=0) - MARGIN, around.max(axis=0) + MARGIN
    for lane in _lanes(NAMES[int(seen[SCENARIO].item())]):
        axes.plot(*lane.T, color=ROAD, linewidth=3, zorder=0)
    for number, (present, x, y, _, _, cos, sin) in enumerate(seen[TRAFFIC].unflatten(0, (VEHICLES, -1)).tolist()):
        if present:
            along, across = np.array((cos, sin)) * LENGTH / 2, np.array((-sin, cos)) * WIDTH / 2
            corners_around = (along + across, along - across, -along - across, -along + across)
            axes.add_patch(Polygon([(x + dx, y + dy) for dx, dy in corners_around], color=OTHER if number else EGO, zorder=2))
    if plan is not None:
        axes.plot(plan[:, 1], plan[:, 2], ".-", color=PLAN, linewidth=1, markersize=4, zorder=3)
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xticks=[], yticks=[], aspect="equal")  # y points down the page


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """A grid of scenes with the plan from each.

    Args:
        states: plans ``(scene, horizon, 7)``.
        right: not used: plans are judged by what comes of them.
        title: above the grid.
        starts: of the scenes.
    """
    assert starts is not None
    columns = min(len(states), MAX_COLUMNS)
    rows = -(-len(states) // columns)
    figure = Figure(figsize=(2.6 * columns, 1.8 * rows + 0.4), layout="constrained")
    figure.suptitle(title, fontsize=9)
    grid = figure.subplots(rows, columns, squeeze=False).flat
    for number, (axes, plan) in enumerate(zip(grid, states.numpy(), strict=False)):
        _draw(axes, take(starts.observed, number), plan, plan[:, 1:3])
    for axes in figure.axes[len(states) :]:
        axes.set_axis_off()
    return figure


def film(rollout: Rollout, plans: Tensor) -> list[NDArray[np.uint8]]:
    """Pictures ``(height, width, 3)`` of an episode, one a decision, until nothing moves any more.

    What was driven is green; the plan ``(time, 8, 7)`` that decided where to go next is orange.
    """
    episode = take(rollout.observed, 0)
    observations = episode[TRAFFIC]
    moving = (observations[1:, 1:3] - observations[:-1, 1:3]).abs().amax(dim=1) > 0
    end = int(moving.nonzero().max()) + 2 if moving.any() else 1
    ways = observations[:end, 1:3].numpy()
    pictures = []
    for time in range(end):
        figure = Figure(figsize=(3.2, 3.2), dpi=80, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        axes = figure.subplots()
        _draw(axes, take(episode, time), plans[time].numpy() if time < len(plans) else None, ways)
        axes.plot(*ways[: time + 1].T, color=EGO, linewidth=1, zorder=1)
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return pictures
