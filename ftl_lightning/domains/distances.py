"""How far two behaviours are apart: what novelty and coverage are measured by."""

from collections.abc import Callable

import torch
from torch import Tensor

Distance = Callable[[Tensor, Tensor], Tensor]
"""``(states (a, horizon, state), others (b, horizon, state)) -> (a, b)``: 0 for the same behaviour, the same both ways round."""


def path_distance(paths: Tensor, others: Tensor) -> Tensor:
    """Root mean square over the horizon of the Euclidean distance, in the columns' unit.

    Args:
        paths: ``(a, horizon, column)``.
        others: ``(b, horizon, column)``.

    Returns:
        ``(a, b)``.
    """
    # Differences, not products: a path is at distance 0 of itself, to the digit.
    between = torch.cdist(paths.flatten(1), others.flatten(1), compute_mode="donot_use_mm_for_euclid_dist")
    return between / paths.shape[1] ** 0.5


def scaled_distance(real: Tensor, resolution: float = 0.0) -> Distance:
    """:func:`path_distance` in columns of standard deviation 1: what is known of behaviour of which nothing is known.

    Scales are those of real behaviour, never of what is generated: a method that generates widely must not seem close for it.

    Args:
        real: behaviour ``(n, time, state)`` of the task.
        resolution: columns that vary by less are left as they are.
    """
    spread = real.flatten(0, 1).std(dim=0, correction=0)
    spread = torch.where(spread > resolution, spread, 1)
    return lambda states, others: path_distance(states / spread, others / spread)
