"""Figures of demonstrations above samples, to check visually whether a concept was learned."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Show
from ftl_lightning.services.text import figure_text

if TYPE_CHECKING:  # importing matplotlib takes half a second
    from matplotlib.figure import Figure

DPI = 100
"""Pixels per inch of a domain's picture."""
POINTS, LEAST = 2.2, 9.0
"""Font size in points per inch of a picture's width, legible on cards, and minimum font size."""
LETTER, LINE = 0.68, 1.8
"""Width of a bold letter and height of a line, relative to the font size."""


@dataclass(frozen=True)
class Drawn:
    """Group of plans in a figure.

    Attributes:
        label: such as ``'demonstrations'``.
        states: ``(plan, horizon, state)`` in the domain's units.
        starts: initial states, or ``None``.
        right: whether each plan is right ``(plan,)``; ``None`` if not judged.
    """

    label: str
    states: Tensor
    starts: InitialStates | None = None
    right: Sequence[bool] | None = None


def beside(show: Show, demonstrations: Drawn, samples: Drawn, title: str) -> "Figure":
    """Draw demonstrations above samples with the domain's pictures.

    Args:
        show: the domain's pictures.
        demonstrations: drawn above.
        samples: drawn below, of the same horizon.
        title: title of the figure.
    """
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
