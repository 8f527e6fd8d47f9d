"""A line that a hand drew, as points at even steps along it."""

import numpy as np
from numpy.typing import NDArray

Line = NDArray[np.float64]
"""``(point, 2)``."""

FINEST = 20_000
"""Points of a line while it is smoothed, at most."""


def reached(line: Line) -> NDArray[np.float64]:
    """How far along a line each of its points is ``(point,)``, in its unit; the last is the line's length."""
    return np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))


def at_even_steps(line: Line, count: int) -> Line:
    """Points ``(count, 2)`` at even steps along a line, its ends among them; a hand's pauses leave no trace."""
    far = reached(line)
    wanted = np.linspace(0, far[-1], count)
    return np.stack([np.interp(wanted, far, column) for column in line.T], axis=-1)


def smoothed(line: Line, blur: float) -> Line:
    """A line without what is finer than a length; its ends stay.

    Args:
        line: ``(point, 2)``.
        blur: standard deviation, along the line, of the weights with which its points are averaged, in its unit.
    """
    count = min(int(np.ceil(2 * reached(line)[-1] / blur)) + 2, FINEST)  # two points within the blur
    even = at_even_steps(line, count)
    reach = min(6, count - 1)  # three times the blur
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / 2) ** 2)
    # Beyond an end the line goes on as its mirror image through the end, so that the average at the end is the end.
    before, after = 2 * even[:1] - even[reach:0:-1], 2 * even[-1:] - even[-2 : -2 - reach : -1]
    whole = np.concatenate((before, even, after))
    return np.stack([np.convolve(column, weights / weights.sum(), mode="valid") for column in whole.T], axis=-1)
