"""Distances between behaviours, for novelty and coverage."""

from collections.abc import Callable

import torch
from torch import Tensor

Distance = Callable[[Tensor, Tensor], Tensor]
"""``(states (a, horizon, state), others (b, horizon, state)) -> (a, b)``: symmetric, 0 for the same behaviour."""


def path_distance(paths: Tensor, others: Tensor) -> Tensor:
    """Root mean square over the horizon of the Euclidean distance, in the columns' unit.

    Args:
        paths: ``(a, horizon, column)``.
        others: ``(b, horizon, column)``.

    Returns:
        ``(a, b)``.
    """
    # Differences, not products: the distance of a path to itself is exactly 0.
    between = torch.cdist(paths.flatten(1), others.flatten(1), compute_mode="donot_use_mm_for_euclid_dist")
    return between / paths.shape[1] ** 0.5


def scaled_distance(real: Tensor, resolution: float = 0.0) -> Distance:
    """Generic distance: :func:`path_distance` of columns scaled to standard deviation 1.

    Scales are of real behaviour, not of samples: widely spread samples must not seem close.

    Args:
        real: behaviour ``(n, time, state)`` of the task.
        resolution: columns that vary by less are not scaled.
    """
    spread = real.flatten(0, 1).std(dim=0, correction=0)
    spread = torch.where(spread > resolution, spread, 1)
    return lambda states, others: path_distance(states / spread, others / spread)
