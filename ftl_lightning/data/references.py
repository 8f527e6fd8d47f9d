"""Behaviour made of demonstrations without learning: what a learned concept has to beat."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from ftl_lightning.data.deformation import Pinned
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.data.places import Frames, Places, feature_of, first_windows, frames_of, place_of, places, starts, vectors_of
from ftl_lightning.services.errors import require, short
from ftl_lightning.services.validation import check_range, from_mapping

NEAREST, SHIFTED, WARPED, GAUSSIAN = NAMES = (
    "nearest demonstration",
    "shifted demonstration",
    "warped demonstrations",
    "Gaussian of demonstrations",
)
"""References by name, see :class:`Reference`."""
VARIED = "varied demonstrations"
"""Maker of samples of a learned concept, see :class:`Reference`."""
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
        observed_spread: standard deviation of each observed vector ``(size,)`` by name.
        place: standard deviation of a path's mean within concepts ``(state,)``.
        size: standard deviation of the logarithm of a path's size within concepts.
        frames: shares of the places ``(training concept, place, horizon)``; without places, no place.
    """

    places: Places
    starts: Places
    observed_spread: Observed
    place: Tensor
    size: float
    frames: Tensor

    @classmethod
    def of(cls, training: Demonstrations, horizon: int, followed: Places | None = None) -> Self:
        """Measure demonstrations of training concepts, two or more of each; ``followed`` are places that are known already."""
        paths, texts = first_windows(training, horizon), training.concepts
        spread = paths.flatten(0, 1).std(dim=0, correction=0)
        spread = torch.where(spread > 1e-6 * spread.max(), spread, torch.inf)
        rows = [[row for row, text in enumerate(texts) if text == name] for name in dict.fromkeys(texts)]
        several = [paths[some] for some in rows if len(some) > 1]
        place, sizes = paths.new_zeros(paths.shape[2]), torch.zeros(1)
        if several:
            place = torch.stack([some.mean(dim=1).var(dim=0) for some in several]).mean(dim=0).sqrt()
            sizes = torch.stack([_size(some, spread).log().var() for some in several]).mean().sqrt()
        seen = {name: values.std(dim=0, correction=0).clamp(min=1e-9) for name, values in vectors_of(training).items()}
        followed = followed or places(training, horizon)
        return cls(followed, starts(training), seen, place, float(sizes), frames_of(training, horizon, followed))


def _size(paths: Tensor, spread: Tensor) -> Tensor:
    """Root mean square deviation of paths ``(path, horizon, state)`` from their mean, in standard deviations of the columns."""
    return ((paths - paths.mean(dim=1, keepdim=True)) / spread).square().mean(dim=(1, 2)).sqrt().clamp(min=1e-6)


@dataclass(frozen=True, eq=False)
class Reference:
    """A sampler made of a few demonstrations of one concept.

    The *nearest demonstration* is the one that observes most alike; without observations, each in turn. The *shifted demonstration*
    is moved by the differences of observed places, with the shares of :class:`~ftl_lightning.data.places.Frames`. *Warped
    demonstrations* also vary in pace, size and place, by :data:`SHARE` of what training concepts vary by. The *Gaussian of
    demonstrations* has their mean and covariance (a probabilistic movement primitive, Paraschos et al., 2013). *Varied
    demonstrations* are warped or drawn from the Gaussian, half of each; with places, all from the Gaussian, with the shares of
    training concepts as prior: a warp would leave the places. Where the initial state is observed, all but the nearest
    demonstration begin there.

    Attributes:
        name: one of :data:`NAMES`, or :data:`VARIED`.
        paths: first windows of the demonstrations ``(demo, horizon, state)``, in the domain's units.
        observed: observed vectors of the demonstrations ``(demo, size)`` by name; images are left out.
        setting: see :class:`Setting`.
        spread: scale of the deviations of samples from the mean of the demonstrations, 0 to 1.
    """

    name: str
    paths: Tensor
    observed: Observed
    setting: Setting
    spread: float = 1.0

    def __post_init__(self) -> None:
        names = (*NAMES, VARIED)
        require(self.name in names, "form", f"one of {', '.join(names)}", repr(self.name))
        check_range("key 'reference.spread'", self.spread, 0, 1)

    @classmethod
    def of(cls, name: str, demonstrations: Demonstrations, setting: Setting, horizon: int, spread: float = 1.0) -> Self:
        """Make a reference of demonstrations of one concept."""
        return cls(name, first_windows(demonstrations, horizon), vectors_of(demonstrations), setting, spread)

    def sample(self, observed: Observed, count: int, draw: torch.Generator) -> Tensor:
        """Samples ``(count, horizon, state)`` for observed features ``(count, ...)`` by name; empty for none.

        ``draw`` is the random generator of warps and of Gaussians, on the CPU.
        """
        seen = {key: observed[key].flatten(1).float().cpu() for key in self.observed}
        index = self._nearest(seen, count)
        if self.name == NEAREST:
            return self.paths[index]
        prior = self.setting.frames if self.name == VARIED and self.setting.places else None
        frames = Frames.fit(self.paths, self.observed, self.setting.places, prior)
        width = self.paths.shape[2]
        rest = self.paths - frames.shift(self.observed, width)
        if self.name == WARPED:
            chosen = self._warped(rest[self._each(count, draw)], not frames.places, draw)
        elif self.name == VARIED:
            chosen = _drawn(rest, count, draw)
            if not frames.places:
                warped = self._warped(rest[self._each(count, draw)], True, draw)
                chosen = torch.where((torch.randperm(count, generator=draw) % 2 == 0)[:, None, None], warped, chosen)
        elif self.name == GAUSSIAN:
            chosen = _drawn(rest, count, draw)
        else:
            chosen = rest[index]
        if self.spread < 1:
            mean = rest.mean(dim=0)
            chosen = mean + self.spread * (chosen - mean)
        return self._started(chosen + frames.shift(seen, width), seen)

    def each(self, observed: Observed) -> Tensor:
        """Every demonstration ``(demo, horizon, state)`` moved to places ``(demo, ...)``."""
        seen = {key: observed[key].flatten(1).float().cpu() for key in self.observed}
        frames = Frames.fit(self.paths, self.observed, self.setting.places)
        width = self.paths.shape[2]
        return self._started(self.paths - frames.shift(self.observed, width) + frames.shift(seen, width), seen)

    def _nearest(self, observed: Observed, count: int) -> Tensor:
        """Index of the demonstration of each sample ``(count,)``."""
        if not observed:
            return torch.arange(count) % len(self.paths)
        apart = torch.zeros(count, len(self.paths))
        for key, values in observed.items():
            scale = self.setting.observed_spread[key]
            apart += torch.cdist(values / scale, self.observed[key] / scale).square()
        return apart.argmin(dim=1)

    def _each(self, count: int, draw: torch.Generator) -> Tensor:
        """Index of a random demonstration for each sample, each demonstration equally often."""
        return torch.cat([torch.randperm(len(self.paths), generator=draw) for _ in range(-(-count // len(self.paths)))])[:count]

    def _warped(self, paths: Tensor, shift: bool, draw: torch.Generator) -> Tensor:
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
        return mean + (bent - mean) * size + shift * place

    def _started(self, paths: Tensor, observed: Observed) -> Tensor:
        """Paths that begin at the observed initial state."""
        known = {key: columns for key, columns in self.setting.starts.items() if key in observed}
        if not known:
            return paths
        mask, values = torch.zeros_like(paths, dtype=torch.bool), torch.zeros_like(paths)
        for key, columns in known.items():
            mask[:, 0, list(columns)] = True
            values[:, 0, list(columns)] = observed[key]
        return Pinned(mask, values)(paths)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of a file, by name."""
        named = {"paths": self.paths, "place": self.setting.place, "frames": self.setting.frames}
        named |= {f"observed/{key}": values for key, values in self.observed.items()}
        return named | {f"observed_spread/{key}": values for key, values in self.setting.observed_spread.items()}

    @property
    def header(self) -> dict[str, Any]:
        """Header of a file: what is not a tensor."""
        setting = self.setting
        return {
            "name": self.name,
            "places": dict(setting.places),
            "starts": dict(setting.starts),
            "size": setting.size,
            "spread": self.spread,
        }

    @classmethod
    def from_file(cls, tensors: Mapping[str, Tensor], header: Any) -> Self:
        """Inverse of :meth:`tensors` and :attr:`header`; ``UserError`` for what does not fit."""
        contents = from_mapping(_Header, header, "reference")
        observed, spreads = (
            {name.removeprefix(prefix): values for name, values in tensors.items() if name.startswith(prefix)}
            for prefix in ("observed/", "observed_spread/")
        )
        missing = {"paths", "place", "frames"} - set(tensors)
        require(not missing, "key 'reference'", "paths, place and frames", f"no {', '.join(sorted(missing))}")
        paths, place = tensors["paths"], "key 'reference'"
        require(paths.dim() == 3 and all(paths.shape), f"{place}: paths", "(demo, horizon, state)", tuple(paths.shape))
        require(
            tensors["place"].shape == paths.shape[2:], f"{place}: place", str(tuple(paths.shape[2:])), tuple(tensors["place"].shape)
        )
        require(set(observed) == set(spreads), place, "a spread of each observed feature", ", ".join(sorted(spreads)) or "none")
        for key, values in observed.items():
            fits = values.dim() == 2 and len(values) == len(paths) and spreads[key].shape == values.shape[1:]
            require(fits, f"{place}: observed/{short(key)}", "(demo, size)", tuple(values.shape))
        for name, values in tensors.items():
            require(values.dtype in (torch.float32, torch.float64), f"{place}: {short(name)}", "float32 or float64", values.dtype)
        known = {**contents.places, **contents.starts}
        for key, columns in known.items():
            fits = feature_of(key, observed) in observed and len(columns) == place_of(observed, key).shape[1]
            fits = fits and all(0 <= column < paths.shape[2] for column in columns)
            require(fits, f"{place}: places", "columns of the state for each number of an observed feature", short(key))
        shape, frames = (len(contents.places), paths.shape[1]), tensors["frames"]
        fits = frames.dim() == 3 and len(frames) > 0 and frames.shape[1:] == shape
        require(fits, f"{place}: frames", f"(concept, {shape[0]}, {shape[1]})", tuple(frames.shape))
        setting = Setting(contents.places, contents.starts, spreads, tensors["place"], contents.size, frames)
        return cls(contents.name, paths, observed, setting, contents.spread)


@dataclass(frozen=True)
class _Header:
    name: str
    places: Mapping[str, tuple[int, ...]]
    starts: Mapping[str, tuple[int, ...]]
    size: float
    spread: float = 1.0


def _drawn(paths: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """Samples ``(count, horizon, state)`` of a Gaussian with the mean and covariance of paths ``(demo, horizon, state)``."""
    demos = len(paths)
    weights = torch.randn(count, demos, generator=draw).to(paths) / max(demos - 1, 1) ** 0.5
    mean = paths.mean(dim=0)
    return mean + torch.einsum("sd,dhc->shc", weights, paths - mean)
