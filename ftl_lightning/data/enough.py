"""Whether a few demonstrations suffice, by their skill on left-out demonstrations, and which is an outlier; without learning."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.check import numbered
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import PathFeatures, ceiling
from ftl_lightning.data.features import Observed
from ftl_lightning.data.kinds import Columns
from ftl_lightning.data.places import Frames, Places, first_windows, vectors_of
from ftl_lightning.data.references import GAUSSIAN, SHIFTED, WARPED, Reference, Setting
from ftl_lightning.services.randomness import generator

HIGH, BETTER = 0.86, 0.6
"""Minimum skill of a reference that suffices, and of a learned form that is better than every reference."""
RISING = 0.03
"""Minimum rise of the skill by the last demonstration for more to be asked for."""
SEVERAL = "they differ from each other as much as demonstrations of different training concepts"
DISTINCT = 0.9
"""Minimum score of fresh demonstrations, relative to behaviour of all training concepts, for what is no single concept."""
LEAST = 0.05
"""Score that is added to both in the ratio of a skill."""
FEWEST, FOLDS, SAMPLES, SUBSETS = 3, 8, 16, 4
"""Minimum number of demonstrations, and maximum numbers of left-out ones, of samples for each and of subsets of each size."""
MANY = 50
"""Number of demonstrations from which on no number is said."""
LARGEST = 20_000
"""Maximum numbers of a path; the skill of larger ones is not measured."""


@dataclass(frozen=True)
class Enough:
    """Skill of the best reference, and how many more demonstrations are asked for.

    Attributes:
        name: the reference, or the learned form that is better.
        skills: its skill by the number of demonstrations it is made from; of a learned form, that of the best reference.
        better: skill of the learned form; ``None`` without any.
        more: additional demonstrations that are likely to be needed; 0 if these suffice, ``None`` for many.
        without: demonstrations that are left out, as they are likely faulty.
        several: whether they differ from each other as much as demonstrations of different training concepts.
    """

    name: str
    skills: Mapping[int, float]
    better: float | None
    more: int | None
    without: tuple[int, ...] = ()
    several: bool = False

    @classmethod
    def of(
        cls,
        demonstrations: Demonstrations,
        horizon: int,
        training: Demonstrations | None = None,
        learned: tuple[str, float] | None = None,
        without: Collection[int] = (),
        followed: Places | None = None,
    ) -> Self | None:
        """Measure demonstrations of one concept.

        Args:
            horizon: number of states that are compared.
            training: demonstrations of training concepts, if there are any: what behaviour varies by.
            learned: a learned form that is better than every reference on left-out demonstrations, and its skill.
            without: demonstrations to leave out, as they are likely faulty.
            followed: places that are known already.

        Returns:
            The result; ``None`` for fewer than :data:`FEWEST` demonstrations, or paths of more than :data:`LARGEST` numbers.
        """
        out = tuple(sorted(without))
        rows = [row for row in range(len(demonstrations)) if row not in out]
        if (count := len(rows)) < FEWEST or horizon * demonstrations.states.shape[2] > LARGEST:
            return None
        demonstrations = demonstrations.rows(rows)
        every, fresh = _skills(demonstrations, horizon, training, followed)
        sizes = sorted(next(iter(every.values())))
        last = sizes[-1]
        wanted = {name: _wanted(skills, count) for name, skills in every.items()}
        name = max(every, key=lambda name: every[name][last])
        if training is not None and fresh > DISTINCT:
            return cls(name, every[name], None, None, out, several=True)
        enough = [name for name, needed in wanted.items() if needed is not None and needed <= count]
        if enough:
            best = max(enough, key=lambda name: every[name][last])
            return cls(best, every[best], None, 0, out)
        if learned and learned[1] >= BETTER and every[name][last] - every[name][sizes[-2]] <= RISING:
            return cls(learned[0], every[name], learned[1], 0, out)
        needed = wanted[name]
        return cls(name, every[name], None, None if needed is None else max(needed - count, 1), out)

    @property
    def last(self) -> float:
        """Skill from all demonstrations but one."""
        return self.skills[max(self.skills)] if self.better is None else self.better

    @property
    def suffices(self) -> bool:
        """Whether no more are asked for."""
        return self.more == 0

    def __str__(self) -> str:
        # Rounded down: 0.857 is not yet HIGH.
        curve = ", ".join(f"{math.floor(100 * skill) / 100:.2f} from {size}" for size, skill in self.skills.items())
        without = f"without {numbered(self.without)}, " if self.without else ""
        if self.several:
            return f"enough: {without}no: {SEVERAL}"
        if self.better is not None:
            said = f"{self.name} has skill {self.better:.2f} on left-out demonstrations (the best reference {curve})"
        else:
            said = f"skill on left-out demonstrations {curve} ({self.name}, without learning)"
        if self.suffices:
            return f"enough: {without}{said}: these suffice"
        asked = "many more" if self.more is None else f"about {self.more} more"
        return (
            f"enough: {without}{asked} {'is' if self.more == 1 else 'are'} asked for: {said}; {HIGH} suffices where it hardly rises"
        )


def _wanted(skills: Mapping[int, float], count: int) -> int | None:
    """Number of demonstrations at which the skill is high and hardly rises, if the score falls as 1 / number; ``None`` for many."""
    (fewer, before), (size, last) = list(skills.items())[-2:]
    if last >= HIGH and (last - before <= RISING or before >= HIGH):
        return count
    score, slope = 1 / last, max(1 / before - 1 / last, 0.0) / (1 / fewer - 1 / size)  # relative to that of fresh demonstrations

    def expected(number: int) -> float:
        return 1 / max(score - slope * (1 / size - 1 / number), 1e-3)

    for number in range(size + 1, MANY):
        if expected(number) >= HIGH and (expected(number) - expected(number - 1) <= RISING or expected(number - 1) >= HIGH):
            return max(number + 1, count + 1)  # one is left out
    return None


def _skills(
    demonstrations: Demonstrations, horizon: int, training: Demonstrations | None, followed: Places | None
) -> tuple[dict[str, dict[int, float]], float]:
    """Skill of references made from some of the demonstrations on others, by name and number of demonstrations, and score of fresh
    demonstrations relative to behaviour of all training concepts.
    """
    known = demonstrations if training is None else training
    setting, columns = Setting.of(known, horizon, followed), Columns(known.state_kinds)
    centre = columns.encode(known.states).flatten(0, 1).mean(dim=0)

    def encoded(paths: Tensor) -> Tensor:
        return (columns.encode(paths) - centre).float()

    real, own = encoded(first_windows(known, horizon)), encoded(first_windows(demonstrations, horizon))
    features, count = PathFeatures(real), len(demonstrations)
    left = list(range(0, count, -(-count // FOLDS)))
    some = torch.randperm(len(real), generator=generator("cpu", 0, 8))[: 4 * SAMPLES]
    unit = features.scores(real[some].expand(len(left), -1, -1, -1), own[left]).mean(dim=0).clamp(min=1e-9)
    if setting.places:
        moved = Reference.of(SHIFTED, demonstrations, setting, horizon)
        starts = [demonstrations.initial_states.take(torch.full((count,), row)).observed for row in left]
        fresh = torch.stack([ceiling(features, encoded(moved.each(observed))) for observed in starts]).mean(dim=0)
    else:
        fresh = ceiling(features, own)
    best, sizes = float((fresh / unit).mean()) + LEAST, sorted({size for size in (2, count - 2, count - 1) if size > 0})
    found: dict[str, dict[int, float]] = {}
    for name in (WARPED, GAUSSIAN, SHIFTED):
        for size in sizes:
            drawn, truth = [], []
            for out in left:
                others = [(out + 1 + step) % count for step in range(count - 1)]
                observed = demonstrations.initial_states.take(torch.full((SAMPLES,), out)).observed
                for first in range(min(SUBSETS, count - 1) if size < count - 1 else 1):
                    rows = sorted(others[(first + step) % len(others)] for step in range(size))
                    made = Reference.of(name, demonstrations.rows(rows), setting, horizon)
                    drawn.append(encoded(made.sample(observed, SAMPLES, generator("cpu", 0, 12, out, first))))
                    truth.append(own[out])
            score = (features.scores(torch.stack(drawn), torch.stack(truth)) / unit).mean()
            found.setdefault(name, {})[size] = best / (float(score) + LEAST)
    return found, best - LEAST


MOST = 20
"""Maximum number of demonstrations that are compared."""
DRAWN, DRAWN_MOVED = 48, 24
"""Sets of training demonstrations that give the limit: without, and with observed places."""
RIVAL = 2.0
"""Weight of the distance to the nearest training concept, chosen on all sets of benchmarks/experiments/check_real.py."""
EVEN = 0.2
"""Variance that is added to that within concepts in each number of a feature, relative to the mean variance."""


class Outliers:
    """How much more a demonstration differs from the others than these from each other and than it from a training concept.

    Paths are moved to the same places where places are observed. Each number of the features of
    :class:`~ftl_lightning.data.distances.PathFeatures` is scaled by its standard deviation within training concepts. With the mean
    distance ``d`` of a demonstration to the others, ``o`` among the others, and ``r`` to the nearest training concept, the score
    is the mean over features of ``log(d / o) + 2 log(d / r)``. A demonstration is an outlier if its score is the largest, and
    larger than in sets of as many demonstrations of a training concept, which is then not among those compared with.

    Args:
        training: demonstrations of training concepts.
        horizon: number of states that are compared.
        followed: places that are known already.
    """

    def __init__(self, training: Demonstrations, horizon: int, followed: Places | None = None) -> None:
        self.horizon, self.setting, self.columns = horizon, Setting.of(training, horizon, followed), Columns(training.state_kinds)
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

    def _score(self, paths: Tensor, seen: Observed, without: int | None = None) -> Tensor:
        """Outliers ``(demo,)`` of paths ``(demo, horizon, state)``, compared with training concepts but one."""
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
        """Largest usual score among ``count`` demonstrations of a concept."""
        draw, most = generator("cpu", 0, 11), []
        for number in range(DRAWN_MOVED if self.setting.places else DRAWN):
            concept = number % len(self.rows)
            rows = self.rows[concept]
            chosen = [rows[index] for index in torch.randperm(len(rows), generator=draw)[:count].tolist()]
            most.append(self._score(self.paths[chosen], _of(self.seen, chosen), concept).max())
        return float(torch.stack(most).max())

    def outlier(self, demonstrations: Demonstrations) -> int | None:
        """Index of the outlier; ``None`` without any, or with too few demonstrations or training concepts."""
        if not FEWEST <= len(demonstrations) <= MOST or len(self.rows) < 2:
            return None
        score = self._score(first_windows(demonstrations, self.horizon), vectors_of(demonstrations))
        return int(score.argmax()) if float(score.max()) > self.limit(len(demonstrations)) else None


def _of(observed: Observed, rows: list[int]) -> Observed:
    return {name: values[rows] for name, values in observed.items()}
