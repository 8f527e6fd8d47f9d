"""Figure of a check: demonstrations, their distances, and leave-one-out losses."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from ftl_lightning.data.check import distances
from ftl_lightning.services.text import figure_text
from ftl_lightning.training.demonstration_check import Check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST = 20
"""Maximum number of concepts in a figure."""
GOOD, ODD = "#3f6fb5", "#d03a3a"


def picture(checks: Sequence[Check]) -> "Figure":
    """A row for each concept; odd or faulty demonstrations are red.

    Args:
        checks: checks of concepts; the first :data:`MOST` are drawn.
    """
    from matplotlib.figure import Figure

    shown = checks[:MOST]
    columns = 2 + 2 * any(check.left_out for check in shown)
    figure = Figure(figsize=(3.2 * columns, 3.0 * len(shown)), layout="constrained")
    for check, row in zip(shown, figure.subplots(len(shown), columns, squeeze=False), strict=True):
        odd = {number for finding in check.warnings for number in finding.rows}
        odd |= set() if check.left_out is None or check.left_out.odd is None else {check.left_out.odd}
        _behaviour(row[0], check, odd)
        _distances(row[1], check)
        if check.left_out is not None:
            left, curve = check.left_out.left_out, check.left_out.curve
            numbers = range(1, len(left) + 1)
            row[2].bar(numbers, left, color=[ODD if number - 1 in odd else GOOD for number in numbers])
            row[2].axhline(1, color="black", linewidth=0.8, linestyle="dotted")
            row[2].set(title="loss when left out", xlabel="demonstration", ylabel="of the empty concept's", xticks=[*numbers])
            row[3].plot([*curve], [*curve.values()], ".-", color=GOOD)
            row[3].set(title="loss of those left out", xlabel="learned from", xticks=[*curve])
        for axes in row[2:] if check.left_out is None else ():
            axes.set_axis_off()
        for axes in row:
            axes.title.set_fontsize(9)
            axes.tick_params(labelsize=7)
    return figure


def _behaviour(axes: "Axes", check: Check, odd: set[int]) -> None:
    """Paths of the first two columns for 2 or 3 columns; else distances from the start over time, or single states."""
    demos = check.demonstrations
    scale = demos.states.flatten(0, 1).std(dim=0).clamp(min=1e-12)
    for number, (states, length) in enumerate(zip(demos.states, demos.lengths.tolist(), strict=True)):
        colour = ODD if number in odd else GOOD
        if states.shape[1] in (2, 3) and length > 1:
            axes.plot(*states[:length, :2].T.numpy(), color=colour, linewidth=1)
            where = states[length - 1, :2].tolist()
        elif length > 1:  # distance from the first state, columns scaled
            moved = ((states[:length] - states[0]) / scale).square().mean(dim=1).sqrt()
            axes.plot(moved.numpy(), color=colour, linewidth=1)
            where = [length - 1, float(moved[-1])]
        else:
            centred = (states[0] - demos.states[:, 0].mean(dim=0)) / scale
            axes.plot(centred.numpy(), ".", color=colour)
            where = [len(centred) - 1, float(centred[-1])]
        axes.annotate(str(number + 1), (where[0], where[1]), fontsize=7, color=colour)
    axes.set(title=figure_text(check.name))


def _distances(axes: "Axes", check: Check) -> None:
    apart = distances(check.demonstrations)
    axes.imshow(apart.numpy(), cmap="Blues")
    numbers = torch.arange(len(apart)).tolist() if len(apart) <= 12 else []
    labels = [str(number + 1) for number in numbers]
    axes.set_xticks(numbers, labels)
    axes.set_yticks(numbers, labels)
    axes.set(title="distances")
