"""Which of two methods is better, from tasks and seeds that both were measured on, or from episodes with the same starts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binom

from ftl_lightning.domains.paper import Compared
from ftl_lightning.evaluation.row import label

LEVEL = 0.05
"""A difference is shown where p is below this."""
EXACT = 20
"""Up to so many differences every pattern of signs is tried."""
DRAWS = 10_000
"""Patterns that are drawn where there are more."""
ROUNDING = 2e-6
"""Results are written with six digits; means nearer than this are equal."""
AHEAD, BEHIND, UNSHOWN, UNDECIDED = "ahead", "behind", "no difference shown", "undecided"
SAME = "the same in every task and seed"


def sign_flip(parts: Sequence[float]) -> float:
    """Two-sided p of a sum of paired differences: how often it is at least as far from zero when their signs are drawn.

    If neither method is better, each difference is as likely with the other sign. Exact up to :data:`EXACT` differences that are
    not zero (a zero has no sign to flip); else of :data:`DRAWS` drawn patterns, as (b + 1) / (draws + 1) where b are as far.

    Args:
        parts: what each pair adds to the mean difference.
    """
    moving = np.array([part for part in parts if abs(part) > ROUNDING])
    far = abs(moving.sum()) - ROUNDING
    if len(moving) <= EXACT:
        sums = np.zeros(1)
        for part in moving:
            sums = np.concatenate((sums + part, sums - part))
        return float(np.mean(np.abs(sums) >= far))
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (DRAWS, len(moving)))
    return float((1 + np.sum(np.abs(signs @ moving) >= far)) / (DRAWS + 1))


def holm(values: Sequence[float]) -> list[float]:
    """Corrected p values of tests that are read together, each in its place (Holm, 1979).

    The smallest is multiplied by their number, the next by one less, and so on; none is below the one before it.
    """
    adjusted, largest = [1.0] * len(values), 0.0
    for rank, index in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        largest = max(largest, min(1.0, (len(values) - rank) * values[index]))
        adjusted[index] = largest
    return adjusted


def reachable(signs: int, tests: int) -> bool:
    """Whether so many signs could show a difference: where all agree, two of 2^signs patterns are as far, times the tests."""
    return tests * 2.0 ** (1 - signs) < LEVEL


@dataclass(frozen=True)
class Lead:
    """Ours beside a baseline, in one setting and metric.

    Attributes:
        baseline: which.
        difference: by how much ours is better, negative where the baseline is: the mean over tasks of means over seeds.
        pairs: of task and seed that both were measured on.
        p: after Holm's correction; ``None`` where the pairs are too few to show anything.
        same: whether every pair is equal.
    """

    baseline: Compared
    difference: float
    pairs: int
    p: float | None
    same: bool = False

    @property
    def verdict(self) -> str:
        """One of the five words of this module."""
        if self.same:
            return SAME
        if self.p is None:
            return UNDECIDED
        return UNSHOWN if up(self.p) >= LEVEL else AHEAD if self.difference > 0 else BEHIND

    @property
    def shown(self) -> str:
        """The verdict with what it stands on."""
        if self.same:
            return self.verdict
        because = chance(self.p) if self.p is not None else f"{self.pairs} pair" + "s" * (self.pairs > 1)
        return f"{self.verdict} ({because})"

    def __str__(self) -> str:
        return f"{signed(self.difference)} against {label(*self.baseline)}, {self.shown}"


def signed(difference: float) -> str:
    """With its sign and two digits, or three where two would show a zero that is none."""
    digits = 3 if ROUNDING < abs(difference) < 0.005 else 2
    return f"{round(difference, digits) + 0.0:+.{digits}f}"  # adding zero turns a negative zero into a positive one


def up(p: float) -> float:
    """Rounded up to three digits, as it is shown and judged: one that is shown as .050 is not below it."""
    return math.ceil(round(1000 * p, 6)) / 1000


def chance(p: float) -> str:
    """A p value in words, ``'p = .023'``; ``'p < .001'`` for a smaller one."""
    below, p = p < 0.001, up(p)
    if below:
        return "p < .001"
    return "p = 1" if p == 1 else f"p = {p:.{3 if p < 0.1 else 2}f}".replace("0.", ".", 1)


def leads(rows: pd.DataFrame, ours: Compared, baselines: Sequence[Compared], less: bool = False) -> list[Lead]:
    """Ours beside each baseline, by a sign-flip permutation test of differences paired by task and seed.

    Seeds of a task are not independent tasks. Where tasks are enough, the signs of whole tasks are flipped, and p speaks of tasks
    like these. Else those of (task, seed) pairs are, and p speaks of new seeds of just these tasks: demonstrations, learning and
    samples, not the pretrained model. Where even these are too few (a single task and three seeds have p = .25 at the least),
    nothing is decided. Enough is what could reach :data:`LEVEL` after Holm's correction for the number of baselines, which makes it
    no matter that the best of them is known only afterwards.

    Args:
        rows: of one setting and metric, with ``task``, ``seed``, ``method``, ``form`` and ``value``.
        ours: the method that is compared.
        baselines: methods that it is compared with; those without rows are left out.
        less: whether of the metric less is better.

    Returns:
        In the order of ``baselines``; none where ours or all of them were not measured.
    """
    values = {
        Compared(*map(str, named)): measured.groupby(["task", "seed"])["value"].mean() * (-1 if less else 1)
        for named, measured in rows.groupby(["method", "form"])
    }
    compared = {
        baseline: differences
        for baseline in baselines
        if {ours, baseline} <= set(values) and not (differences := (values[ours] - values[baseline]).dropna()).empty
    }
    parts = {baseline: _parts(differences, len(compared)) for baseline, differences in compared.items()}
    corrected = dict(zip(parts, holm([sign_flip(flipped) for flipped in parts.values()]), strict=True))
    return [
        Lead(
            baseline,
            difference=float(differences.groupby("task").mean().mean()),
            pairs=len(differences),
            p=corrected[baseline] if reachable(len(parts[baseline]), len(compared)) else None,
            same=bool((differences.abs() <= ROUNDING).all()),
        )
        for baseline, differences in compared.items()
    ]


def _parts(differences: pd.Series, tests: int) -> list[float]:
    """What each whole task, or else each pair, adds to the mean over tasks; the signs of these are flipped together."""
    by_task = differences.groupby("task")
    parts = differences / by_task.transform("size") / by_task.ngroups
    return list(parts.groupby("task").sum() if reachable(by_task.ngroups, tests) else parts)


def least_certain(compared: Sequence[Lead]) -> Lead | None:
    """The lead that a single verdict is about: *ahead* is ahead of every baseline, *behind* is behind at least one.

    Of those with the same verdict it is the best baseline's. ``None`` for none.
    """
    return min(compared, key=lambda lead: ({BEHIND: 0, AHEAD: 2}.get(lead.verdict, 1), lead.difference), default=None)


def episodes(won: int, lost: int, count: int) -> str:
    """A paired difference of two success rates with its 95 % interval, McNemar's exact p, and how many outcomes are the same.

    The interval is Wald's with half an episode added to each of the four outcomes (Agresti & Min, 2005): without that it has no
    width where no episode differs.

    Args:
        won, lost: pairs in which only the one succeeds, and only the other.
        count: all pairs.
    """
    apart, all_four = won + lost, count + 2
    middle = (won - lost) / all_four
    error = 1.96 * math.sqrt((apart + 1) / all_four - middle**2) / math.sqrt(all_four)
    interval = f"[{middle - error:+.2f}, {middle + error:+.2f}]"
    return f"{(won - lost) / count:+.2f} {interval}, {chance(mcnemar(won, lost))}, {same_outcome(won, lost, count)}"


def mcnemar(won: int, lost: int) -> float:
    """The exact two-sided p of so many pairs in which only the one succeeds, and only the other."""
    return min(1.0, 2 * float(binom.cdf(min(won, lost), won + lost, 0.5)))


def same_outcome(won: int, lost: int, count: int) -> str:
    """In how many episodes both succeed or both do not."""
    return f"same outcome in {count - won - lost} of {count}"
