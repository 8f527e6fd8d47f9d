"""Whether a part of a path is missing or added, by distances between the points of paths."""

import math
from functools import cache

import torch
from torch import Tensor
from torch.nn import functional

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.data.kinds import Columns
from ftl_lightning.data.places import Frames, Places, first_windows, vectors_of
from ftl_lightning.data.references import Setting
from ftl_lightning.services.randomness import generator

POINTS = 64
"""Maximum number of points of a path."""
SLOW = 0.2
"""Speed, relative to the mean of a path, at which the direction of a point counts half."""
LEAST = 0.5
"""Minimum of the mean distance, relative to a path's size and to the length of a direction: less is no missing part."""
DRAWN, FEWEST, WHOLE = 48, 3, 0.98
"""Sets of training demonstrations that give the limit, minimum number of demonstrations of their concept, and share of fresh
demonstrations that are whole.
"""


class Outline:
    """Judge of the parts of paths.

    A point is a position and a direction. The distance of two paths is the largest distance of a point of one to the nearest point
    of the other (Hausdorff), whenever that is reached. Paths are compared at the same places where places are observed, else
    without place and size. A path is whole if its distance to the nearest demonstration, relative to the mean of such distances
    among the demonstrations, is at most that of a share :data:`WHOLE` of fresh demonstrations of training concepts.

    Args:
        training: demonstrations of training concepts.
        horizon: number of states of a path.
        followed: places that are known already.
    """

    def __init__(self, training: Demonstrations, horizon: int, followed: Places | None = None) -> None:
        self.horizon, self.setting, self.columns = horizon, Setting.of(training, horizon, followed), Columns(training.state_kinds)
        self.paths, self.seen = first_windows(training, horizon), vectors_of(training)
        self.usual = {name: values.mean(dim=0, keepdim=True) for name, values in self.seen.items()}
        values = self.columns.encode(training.states).flatten(0, 1)
        self.centre, spread = values.mean(dim=0), values.std(dim=0, correction=0)
        self.spread = torch.where(spread > 1e-6 * spread.max(), spread, torch.inf)
        self.rows = [rows for rows in training.rows_of.values() if len(rows) >= FEWEST]
        self.limit = cache(self._limit)

    def whole(self, paths: Tensor, observed: Observed, demonstrations: Demonstrations) -> Tensor | None:
        """Whether no part of each path ``(path, horizon, state)`` is missing or added ``(path,)``.

        Args:
            paths: finite or not; those that are not finite are not whole.
            observed: observed features of the paths ``(path, ...)`` by name; images are ignored.
            demonstrations: demonstrations of the concept.

        Returns:
            ``None`` for a single demonstration, or if no training concept has :data:`FEWEST`.
        """
        if len(demonstrations) < 2 or not self.rows:
            return None
        known, its, seen, frames = self._compared(observed, demonstrations)
        finite = paths.isfinite().flatten(1).all(dim=1)
        made = self._points(frames, torch.where(finite[:, None, None], paths, 0), seen)
        return finite & (_farther(made, self._points(frames, known, its)) <= self.limit(len(known)))

    def faults(self, paths: Tensor, observed: Observed, demonstrations: Demonstrations) -> list[list[Tensor]]:
        """For each path, its added parts, and the missing parts of the nearest demonstration, moved to the path: ``(point, state)``
        each. Arguments as for :meth:`whole`, which judges them; paths must be finite.
        """
        known, its, seen, frames = self._compared(observed, demonstrations)
        width = paths.shape[2]
        made, base = self._points(frames, paths, seen), self._points(frames, known, its)
        limit = _usual(base) * math.exp(self.limit(len(known)))
        apart = torch.cdist(made[:, None], base[None])
        forth, back = apart.amin(dim=3), apart.amin(dim=2)
        shifts, its_shifts = frames.shift(seen, width), frames.shift(its, width)
        parts = []
        for row, demo in enumerate(torch.maximum(forth.amax(dim=2), back.amax(dim=2)).argmin(dim=1).tolist()):
            path, other = paths[row], known[demo]
            if self.setting.places:
                moved = other - its_shifts[demo] + shifts[row]
            else:
                moved = path.mean(dim=0) + (other - other.mean(dim=0)) * self._size(path) / self._size(other)
            parts.append([*_runs(path, forth[row, demo] > limit), *_runs(moved, back[row, demo] > limit)])
        return parts

    def _compared(self, observed: Observed, demonstrations: Demonstrations) -> tuple[Tensor, Observed, Observed, Frames]:
        """Windows of the demonstrations, vectors observed by these and by paths, and the frames of the demonstrations."""
        known, its = first_windows(demonstrations, self.horizon), vectors_of(demonstrations)
        seen = {name: observed[name].flatten(1).float() for name in its}
        return known, its, seen, Frames.fit(known, its, self.setting.places)

    def _size(self, path: Tensor) -> Tensor:
        """Root mean square of a path ``(horizon, state)`` around its mean."""
        states = self.columns.encode(path) / self.spread
        return (states - states.mean(dim=0)).square().mean().sqrt().clamp(min=1e-6)

    def _points(self, frames: Frames, paths: Tensor, seen: Observed) -> Tensor:
        """Points ``(path, point, 2 * column)`` of paths ``(path, horizon, state)``."""
        width, horizon = paths.shape[2], paths.shape[1]
        moved = paths - frames.shift(seen, width) + frames.shift(self.usual, width)
        states = ((self.columns.encode(moved) - self.centre) / self.spread).float()
        states = states[:, _places(horizon)]
        if horizon < FEWEST:
            return states
        if not self.setting.places:
            states = states - states.mean(dim=1, keepdim=True)
            states = states / states.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=1e-6)
        ahead = functional.pad(states.transpose(1, 2), (1, 1), mode="replicate").transpose(1, 2)
        steps = ahead[:, 2:] - ahead[:, :-2]
        speed = steps.norm(dim=2, keepdim=True)
        return torch.cat((states, steps / (speed + SLOW * speed.mean(dim=1, keepdim=True)).clamp(min=1e-6)), dim=2)

    def _limit(self, count: int) -> float:
        """Limit of :func:`_farther`, from ``count`` demonstrations."""
        draw, found = generator("cpu", 0, 13), []
        for number in range(DRAWN):
            rows = self.rows[number % len(self.rows)]
            mixed = [rows[index] for index in torch.randperm(len(rows), generator=draw).tolist()]
            some = min(count, len(rows) - 1)
            paths, seen = self.paths[mixed], {name: values[mixed] for name, values in self.seen.items()}
            frames = Frames.fit(paths[:some], {name: values[:some] for name, values in seen.items()}, self.setting.places)
            points = self._points(frames, paths, seen)
            found.append(_farther(points[some:], points[:some]))
        return float(torch.cat(found).quantile(WHOLE))


def _apart(points: Tensor, others: Tensor) -> Tensor:
    """Hausdorff distances ``(a, b)`` of points ``(a, point, n)`` and ``(b, point, n)``."""
    apart = torch.cdist(points[:, None], others[None])
    return torch.maximum(apart.amin(dim=3).amax(dim=2), apart.amin(dim=2).amax(dim=2))


def _farther(points: Tensor, known: Tensor) -> Tensor:
    """Logarithm of the distance of each path to the nearest known one, relative to the mean of these ``(path,)``."""
    return _apart(points, known).amin(dim=1).clamp(min=1e-6).log() - _usual(known).log()


def _usual(known: Tensor) -> Tensor:
    """Mean distance of known paths to the nearest other one, at least :data:`LEAST`."""
    return _apart(known, known).fill_diagonal_(torch.inf).amin(dim=1).mean().clamp(min=LEAST)


def _places(horizon: int) -> Tensor:
    """Indices of the states that are points."""
    return torch.linspace(0, horizon - 1, min(horizon, POINTS)).round().long()


def _runs(path: Tensor, flags: Tensor) -> list[Tensor]:
    """Parts of a path ``(horizon, state)`` whose points are flagged ``(point,)``, each with the points before and after it."""
    states, last = path[_places(len(path))], len(flags) - 1
    edges = (functional.pad(flags.int(), (1, 1)).diff()).nonzero().flatten().tolist()
    return [states[max(0, begin - 1) : min(last, end) + 1] for begin, end in zip(edges[::2], edges[1::2], strict=True)]
