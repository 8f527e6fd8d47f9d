"""Demonstrations above what was generated from them: how people see whether a concept was learned."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import Show

if TYPE_CHECKING:  # half a second of import, for what is drawn later
    from matplotlib.figure import Figure


def beside(show: Show, demonstrations: Tensor, samples: Tensor, title: str, starts: InitialStates | None) -> "Figure":
    """Demonstrations above samples, in the domain's own drawing.

    Args:
        show: the domain's pictures.
        demonstrations: ``(demo, horizon, state)``.
        samples: ``(sample, horizon, state)``, of which the first demonstrations' starts are those of the demonstrations, in turn.
        title: of the figure.
        starts: where the samples start, or ``None``.
    """
    if show.beside is not None:
        return show.beside(demonstrations, samples, title)
    from matplotlib.figure import Figure

    known = None if starts is None else starts.take(slice(0, len(demonstrations)))
    pictures = [
        _pixels(show.picture(demonstrations, None, "demonstrations", known)),
        _pixels(show.picture(samples, None, "samples", starts)),
    ]
    height, width = sum(one.shape[0] for one in pictures), max(one.shape[1] for one in pictures)
    figure = Figure(figsize=(width / 100, height / 100), layout="constrained")
    figure.suptitle(title, fontsize=9)
    for axes, picture in zip(figure.subplots(2, 1, height_ratios=[one.shape[0] for one in pictures]), pictures, strict=True):
        axes.imshow(picture)
        axes.set_axis_off()
    return figure


def _pixels(figure: "Figure") -> NDArray[np.uint8]:
    """``(height, width, 4)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()
