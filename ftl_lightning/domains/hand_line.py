"""Smoothing and resampling of lines drawn by hand."""

import numpy as np
from numpy.typing import NDArray

Line = NDArray[np.float64]
"""``(point, 2)``."""

FINEST = 20_000
"""Maximum number of points of a line during smoothing."""


def reached(line: Line) -> NDArray[np.float64]:
    """Arc length at each point of a line ``(point,)``; the last is the line's length."""
    return np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))


def at_even_steps(line: Line, count: int) -> Line:
    """Resample a line to points ``(count, 2)`` at even steps, including its ends; pauses of the hand vanish."""
    far = reached(line)
    wanted = np.linspace(0, far[-1], count)
    return np.stack([np.interp(wanted, far, column) for column in line.T], axis=-1)


def smoothed(line: Line, blur: float) -> Line:
    """Smooth a line along its length; its ends stay.

    Args:
        line: ``(point, 2)``.
        blur: standard deviation of the Gaussian weights along the line, in its unit.
    """
    count = min(int(np.ceil(2 * reached(line)[-1] / blur)) + 2, FINEST)  # two points per blur
    even = at_even_steps(line, count)
    reach = min(6, count - 1)  # three times the blur
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / 2) ** 2)
    # Extend the line by point reflection at its ends, so that the ends stay.
    before, after = 2 * even[:1] - even[reach:0:-1], 2 * even[-1:] - even[-2 : -2 - reach : -1]
    whole = np.concatenate((before, even, after))
    return np.stack([np.convolve(column, weights / weights.sum(), mode="valid") for column in whole.T], axis=-1)
