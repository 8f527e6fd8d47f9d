"""Paired tests of two methods, over tasks or over episodes with the same initial states."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binom, t

from ftl_lightning.domains.comparison import Compared
from ftl_lightning.evaluation.results import label
from ftl_lightning.services.text import counted

LEVEL = 0.05  # significance level of p
EXACT = 20  # maximum number of differences for the exact test
DRAWS = 10_000  # number of drawn sign patterns otherwise
INTERVAL = 4  # minimum number of units for an interval
ROUNDING = 2e-6  # tolerance for equal means; results have six digits
AHEAD, BEHIND, UNSHOWN, UNDECIDED = "ahead", "behind", "no difference shown", "undecided"
SAME = "the same in every task and seed"


def sign_flip(parts: Sequence[float]) -> float:
    """Two-sided p of a sum of paired differences under random signs: if neither method is better, both signs are equally likely.
    The test is exact up to :data:`EXACT` nonzero differences; else p is (b + 1) / (draws + 1), where b of :data:`DRAWS` drawn sums
    are at least as far from zero. ``parts`` are the contributions of the pairs to the mean difference.
    """
    moving = np.array([part for part in parts if abs(part) > ROUNDING])
    threshold = abs(moving.sum()) - ROUNDING
    if len(moving) <= EXACT:
        sums = np.zeros(1)
        for part in moving:
            sums = np.concatenate((sums + part, sums - part))
        return float(np.mean(np.abs(sums) >= threshold))
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (DRAWS, len(moving)))
    return float((1 + np.sum(np.abs(signs @ moving) >= threshold)) / (DRAWS + 1))


def holm(values: Sequence[float]) -> list[float]:
    """Corrected p values of several tests, in the given order (Holm, 1979): the smallest times the number of tests, and so on,
    ascending.
    """
    adjusted, largest = [1.0] * len(values), 0.0
    for rank, index in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        largest = max(largest, min(1.0, (len(values) - rank) * values[index]))
        adjusted[index] = largest
    return adjusted


def reachable(signs: int, tests: int) -> bool:
    """Whether this number of signs can reach significance: if all agree, p is 2 / 2^signs, times the number of tests."""
    return tests * 2.0 ** (1 - signs) < LEVEL


@dataclass(frozen=True)
class Lead:
    """Ours against a baseline, in a setting and a metric.

    Attributes:
        difference: mean over tasks of means over seeds; positive if ours is better.
        units: number of tasks that were compared, or of learned concepts if tasks share them, such as ``'5 tasks'``.
        p: p-value after Holm's correction; ``None`` for too few units.
        same: whether both are equal in every task and seed.
        interval: 95 % interval of the difference over units (Student's t); ``None`` for fewer than :data:`INTERVAL`.
    """

    baseline: Compared
    difference: float
    units: str
    p: float | None
    same: bool = False
    interval: tuple[float, float] | None = None

    @property
    def verdict(self) -> str:
        """Verdict, from the five of this module."""
        if self.same:
            return SAME
        if self.p is None:
            return UNDECIDED
        return UNSHOWN if up(self.p) >= LEVEL else AHEAD if self.difference > 0 else BEHIND

    @property
    def shown(self) -> str:
        """The verdict with p or the number of units."""
        return self.verdict if self.same else f"{self.verdict} ({self.units if self.p is None else chance(self.p)})"

    @property
    def amount(self) -> str:
        """The difference, with its interval."""
        if self.same or self.interval is None:
            return signed(self.difference)
        low, high = self.interval
        return f"{signed(self.difference)} [{low:+.2f}, {high:+.2f}]"

    def __str__(self) -> str:
        return f"{self.amount} against {label(*self.baseline)}, {self.shown}"


def signed(difference: float) -> str:
    """Format with sign and two digits, or three if two would show zero."""
    digits = 3 if ROUNDING < abs(difference) < 0.005 else 2
    return f"{round(difference, digits) + 0.0:+.{digits}f}"  # adding zero removes a negative zero


def up(p: float) -> float:
    """Round p up to three digits, for display and verdict: a displayed .050 is not significant."""
    return math.ceil(round(1000 * p, 6)) / 1000


def chance(p: float) -> str:
    """Format a p value: ``'p = .023'``, or ``'p < .001'``."""
    below, p = p < 0.001, up(p)
    if below:
        return "p < .001"
    return "p = 1" if p == 1 else f"p = {p:.{3 if p < 0.1 else 2}f}".replace("0.", ".", 1)


def leads(
    rows: pd.DataFrame, ours: Compared, baselines: Sequence[Compared], learned: Mapping[str, str], less: bool = False
) -> list[Lead]:
    """Compare ours with each baseline by a sign-flip permutation test over tasks.

    Seeds of a task are averaged: they are not independent tasks. Tasks that compose the same learned concept are a single unit.
    The signs of whole units are flipped, so p generalises to similar tasks. With too few units there is no verdict: of five tasks p
    is .06 at best. Enough means that p can fall below :data:`LEVEL` after Holm's correction for the number of baselines, which also
    covers the choice of the best baseline afterwards.

    Args:
        rows: rows of a setting and a metric, with ``task``, ``seed``, ``method``, ``form`` and ``value``.
        baselines: methods to compare with; methods without rows are left out.
        learned: learned concept by task; a task that is missing is a unit of its own.
        less: whether less is better.
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
    found = []
    for baseline, differences in compared.items():
        tasks = differences.groupby("task").mean()
        parts = (tasks / len(tasks)).groupby([learned.get(task, task) for task in tasks.index]).sum().to_numpy()
        noun = "task" if len(parts) == len(tasks) else "learned concept"
        same = bool((differences.abs() <= ROUNDING).all())
        lead = Lead(baseline, float(tasks.mean()), counted(len(parts), noun), sign_flip(parts.tolist()), same, _interval(parts))
        found.append((lead, reachable(len(parts), len(compared))))
    corrected = holm([lead.p or 0.0 for lead, _ in found])
    return [replace(lead, p=p if enough else None) for (lead, enough), p in zip(found, corrected, strict=True)]


def _interval(parts: NDArray[np.float64]) -> tuple[float, float] | None:
    """95 % interval of the sum of the contributions of units."""
    if (count := len(parts)) < INTERVAL:
        return None
    half = float(t.ppf(0.975, count - 1) * parts.std(ddof=1) * count**0.5)
    return float(parts.sum()) - half, float(parts.sum()) + half


def least_certain(compared: Sequence[Lead]) -> Lead | None:
    """Lead that decides the overall verdict: *behind* before undecided before *ahead*, then the smallest difference; ``None``
    without leads.
    """
    return min(compared, key=lambda lead: ({BEHIND: 0, AHEAD: 2}.get(lead.verdict, 1), lead.difference), default=None)


def episodes(won: int, lost: int, count: int) -> str:
    """Format a paired difference of success rates with 95 % interval, McNemar's exact p and the number of equal outcomes. In
    ``won`` or ``lost`` pairs of ``count`` only the first, or only the second, succeeds. The interval is Wald's with half an episode
    added to each of the four outcomes (Agresti & Min, 2005); otherwise it has no width when no episode differs.
    """
    apart, all_four = won + lost, count + 2
    middle = (won - lost) / all_four
    error = 1.96 * math.sqrt((apart + 1) / all_four - middle**2) / math.sqrt(all_four)
    interval = f"[{middle - error:+.2f}, {middle + error:+.2f}]"
    return f"{(won - lost) / count:+.2f} {interval}, {chance(mcnemar(won, lost))}, {same_outcome(won, lost, count)}"


def mcnemar(won: int, lost: int) -> float:
    """McNemar's exact two-sided p; arguments as in :func:`episodes`."""
    return min(1.0, 2 * float(binom.cdf(min(won, lost), won + lost, 0.5)))


def same_outcome(won: int, lost: int, count: int) -> str:
    """Format the number of episodes in which both succeed or both fail."""
    return f"same outcome in {count - won - lost} of {count}"
