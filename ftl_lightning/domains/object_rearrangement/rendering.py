"""Pictures of scenes with a green frame if the task holds, else red (as in the paper's figures)."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, RegularPolygon
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.object_rearrangement.relations import EXTENT, PER_SHAPE, SHAPES
from ftl_lightning.domains.vector_film import VectorFilm, regular, still
from ftl_lightning.services.text import figure_text

COLOURS = {"circle": "#e4704a", "triangle": "#4c9f70", "square": "#4a78c8"}
CORNERS = {"triangle": 3, "square": 4}
MAX_COLUMNS = 8
MARGIN = 1.0
"""Margin: the largest radius."""


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None = None) -> Figure:
    """Draw a grid of scenes.

    Args:
        states: ``(scene, 1, 21)`` in the domain's units.
        right: whether the task holds in each scene (green and red frames); ``None`` for grey frames.
        title: title above the grid.
        starts: unused.
    """
    columns = min(len(states), MAX_COLUMNS)
    rows = -(-len(states) // columns)
    figure = Figure(figsize=(1.5 * columns, 1.5 * rows + 0.4), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=9)
    frames = ["#8a8a8a"] * len(states) if right is None else ["#2e9e46" if good else "#d03a3a" for good in right]
    for axes, state, frame in zip(figure.subplots(rows, columns, squeeze=False).flat, states[:, 0], frames, strict=False):
        _scene(axes, state, frame)
    for axes in figure.axes[len(states) :]:
        axes.set_axis_off()
    return figure


def _scene(axes: Axes, state: Tensor, frame: str) -> None:
    for shape, (x, y, radius, angle, *_) in zip(SHAPES, state.unflatten(0, (len(SHAPES), PER_SHAPE)).tolist(), strict=True):
        colour = COLOURS[shape]
        size = max(radius, 0.0)
        if shape in CORNERS:
            axes.add_patch(RegularPolygon((x, y), CORNERS[shape], radius=size, orientation=angle, color=colour))
        else:
            axes.add_patch(Circle((x, y), size, color=colour))
    axes.set(xlim=(-MARGIN, EXTENT + MARGIN), ylim=(-MARGIN, EXTENT + MARGIN), xticks=[], yticks=[], aspect="equal")
    for spine in axes.spines.values():
        spine.set(color=frame, linewidth=2.5)


def vector_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Still film of a scene ``(1, 21)``."""
    shapes = []
    for shape, (x, y, radius, angle, *_) in zip(SHAPES, states[0].unflatten(0, (len(SHAPES), PER_SHAPE)).tolist(), strict=True):
        size = max(radius, 0.0)
        if shape in CORNERS:
            turned = math.pi / 2 + angle  # like matplotlib, whose polygons begin at the top
            shapes.append(still("area", regular(CORNERS[shape], size, turned) + np.array((x, y)), COLOURS[shape]))
        else:
            shapes.append(still("dots", [(x, y)], COLOURS[shape], size))
    return VectorFilm(shapes, (-MARGIN, -MARGIN, EXTENT + 2 * MARGIN, EXTENT + 2 * MARGIN), 1.0)
