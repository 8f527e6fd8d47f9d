"""Generic pictures and films of behaviour: paths in two or three dimensions, or lines over time."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.vector_film import Shape, VectorFilm, some, still
from ftl_lightning.services.text import figure_text

if TYPE_CHECKING:  # importing matplotlib takes half a second
    from matplotlib.figure import Figure

MAX_COLUMNS = 8
MAX_FRAMES = 60
PATH, START, PLAIN, RIGHT, WRONG = "#3f6fb5", "#e4704a", "#8a8a8a", "#2e9e46", "#d03a3a"


def picture(names: Sequence[str]) -> Callable[[Tensor, Sequence[bool] | None, str, InitialStates | None], "Figure"]:
    """Renderer of plans with these columns, see :class:`ftl_lightning.domains.domain.Show`."""

    def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> "Figure":
        return _drawn(names, {"": states}, {"": right}, title)

    return render


def beside(names: Sequence[str]) -> Callable[[Tensor, Tensor, str, Sequence[bool] | None], "Figure"]:
    """Renderer of demonstrations above samples on a shared scale, see :class:`ftl_lightning.domains.domain.Show`."""

    def render(demonstrations: Tensor, samples: Tensor, title: str, right: Sequence[bool] | None) -> "Figure":
        return _drawn(names, {"demonstrations": demonstrations, "samples": samples}, {"samples": right}, title)

    return render


def _drawn(names: Sequence[str], groups: Mapping[str, Tensor], right: Mapping[str, Sequence[bool] | None], title: str) -> "Figure":
    """Draw groups of plans on a shared scale, each from a new row.

    Args:
        names: names of columns.
        groups: plans ``(plan, time, state)`` by label of the group.
        right: whether each plan of a group is right; missing or ``None`` if not judged.
        title: title of the figure.
    """
    from matplotlib.figure import Figure

    states = torch.cat(list(groups.values()))
    columns = min(max(len(plans) for plans in groups.values()), MAX_COLUMNS)
    rows = {name: -(-len(plans) // columns) for name, plans in groups.items()}
    every = sum(rows.values())
    figure = Figure(figsize=(1.6 * columns, 1.6 * every + 0.5), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=9)
    spatial = states.shape[2] == 3 and states.shape[1] > 1
    grid = figure.subplots(every, columns, squeeze=False, subplot_kw={"projection": "3d"} if spatial else {})
    flat = states.flatten(0, 1)
    low, high = flat.amin(dim=0).tolist(), flat.amax(dim=0).tolist()
    first = 0
    for name, plans in groups.items():
        panels = grid[first : first + rows[name]].flatten()
        judged = right.get(name)
        colours = [PLAIN] * len(plans) if judged is None else [RIGHT if good else WRONG for good in judged]
        for axes, plan, colour in zip(panels, plans.numpy(), colours, strict=False):
            if states.shape[2] in (2, 3) and states.shape[1] > 1:
                axes.plot(*plan.T, color=PATH, linewidth=1.2)
                axes.plot(*plan[:1].T, "o", color=START, markersize=3)
                axes.set(**_limits(low, high), box_aspect=None if spatial else 1)
            else:
                axes.set_ylim(_room(min(low), max(high)))  # shared scale
                for column, label in enumerate(names):
                    axes.plot(plan[:, column], ".-" if len(plan) == 1 else "-", linewidth=1, label=figure_text(label))
            lines = states.shape[2] not in (2, 3) or states.shape[1] == 1
            axes.set(xticks=[])
            if not lines or axes is not figure.axes[0]:  # the first panel shows the scale
                axes.set(yticks=[])
            for spine in axes.spines.values():
                spine.set(color=colour, linewidth=2.0)
        for axes in panels[len(plans) :]:
            axes.set_axis_off()
        if name:
            panels[0].set_ylabel(name, fontsize=8)
        first += rows[name]
    if states.shape[2] not in (2, 3) and len(names) <= MAX_COLUMNS:
        figure.axes[0].legend(fontsize=6)
    return figure


def _room(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * max(high - low, 1e-6)
    return low - margin, high + margin


def _limits(low: Sequence[float], high: Sequence[float]) -> dict[str, tuple[float, float]]:
    """Axis limits of equal length, so that circles are round."""
    half = 0.55 * max([b - a for a, b in zip(low, high, strict=True)] + [1e-6])
    middles = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    return {f"{axis}lim": (middle - half, middle + half) for axis, middle in zip("xyz", middles, strict=False)}


def film(states: Tensor) -> list[NDArray[np.uint8]]:
    """Film a plan ``(horizon, 2 or 3)``: at most :data:`MAX_FRAMES` frames ``(height, width, 3)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    plan = states.numpy()
    figure = Figure(figsize=(3, 3), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d") if plan.shape[1] == 3 else figure.add_subplot()
    axes.plot(*plan.T, color="#d8d8d8", linewidth=1)
    line: Any = axes.plot(*plan[:1].T, color=PATH, linewidth=2)[0]
    axes.set(**_limits(plan.min(axis=0).tolist(), plan.max(axis=0).tolist()), xticks=[], yticks=[])
    if plan.shape[1] == 2:
        axes.set_box_aspect(1)
    pictures = []
    for end in np.unique(np.linspace(1, len(plan), min(len(plan), MAX_FRAMES)).astype(int)):
        line.set_data(*plan[:end, :2].T)
        if plan.shape[1] == 3:
            line.set_3d_properties(plan[:end, 2])
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return pictures


SECONDS = 3.0
"""Duration of a film of a plan."""
COLOURS = ("#3f6fb5", "#e4704a", "#4c9f70", "#8a63b3", "#c9a227", "#5b5b5b")


def path_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Film of a path ``(horizon, 2)``, drawn step by step."""
    plan = states.numpy().astype(np.float32)
    limits = _limits(plan.min(axis=0).tolist(), plan.max(axis=0).tolist())
    (left, right), (low, high) = limits["xlim"], limits["ylim"]
    times = some(len(plan), MAX_FRAMES)
    moving, size = plan[times][:, None], right - left
    shapes = (
        still("line", plan, "#c9ced4", 0.008 * size),
        Shape("way", moving, PATH, 0.02 * size),
        Shape("dots", moving, START, 0.025 * size),
    )
    return VectorFilm(shapes, (left, low, right - left, high - low), len(times) / SECONDS)


def line_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Film of columns over time ``(horizon, state)`` on a shared scale from 0 to 1, drawn step by step."""
    plan = states.numpy().astype(np.float32)
    low, high = _room(float(plan.min()), float(plan.max()))
    times = some(len(plan), MAX_FRAMES)
    across = np.linspace(0, 1, len(plan), dtype=np.float32)[times]
    shapes = [
        Shape("way", np.stack((across, (column - low) / (high - low)), axis=-1)[:, None].astype(np.float32), colour, 0.01)
        for column, colour in zip(plan[times].T, itertools.cycle(COLOURS), strict=False)
    ]
    return VectorFilm(shapes, (0.0, 0.0, 1.0, 1.0), len(times) / SECONDS)
