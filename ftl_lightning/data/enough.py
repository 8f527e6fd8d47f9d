"""Whether a few demonstrations suffice: skill on left-out demonstrations by the number of demonstrations, without learning."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.check import numbered
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.energy import PathFeatures, ceiling
from ftl_lightning.data.kinds import Columns
from ftl_lightning.data.places import first_windows
from ftl_lightning.data.references import GAUSSIAN, SHIFTED, WARPED, Reference, Setting
from ftl_lightning.services.randomness import generator

HIGH, BETTER = 0.86, 0.6
"""Minimum skill of a reference that suffices, and of a learned form that is better than every reference."""
RISING = 0.03
"""Minimum rise of the skill by the last demonstration for more to be asked for."""
SEVERAL = 0.9
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
    ) -> Self | None:
        """Measure demonstrations of one concept.

        Args:
            horizon: number of states that are compared.
            training: demonstrations of training concepts, if there are any: what behaviour varies by.
            learned: a learned form that is better than every reference on left-out demonstrations, and its skill.
            without: demonstrations to leave out, as they are likely faulty.

        Returns:
            The result; ``None`` for fewer than :data:`FEWEST` demonstrations, or paths of more than :data:`LARGEST` numbers.
        """
        out = tuple(sorted(without))
        demonstrations = demonstrations.rows([row for row in range(len(demonstrations)) if row not in out])
        count = len(demonstrations)
        if count < FEWEST or horizon * demonstrations.states.shape[2] > LARGEST:
            return None
        every, fresh = _skills(demonstrations, horizon, training)
        sizes = sorted(next(iter(every.values())))
        last = sizes[-1]
        wanted = {name: _wanted(skills, count) for name, skills in every.items()}
        name = max(every, key=lambda name: every[name][last])
        if training is not None and fresh > SEVERAL:
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
        curve = ", ".join(f"{skill:.2f} from {size}" for size, skill in self.skills.items())
        without = f"without {numbered(self.without)}, " if self.without else ""
        if self.several:
            return f"enough: {without}no: they differ from each other as much as demonstrations of different training concepts"
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
    demonstrations: Demonstrations, horizon: int, training: Demonstrations | None
) -> tuple[dict[str, dict[int, float]], float]:
    """Skill of references made from some of the demonstrations on others, by name and number of demonstrations, and score of fresh
    demonstrations relative to behaviour of all training concepts.
    """
    known = demonstrations if training is None else training
    setting, columns = Setting.of(known, horizon), Columns(known.state_kinds)
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
