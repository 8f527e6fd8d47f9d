"""Distances between behaviours, and energy scores on features of paths."""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from ftl_lightning.services.randomness import generator

FEATURES = ("path", "differences", "convolutions", "spectrum", "precision")
"""Features of a path, each with an energy score. The last is measured where ``within`` is known."""
FLOOR = 0.02
"""Smallest standard deviation within concepts, relative to that of a column: what is smaller is no matter of precision."""
KERNELS, WIDTH = 100, 7
"""Random convolutions, and their number of times."""
QUIET = 1e-3
"""Amplitude that is added to spectra before the logarithm, relative to a column's standard deviation."""
PAIRED = 200
"""Maximum number of real paths whose mutual distances are the unit of a feature."""


class PathFeatures:
    """Features of paths, whitened by real behaviour.

    Args:
        real: paths ``(path, horizon, state)``, such as those of all training concepts; two or more.
        within: standard deviation of each time and column within concepts ``(horizon, state)``. Paths in these units see where
            behaviour is precise; ``None`` leaves this feature out.

    Attributes:
        units: mean distance between real paths, of each feature.
    """

    def __init__(self, real: Tensor, within: Tensor | None = None) -> None:
        self.spread = _spread(real.flatten(0, 1))
        self.precision = None if within is None else torch.maximum(within, FLOOR * self.spread)
        draw = generator("cpu", 0, 7)
        state, horizon = real.shape[2], real.shape[1]
        width = min(WIDTH, horizon)
        kernels = torch.randn(KERNELS, state, width, generator=draw)
        kernels = kernels - kernels.mean(dim=2, keepdim=True) * (width > 1)
        kernels = kernels * (torch.rand(KERNELS, state, 1, generator=draw) < max(2 / state, 0.3))
        self.kernels = kernels / kernels.flatten(1).norm(dim=1).clamp(min=1e-6)[:, None, None]
        most = math.log2(max((horizon - 1) / max(width - 1, 1), 1))
        dilations = (2 ** (most * torch.rand(KERNELS, generator=draw))).long()
        self.dilations = {int(dilation): dilations == dilation for dilation in dilations.unique()}
        some = torch.randperm(len(real), generator=draw)[:PAIRED]
        self.units = [_mean_distance(values) for values in self(real[some])]

    def __call__(self, paths: Tensor) -> list[Tensor]:
        """Features ``(path, n)`` of paths ``(path, horizon, state)``, by :data:`FEATURES`; short paths have the first and last."""
        scaled = paths / self.spread
        precise = [] if self.precision is None else [(paths / self.precision).flatten(1)]
        if paths.shape[1] < 3:
            return [scaled.flatten(1), *precise]
        convolved = []
        for dilation, chosen in self.dilations.items():
            values = functional.conv1d(scaled.transpose(1, 2), self.kernels[chosen], dilation=dilation)
            parts = (values.amax(dim=2), values.amin(dim=2), (values > 0).float().mean(dim=2), values.std(dim=2, correction=0))
            convolved += list(parts)
        amplitudes = torch.fft.rfft(scaled - scaled.mean(dim=1, keepdim=True), dim=1).abs()
        quiet = QUIET * paths.shape[1] ** 0.5
        return [
            scaled.flatten(1),
            scaled.diff(dim=1).flatten(1),
            torch.cat(convolved, dim=1),
            (amplitudes + quiet).log().flatten(1),
            *precise,
        ]

    def scores(self, samples: Tensor, truth: Tensor) -> Tensor:
        """Energy scores ``(demo, feature)`` of samples ``(demo, sample, horizon, state)`` for ``(demo, horizon, state)``.

        0 is exact, and 1 the distance between two paths of the real behaviour. The second expectation is over pairs of different
        samples, so that the score does not depend on their number; a single sample has a score without it.
        """
        demos, count = samples.shape[:2]
        features = zip(self(samples.flatten(0, 1)), self(truth), self.units, strict=True)
        return torch.stack([_energy(values.unflatten(0, (demos, count)), real) / unit for values, real, unit in features], dim=1)


def apart(samples: Tensor, truth: Tensor) -> Tensor:
    """Mean distances ``(demo,)`` of samples ``(demo, sample, n)`` from ``(demo, n)``."""
    return (samples - truth[:, None]).norm(dim=2).mean(dim=1)


def among(samples: Tensor) -> Tensor:
    """Mean distances ``(demo,)`` between different samples ``(demo, sample, n)``; 0 for a single one."""
    count = samples.shape[1]
    return torch.cdist(samples, samples).sum(dim=(1, 2)) / max(count * (count - 1), 1)


def _energy(samples: Tensor, truth: Tensor) -> Tensor:
    """Energy scores ``(demo,)`` of samples ``(demo, sample, n)`` for ``(demo, n)``."""
    return apart(samples, truth) - among(samples) / 2


def _mean_distance(values: Tensor) -> Tensor:
    """Mean distance between different rows ``(path, n)``."""
    count = len(values)
    return (torch.cdist(values, values).sum() / max(count * (count - 1), 1)).clamp(min=1e-12)


def _spread(values: Tensor) -> Tensor:
    """Standard deviation of columns ``(row, n)``; infinite for constant columns, which then count nothing."""
    spread = values.std(dim=0, correction=0)
    return torch.where(spread > 1e-6 * spread.max(), spread, torch.inf)


def ceiling(features: PathFeatures, demonstrations: Tensor) -> Tensor:
    """Energy score ``(feature,)`` of fresh demonstrations of the same kind, without bias: half the mean distance between two.

    Args:
        demonstrations: ``(demo, horizon, state)``, two or more, nothing observed.
    """
    return torch.stack(
        [_mean_distance(values) / 2 / unit for values, unit in zip(features(demonstrations), features.units, strict=True)]
    )


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
