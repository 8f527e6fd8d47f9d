"""Pictures of plans: the interface, and generic pictures and films of any behaviour from its columns alone."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.films import Frames, Shape, VectorFilm, Wireframe, some, still
from ftl_lightning.services.text import figure_text

if TYPE_CHECKING:  # importing matplotlib takes half a second
    from matplotlib.figure import Figure

DPI = 100  # of a domain's picture
POINTS, LEAST = 2.2, 9.0
"""Font size in points per inch of a picture's width, and minimum font size."""
LETTER, LINE = 0.68, 1.8
"""Width of a bold letter and height of a line, relative to the font size."""
MAX_COLUMNS = 8
MAX_FRAMES = 60
SECONDS = 3.0  # of a film of a plan
PATH, START, PLAIN, RIGHT, WRONG = "#3f6fb5", "#e4704a", "#8a8a8a", "#2e9e46", "#d03a3a"
COLOURS = ("#3f6fb5", "#e4704a", "#4c9f70", "#8a63b3", "#c9a227", "#5b5b5b")


@dataclass(frozen=True)
class Show:
    """Pictures of plans.

    Attributes:
        picture: ``(states (sample, horizon, state), right (sample,) of bool or None if not judged, title, initial states or None)
            -> figure``.
        film: ``states (horizon, state) -> frames`` of a plan; ``None`` for no film.
        wireframe: ``states (horizon, state) -> moving points and lines``, which web pages draw in place of ``film``; ``None`` for
            none.
        vector_film: ``(states (horizon, state), initial state or None) -> film`` of moving shapes for ``report --html``; ``None``
            for the film of the wireframe, if any.
        beside: ``(demonstrations (demo, horizon, state), samples (sample, horizon, state), title, right (sample,) of bool or None)
            -> figure`` of both on a shared scale; ``None`` for one picture above the other.
        exports: writers of other programs' files (``sample --export``) by ending, such as ``'.bvh'``: ``states (horizon, state) ->
            text`` of a plan.
    """

    picture: Callable[[Tensor, Sequence[bool] | None, str, InitialStates | None], "Figure"]
    film: Callable[[Tensor], Frames] | None = None
    wireframe: Callable[[Tensor], Wireframe] | None = None
    vector_film: Callable[[Tensor, InitialStates | None], VectorFilm] | None = None
    beside: Callable[[Tensor, Tensor, str, Sequence[bool] | None], "Figure"] | None = None
    exports: Mapping[str, Callable[[Tensor], str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawn:
    """Group of plans ``(plan, horizon, state)`` in a figure, with initial states and verdicts ``(plan,)`` or ``None``."""

    label: str
    states: Tensor
    starts: InitialStates | None = None
    right: Sequence[bool] | None = None


def beside(show: Show, demonstrations: Drawn, samples: Drawn, title: str) -> "Figure":
    """Draw demonstrations above samples of the same horizon, to check visually whether a concept was learned."""
    if show.beside is not None:
        return show.beside(demonstrations.states, samples.states, title, samples.right)
    from matplotlib.figure import Figure

    groups = (demonstrations, samples)
    pictures = [_pixels(show.picture(group.states, group.right, "", group.starts)) for group in groups]
    texts = [figure_text(text) for text in (title, *(group.label for group in groups))]
    width = max(picture.shape[1] for picture in pictures) / DPI
    size = max(LEAST, min(POINTS * width, *(72 * width / (LETTER * (len(text) + 1)) for text in texts)))  # 72 points are an inch
    line = LINE * size / 72
    heights = [picture.shape[0] / DPI for picture in pictures]
    top = height = sum(heights) + line * len(texts)
    figure = Figure(figsize=(width, height), dpi=DPI)

    def write(text: str, weight: str) -> None:
        figure.text(0.01, (top - line / 2) / height, text, fontsize=size, fontweight=weight, va="center")

    write(texts[0], "bold")
    top -= line
    for text, picture, tall in zip(texts[1:], pictures, heights, strict=True):
        write(text, "normal")
        top -= line + tall
        axes = figure.add_axes((0, top / height, picture.shape[1] / DPI / width, tall / height))
        axes.imshow(picture, aspect="auto")
        axes.set_axis_off()
    return figure


def _pixels(figure: "Figure") -> NDArray[np.uint8]:
    """RGBA ``(height, width, 4)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()


def line_drawings(columns: Sequence[str], units: Sequence[str] = ()) -> Show:
    """Generic pictures of states: paths in two or three dimensions, which are also filmed, otherwise lines over time.

    Of three columns, of which the third alone has another unit, such as a speed, the path of the first two is drawn.
    """
    flat = len(columns) == 3 and len(units) == 3 and units[0] == units[1] != units[2]
    columns = columns[:2] if flat else columns
    shown = slice(len(columns))

    def picture(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> "Figure":
        return _grid(columns, [Drawn("", states[..., shown], right=right)], title)

    def both(demonstrations: Tensor, samples: Tensor, title: str, right: Sequence[bool] | None) -> "Figure":
        groups = [Drawn("demonstrations", demonstrations[..., shown]), Drawn("samples", samples[..., shown], right=right)]
        return _grid(columns, groups, title)

    filmed = path_film if len(columns) == 2 else line_film
    return Show(
        picture,
        (lambda states: film(states[..., shown])) if len(columns) in (2, 3) else None,
        vector_film=lambda states, starts: filmed(states[..., shown], starts),
        beside=both,
    )


def framed(count: int, right: Sequence[bool] | None, title: str, columns: int, size: tuple[float, float]) -> "Figure":
    """Grid of empty panels with equal axes, framed green for right plans, red for wrong ones, grey for plans that are not judged.

    Args:
        count: number of panels.
        right: whether each plan is right ``(count,)``; ``None`` if not judged.
        title: title above the grid.
        columns: maximum number of columns.
        size: width and height of a panel in inches.
    """
    from matplotlib.figure import Figure

    columns = min(count, columns)
    rows = -(-count // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + 0.4), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=9)
    figure.subplots(rows, columns, squeeze=False)
    for axes, colour in zip(figure.axes, frame_colours(count, right), strict=False):
        axes.set(xticks=[], yticks=[], aspect="equal")
        for spine in axes.spines.values():
            spine.set(color=colour, linewidth=2.0)
    for axes in figure.axes[count:]:
        axes.set_axis_off()
    return figure


def frame_colours(count: int, right: Sequence[bool] | None) -> list[str]:
    """Colours of the frames of ``count`` plans: green for right plans, red for wrong ones, grey if they are not judged."""
    return [PLAIN] * count if right is None else [RIGHT if good else WRONG for good in right]


def _grid(names: Sequence[str], groups: Sequence[Drawn], title: str) -> "Figure":
    """Draw groups of plans on a shared scale, each from a new row."""
    from matplotlib.figure import Figure

    states = torch.cat([group.states for group in groups])
    columns = min(max(len(group.states) for group in groups), MAX_COLUMNS)
    rows = [-(-len(group.states) // columns) for group in groups]
    figure = Figure(figsize=(1.6 * columns, 1.6 * sum(rows) + 0.5), layout="constrained")
    figure.suptitle(figure_text(title), fontsize=9)
    paths = states.shape[2] in (2, 3) and states.shape[1] > 1
    spatial = paths and states.shape[2] == 3
    grid = figure.subplots(sum(rows), columns, squeeze=False, subplot_kw={"projection": "3d"} if spatial else {})
    flat = states.flatten(0, 1)
    low, high = flat.amin(dim=0).tolist(), flat.amax(dim=0).tolist()
    for group, count, end in zip(groups, rows, itertools.accumulate(rows), strict=True):
        plans = group.states.numpy()
        panels = grid[end - count : end].flatten()
        for axes, plan, frame in zip(panels, plans, frame_colours(len(plans), group.right), strict=False):
            if paths:
                axes.plot(*plan.T, color=PATH, linewidth=1.2)
                axes.plot(*plan[:1].T, "o", color=START, markersize=3)
                axes.set(**_limits(low, high), box_aspect=None if spatial else 1)
            else:
                axes.set_ylim(_room(min(low), max(high)))  # shared scale
                for column, label in enumerate(names):
                    axes.plot(plan[:, column], ".-" if len(plan) == 1 else "-", linewidth=1, label=figure_text(label))
            axes.set(xticks=[])
            if paths or axes is not figure.axes[0]:  # the first panel shows the scale
                axes.set(yticks=[])
            for spine in axes.spines.values():
                spine.set(color=frame, linewidth=2.0)
        for axes in panels[len(plans) :]:
            axes.set_axis_off()
        if group.label:
            panels[0].set_ylabel(group.label, fontsize=8)
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


def film(states: Tensor) -> Frames:
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
