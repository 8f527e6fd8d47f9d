"""The odd demonstration among a few, by distances on features of paths that demonstrations of training concepts calibrate."""

from functools import cache

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.energy import PathFeatures
from ftl_lightning.data.features import Observed
from ftl_lightning.data.kinds import Columns
from ftl_lightning.data.places import Frames, first_windows, vectors_of
from ftl_lightning.data.references import Setting
from ftl_lightning.services.randomness import generator

FEWEST, MOST = 3, 20
"""Minimum and maximum number of demonstrations that are compared; the minimum is that of a training concept, too."""
DRAWN, DRAWN_MOVED = 48, 24
"""Sets of training demonstrations that give the limit: without, and with observed places."""
RIVAL = 2.0
"""Weight of the distance to the nearest training concept, chosen on all sets of benchmarks/experiments/check_real.py."""
EVEN = 0.2
"""Variance that is added to that within concepts in each number of a feature, relative to the mean variance."""


class Oddness:
    """How much more a demonstration differs from the others than these from each other and than it from a training concept.

    Paths are moved to the same places where places are observed. Each number of the features of
    :class:`~ftl_lightning.data.energy.PathFeatures` is scaled by its standard deviation within training concepts. With the mean
    distance ``d`` of a demonstration to the others, ``o`` among the others, and ``r`` to the nearest training concept, the oddness
    is the mean over features of ``log(d / o) + 2 log(d / r)``. A demonstration is odd if its oddness is the largest, and larger
    than in sets of as many demonstrations of a training concept, which is then not among those compared with.

    Args:
        training: demonstrations of training concepts.
        horizon: number of states that are compared.
    """

    def __init__(self, training: Demonstrations, horizon: int) -> None:
        self.horizon, self.setting, self.columns = horizon, Setting.of(training, horizon), Columns(training.state_kinds)
        self.centre = self.columns.encode(training.states).flatten(0, 1).mean(dim=0)
        self.paths, self.seen = first_windows(training, horizon), vectors_of(training)
        self.usual = {name: values.mean(dim=0, keepdim=True) for name, values in self.seen.items()}
        self.rows = [rows for rows in training.rows_of.values() if len(rows) >= FEWEST]
        self.features = PathFeatures(self._encoded(self.paths))
        self.frames = [self._frames(self.paths[some], _of(self.seen, some)) for some in self.rows]
        moved = [self._moved(frames, some) for frames, some in zip(self.frames, self.rows, strict=True)]
        self.known = [self.features(paths) for paths in moved]  # (concept)(feature)(demo, n)
        self.scale = []
        for values in zip(*self.known, strict=True):
            within = torch.stack([some.var(dim=0) for some in values]).mean(dim=0)
            self.scale.append((within + EVEN * within.mean()).clamp(min=1e-12).sqrt())
        self.known = [self._scaled(values) for values in self.known]
        self.limit = cache(self._limit)

    def _encoded(self, paths: Tensor) -> Tensor:
        return (self.columns.encode(paths) - self.centre).float()

    def _scaled(self, values: list[Tensor]) -> list[Tensor]:
        return [some / scale for some, scale in zip(values, self.scale, strict=True)]

    def _frames(self, paths: Tensor, seen: Observed) -> Frames:
        return Frames.fit(paths, seen, self.setting.places)

    def _moved(self, frames: Frames, rows: list[int]) -> Tensor:
        return self._to_usual(frames, self.paths[rows], _of(self.seen, rows))

    def _to_usual(self, frames: Frames, paths: Tensor, seen: Observed) -> Tensor:
        """Continuous columns of paths that are moved to the mean places."""
        width = paths.shape[2]
        return self._encoded(paths - frames.shift(seen, width) + frames.shift(self.usual, width))

    def _oddness(self, paths: Tensor, seen: Observed, without: int | None = None) -> Tensor:
        """Oddness ``(demo,)`` of paths ``(demo, horizon, state)``, compared with training concepts but one."""
        every, count = [number for number in range(len(self.rows)) if number != without], len(paths)
        found, values = [], list[Tensor]()
        for row in range(count):
            others = [number for number in range(count) if number != row]
            if self.setting.places or not values:
                frames = self._frames(paths[others], _of(seen, others))
                values = self._scaled(self.features(self._to_usual(frames, paths, seen)))
            alone, its = paths[row : row + 1], _of(seen, [row])
            placed = [values] * len(every)
            if self.setting.places:
                moved = self._scaled(
                    self.features(torch.cat([self._to_usual(self.frames[number], alone, its) for number in every]))
                )
                placed = [[some[turn, None].expand(count, -1) for some in moved] for turn in range(len(every))]
            logs = []
            for feature, some in enumerate(values):
                apart = torch.cdist(some, some)
                near, among = apart[row, others].mean(), apart[others][:, others].sum() / ((count - 1) * (count - 2))
                rivals = [
                    (self.known[number][feature] - here[feature][row]).norm(dim=1).mean()
                    for number, here in zip(every, placed, strict=True)
                ]
                near, among, rival = (value.clamp(min=1e-6) for value in (near, among, torch.stack(rivals).min()))
                logs.append((1 + RIVAL) * near.log() - among.log() - RIVAL * rival.log())
            found.append(torch.stack(logs).mean())
        return torch.stack(found)

    def _limit(self, count: int) -> float:
        """Largest usual oddness among ``count`` demonstrations of a concept."""
        draw, most = generator("cpu", 0, 11), []
        for number in range(DRAWN_MOVED if self.setting.places else DRAWN):
            concept = number % len(self.rows)
            rows = self.rows[concept]
            chosen = [rows[index] for index in torch.randperm(len(rows), generator=draw)[:count].tolist()]
            most.append(self._oddness(self.paths[chosen], _of(self.seen, chosen), concept).max())
        return float(torch.stack(most).max())

    def odd(self, demonstrations: Demonstrations) -> int | None:
        """Index of the odd demonstration; ``None`` without any, or with too few demonstrations or training concepts."""
        if not FEWEST <= len(demonstrations) <= MOST or len(self.rows) < 2:
            return None
        oddness = self._oddness(first_windows(demonstrations, self.horizon), vectors_of(demonstrations))
        return int(oddness.argmax()) if float(oddness.max()) > self.limit(len(demonstrations)) else None


def _of(observed: Observed, rows: list[int]) -> Observed:
    return {name: values[rows] for name, values in observed.items()}
