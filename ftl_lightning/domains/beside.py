"""Demonstrations above what was generated from them: how people see whether a concept was learned."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import Show
from ftl_lightning.escape import figure_text

if TYPE_CHECKING:  # half a second of import, for what is drawn later
    from matplotlib.figure import Figure

DPI = 100
"""Pixels of an inch of a domain's picture."""
POINTS, LEAST = 2.2, 9.0
"""Points of letters, for each inch of a picture's width, so that they are read where it is shown as a card, and at least."""
LETTER, LINE = 0.68, 1.8
"""Width of a bold letter and height of a line, in sizes of letters."""


@dataclass(frozen=True)
class Drawn:
    """Plans that are drawn together.

    Attributes:
        label: what they are, such as ``'demonstrations'``.
        states: ``(plan, horizon, state)`` in the domain's units.
        starts: where they start, or ``None``.
        right: whether each plan is right ``(plan,)``; ``None`` if not judged.
    """

    label: str
    states: Tensor
    starts: InitialStates | None = None
    right: Sequence[bool] | None = None


def beside(show: Show, demonstrations: Drawn, samples: Drawn, title: str) -> "Figure":
    """Demonstrations above samples, in the domain's own drawing.

    Args:
        show: the domain's pictures.
        demonstrations: drawn above.
        samples: drawn below, of the same horizon.
        title: of the figure.
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
    """``(height, width, 4)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()
