"""Top-view pictures of plans, and films of episodes by the simulator."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates, check_starts
from ftl_lightning.domains.agent.dynamics import check_simulator
from ftl_lightning.domains.agent.scenes import COLOURS, OBSERVED, PLANE, REACH, looks, object_positions
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.vector_film import Shape, VectorFilm, regular, some, still
from ftl_lightning.services.text import figure_text

MARKERS = {"cone": "^", "sphere": "o", "bowl": "v", "cube": "s"}
"""Markers; a bowl is an open triangle pointing down."""
CORNERS = {"cone": (3, np.pi / 2), "cube": (4, np.pi / 4)}
"""Number of corners and angle of the first corner."""
SEEN = (-2.1, 2.1), (-4.8, -2.8)
"""Ranges of x and z in pictures."""
MAX_COLUMNS = 4
FRAMES = 40
"""Maximum number of frames of an episode."""


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Draw a grid of top-view scenes with the agent's path.

    Args:
        states: plans ``(scene, horizon, 13)``.
        right: whether the task holds in each scene (green and red frames); ``None`` for grey frames.
        title: title above the grid.
        starts: initial states with ``world (scene, 52)``.
    """
    columns = min(len(states), MAX_COLUMNS)
    rows = -(-len(states) // columns)
    figure = Figure(figsize=(2.6 * columns, 1.3 * rows + 0.4), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=9)
    frames = ["#8a8a8a"] * len(states) if right is None else ["#2e9e46" if good else "#d03a3a" for good in right]
    grid = figure.subplots(rows, columns, squeeze=False).flat
    for axes, plan, initial, frame in zip(grid, states, check_starts(starts).observed[OBSERVED], frames, strict=False):
        _scene(axes, plan, initial, frame)
    for axes in figure.axes[len(states) :]:
        axes.set_axis_off()
    return figure


def _scene(axes: Axes, plan: Tensor, initial: Tensor, frame: str) -> None:
    places = object_positions(initial[None])[0][:, list(PLANE)].tolist()
    for (colour, shape), (x, z) in zip(looks(initial.tolist()), places, strict=True):
        shade = [value / 255 for value in COLOURS[colour]]
        axes.plot(x, z, MARKERS[shape], color=shade, fillstyle="none" if shape == "bowl" else "full", markersize=9, mew=2)
        angle = np.linspace(0, 2 * np.pi, 48)
        axes.plot(x + REACH * np.cos(angle), z + REACH * np.sin(angle), color="#c0c0c0", linewidth=0.6)
    x, z = plan[:, list(PLANE)].T.tolist()
    axes.plot(x, z, color="#303030", linewidth=1)
    axes.plot(initial[0].item(), initial[2].item(), "^", color="#c79a2b", markersize=7)
    axes.set(xlim=SEEN[0], ylim=SEEN[1], xticks=[], yticks=[], aspect="equal")
    for spine in axes.spines.values():
        spine.set(color=frame, linewidth=2.0)


def _end(observations: Tensor) -> int:
    """Number of steps ``(step, 3 or more)`` until nothing moves any more."""
    moving = (observations[1:, :3] - observations[:-1, :3]).abs().amax(dim=1) > 0
    return int(moving.nonzero().max()) + 2 if moving.any() else 1


def film(rollout: Rollout, plans: Tensor) -> list[NDArray[np.uint8]]:
    """Film an episode: at most :data:`FRAMES` frames ``(height, width, 3)``, until nothing moves any more.

    Plans are not drawn: the simulator renders the frames.
    """
    check_simulator()
    from ftl_lightning.domains.agent.environment import AgentEnvironment

    observations = rollout.observed[OBSERVED][0]
    times = some(_end(observations), FRAMES)
    environment = AgentEnvironment()
    pictures = []
    for time in times:
        environment.reset(options={"scene": observations[time].numpy()})
        pictures.append(environment.render())
    environment.close()
    return pictures


SIZE = 0.1
"""Half the width of a body in metres."""
AGENT = "#c79a2b"
STEPS_A_SECOND = 30.0
"""Simulation steps per second of a vector film: 1.5 times real time."""


def vector_film(rollout: Rollout) -> VectorFilm:
    """Top-view film of an episode, until nothing moves any more."""
    observations = rollout.observed[OBSERVED][0]
    return from_above(observations[0], observations)


def plan_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Top-view film of a plan or demonstration ``(time, 13)``, until nothing moves any more."""
    return from_above(check_starts(starts).observed[OBSERVED][0], states)


def from_above(world: Tensor, states: Tensor) -> VectorFilm:
    """Top-view film of a scene and the agent's path; the agent is the last shape.

    Args:
        world: ``(52,)``.
        states: ``(time, 3 or more)``; the first three columns are the agent's position.
    """
    end = _end(states)
    times = some(end, FRAMES)
    agent = states[times][:, list(PLANE)].numpy()[:, None]
    shapes = []
    for (colour, shape), at in zip(looks(world.tolist()), object_positions(world[None])[0].numpy(), strict=True):
        place, shade = at[list(PLANE)], "#{:02x}{:02x}{:02x}".format(*COLOURS[colour])
        shapes.append(still("line", regular(48, REACH)[[*range(48), 0]] + place, "#a8adb3", 0.01))
        if shape in CORNERS:
            corners, turn = CORNERS[shape]
            shapes.append(still("area", regular(corners, 1.35 * SIZE, turn) + place, shade))
        else:
            shapes.append(Shape("dots", place[None, None].astype(np.float32), shade, SIZE, filled=shape == "sphere"))
    shapes += [Shape("way", agent, AGENT, 0.025), Shape("dots", agent, AGENT, 0.07)]
    (left, right), (low, high) = SEEN
    return VectorFilm(shapes, (left, low, right - left, high - low), STEPS_A_SECOND * len(times) / end)
