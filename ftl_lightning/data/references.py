"""Behaviour made of demonstrations without learning: what a learned concept has to beat."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.data.pinned import Pinned
from ftl_lightning.data.places import Frames, Places, first_windows, places, starts

NEAREST, SHIFTED, WARPED, GAUSSIAN = NAMES = (
    "nearest demonstration",
    "shifted demonstration",
    "warped demonstrations",
    "Gaussian of demonstrations",
)
"""References by name, see :class:`References`."""
SHARE = 0.5
"""Standard deviation of warping, as a share of the standard deviation within training concepts."""
BEND = 0.4
"""Maximum change of pace of a warped path, as a share of its duration."""


@dataclass(frozen=True)
class Setting:
    """What demonstrations of training concepts say about behaviour in general.

    Attributes:
        places: columns of each observed place.
        starts: columns of each observed feature that equals the initial state.
        spread: standard deviation of each column ``(state,)``; infinite for a constant column.
        observed_spread: standard deviation of each observed vector ``(size,)`` by name.
        place: standard deviation of a path's mean within concepts ``(state,)``.
        size: standard deviation of the logarithm of a path's size within concepts.
    """

    places: Places
    starts: Places
    spread: Tensor
    observed_spread: Observed
    place: Tensor
    size: float

    @classmethod
    def of(cls, training: Demonstrations, horizon: int) -> Self:
        """Measure demonstrations of training concepts, two or more of each."""
        paths, texts = first_windows(training, horizon).float(), training.concepts
        spread = paths.flatten(0, 1).std(dim=0, correction=0)
        spread = torch.where(spread > 1e-6 * spread.max(), spread, torch.inf)
        rows = [[row for row, text in enumerate(texts) if text == name] for name in dict.fromkeys(texts)]
        several = [paths[some] for some in rows if len(some) > 1]
        place, sizes = torch.zeros_like(spread), torch.zeros(1)
        if several:
            place = torch.stack([some.mean(dim=1).var(dim=0) for some in several]).mean(dim=0).sqrt()
            sizes = torch.stack([_size(some, spread).log().var() for some in several]).mean().sqrt()
        vectors = {name: values.flatten(1).float() for name, values in training.initial_states.observed.items()}
        seen = {name: values.std(dim=0, correction=0).clamp(min=1e-9) for name, values in vectors.items()}
        return cls(places(training, horizon), starts(training), spread, seen, place, float(sizes))


def _size(paths: Tensor, spread: Tensor) -> Tensor:
    """Root mean square deviation of paths ``(path, horizon, state)`` from their mean, in standard deviations of the columns."""
    return ((paths - paths.mean(dim=1, keepdim=True)) / spread).square().mean(dim=(1, 2)).sqrt().clamp(min=1e-6)


class References:
    """Samples made of a few demonstrations of one concept.

    The *nearest demonstration* is the one that observes most alike; without observations, each in turn. The *shifted demonstration*
    is moved by the differences of observed places, with the shares of :class:`~ftl_lightning.data.places.Frames`. *Warped
    demonstrations* also vary in pace, size and place, by :data:`SHARE` of what training concepts vary by. The *Gaussian of
    demonstrations* has their mean and covariance (a probabilistic movement primitive, Paraschos et al., 2013). Where the initial
    state is observed, all but the nearest demonstration begin there.

    Args:
        demonstrations: demonstrations of one concept.
        setting: see :class:`Setting`.
        horizon: number of states in a sample.
    """

    def __init__(self, demonstrations: Demonstrations, setting: Setting, horizon: int) -> None:
        self.setting, self.observed = setting, demonstrations.initial_states.observed
        self.paths = first_windows(demonstrations, horizon).float()
        self.frames = Frames.fit(self.paths, self.observed, setting.places)
        self.rest = self.paths - self.frames.shift(self.observed, self.paths.shape[2])

    def sample(self, name: str, observed: Observed, starts: int, count: int, draw: torch.Generator) -> Tensor:
        """Samples ``(start, sample, horizon, state)`` of a reference of :data:`NAMES`.

        Args:
            observed: features ``(start, ...)`` by name; empty for none.
            starts: number of starts.
            count: number of samples for each start.
            draw: random generator of warps and of Gaussians.
        """
        index = self._nearest(observed, starts, count)
        if name == NEAREST:
            return self.paths[index].unflatten(0, (starts, count))
        every = {key: values.repeat_interleave(count, dim=0) for key, values in observed.items()}
        rest = self.rest[index]
        if name == WARPED:
            rest = self._warped(self.rest[self._each(len(index), draw)], draw)
        elif name == GAUSSIAN:
            rest = self._drawn(len(index), draw)
        moved = rest + self.frames.shift(every, rest.shape[2])
        return self._started(moved, every).unflatten(0, (starts, count))

    def _nearest(self, observed: Observed, starts: int, count: int) -> Tensor:
        """Index of the demonstration of each sample ``(start * count,)``."""
        if not observed:
            return torch.arange(starts * count) % len(self.paths)
        apart = torch.zeros(starts, len(self.paths))
        for key, values in observed.items():
            scale = self.setting.observed_spread[key]
            apart += torch.cdist(values.flatten(1).float() / scale, self.observed[key].flatten(1).float() / scale).square()
        return apart.argmin(dim=1).repeat_interleave(count)

    def _each(self, count: int, draw: torch.Generator) -> Tensor:
        """Index of a random demonstration for each sample, each demonstration equally often."""
        return torch.cat([torch.randperm(len(self.paths), generator=draw) for _ in range(-(-count // len(self.paths)))])[:count]

    def _warped(self, paths: Tensor, draw: torch.Generator) -> Tensor:
        count, horizon, width = paths.shape
        even = torch.linspace(0, 1, horizon)
        bend = BEND * (2 * torch.rand(count, 1, generator=draw) - 1)
        at = (even + bend * even * (1 - even)) * (horizon - 1)
        low = at.floor().long().clamp(max=max(horizon - 2, 0))
        share = (at - low)[..., None]
        rows = torch.arange(count)[:, None]
        bent = paths[rows, low] * (1 - share) + paths[rows, (low + 1).clamp(max=horizon - 1)] * share
        size = torch.exp(SHARE * self.setting.size * torch.randn(count, 1, 1, generator=draw))
        mean = bent.mean(dim=1, keepdim=True)
        place = SHARE * self.setting.place * torch.randn(count, 1, width, generator=draw)
        return mean + (bent - mean) * size + (0 if self.frames.places else place)

    def _drawn(self, count: int, draw: torch.Generator) -> Tensor:
        demos = len(self.rest)
        weights = torch.randn(count, demos, generator=draw) / max(demos - 1, 1) ** 0.5
        mean = self.rest.mean(dim=0)
        return mean + torch.einsum("sd,dhc->shc", weights, self.rest - mean)

    def _started(self, paths: Tensor, observed: Observed) -> Tensor:
        """Paths that begin at the observed initial state."""
        if not self.setting.starts:
            return paths
        mask, values = torch.zeros_like(paths, dtype=torch.bool), torch.zeros_like(paths)
        for key, columns in self.setting.starts.items():
            mask[:, 0, list(columns)] = True
            values[:, 0, list(columns)] = observed[key].flatten(1).float()
        return Pinned(mask, values)(paths)
