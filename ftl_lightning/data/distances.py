"""Distances between behaviours, for novelty and coverage."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

Distance = Callable[[Tensor, Tensor], Tensor]
"""``(states (a, horizon, state), others (b, horizon, state)) -> (a, b)``: symmetric, 0 for the same behaviour."""


def path_distance(paths: Tensor, others: Tensor) -> Tensor:
    """Root mean square over the horizon of the Euclidean distance, in the columns' unit.

    ``(a, horizon, column)`` and ``(b, horizon, column)`` to ``(a, b)``.
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


def warped_distances(states: Tensor, lengths: Tensor, others: Tensor, other_lengths: Tensor) -> Tensor:
    """Mean distance per step after dynamic time warping (Sakoe & Chiba, 1978).

    ``states (n, time, state)`` of ``lengths (n,)`` and ``others (m, other time, state)`` of ``other_lengths (m,)`` to ``(n, m)``:
    the minimum sum of Euclidean distances along a warping path, divided by the longer length.
    """
    total = []
    for path, length in zip(states, lengths.tolist(), strict=True):
        cost = torch.cdist(path[None, :length].expand(len(others), -1, -1), others)  # (m, length, other time)
        infinite = torch.full((len(others),), math.inf)
        before = torch.full((len(others), cost.shape[2] + 1), math.inf)
        before[:, 0] = 0
        for row in cost.unbind(dim=1):
            here = [infinite]
            for column in range(cost.shape[2]):
                here.append(row[:, column] + torch.minimum(torch.minimum(before[:, column], before[:, column + 1]), here[-1]))
            before = torch.stack(here, dim=1)
        ends = before.gather(1, other_lengths[:, None])[:, 0]
        total.append(ends / other_lengths.clamp(min=length))
    return torch.stack(total)
