"""The paper's table of a study: how often each method depicts a concept, and how often it depicts it best."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table
from scipy.stats import binomtest

from ftl_lightning.apps.study.agreement import krippendorff_alpha
from ftl_lightning.apps.study.answers import Key, Rater, inattention, read_key, read_raters
from ftl_lightning.apps.study.films import NEW, TRAINING
from ftl_lightning.apps.study.questions import BEST, DEPICTS, YES
from ftl_lightning.evaluation.summary import literal
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.text import line

LABELS = {BEST: "judged best", DEPICTS: "depicts the concept"}
"""Labels of the questions, in the order of the paper's table."""


@dataclass(frozen=True)
class Share:
    """How often raters chose a method in a setting, in per cent.

    Attributes:
        mean: mean over raters and scenarios.
        spread: standard deviation over raters of each rater's mean over scenarios (divisor: number of raters, as in the paper).
        low, high: Wilson's 95 % interval, as if answers were independent.
        answers: number of answers.
    """

    mean: float
    spread: float
    low: float
    high: float
    answers: int


@dataclass(frozen=True)
class Report:
    """Results of a study.

    Attributes:
        shares: by setting, question and method.
        agreement: Krippendorff's alpha by setting and question.
        scenarios: number of scenarios, by setting.
        raters: number of raters whose answers count.
        dropped: one line for every inattentive rater.
        refused: one line for every file that does not have finished answers to this study.
    """

    shares: Mapping[tuple[str, str, str], Share]
    agreement: Mapping[tuple[str, str], float]
    scenarios: Mapping[str, int]
    raters: int
    dropped: tuple[str, ...]
    refused: tuple[str, ...]

    @property
    def methods(self) -> list[str]:
        """Methods in alphabetical order."""
        return sorted({method for _, _, method in self.shares})

    def table(self) -> Table:
        """One row for each setting and question, one column for each method."""
        scenarios = ", ".join(f"{count} {setting}" for setting, count in self.scenarios.items())
        raters = "1 rater" if self.raters == 1 else f"{self.raters} raters"
        table = Table(
            title=literal(f"{raters}; scenarios: {scenarios}", "table.title"), box=box.SIMPLE, title_justify="left", padding=0
        )
        for name in ("setting", "per cent", *self.methods, "alpha"):
            table.add_column(literal(name), justify="left" if name in ("setting", "per cent") else "right")
        for setting in self.scenarios:
            for kind, label in LABELS.items():
                shares = [self.shares.get((setting, kind, method)) for method in self.methods]
                if any(shares):
                    cells = ["" if share is None else _cell(share) for share in shares]
                    alpha = self.agreement.get((setting, kind), math.nan)
                    table.add_row(literal(setting), label, *cells, "-" if math.isnan(alpha) else f"{alpha:.2f}")
        return table


def _cell(share: Share) -> str:
    return f"{share.mean:.1f} ± {share.spread:.1f} ({share.low:.0f} to {share.high:.0f})"


def study_table(answers: Sequence[Path], key: Path, keep_all: bool = False) -> Report:
    """The table of a study's answers.

    Args:
        answers: files, or folders of files ``answers*.json``.
        key: the study's key.
        keep_all: whether raters who failed attention checks count.

    Raises:
        UserError: for a key that cannot be read, and if no rater is left, with the first reason.
    """
    known = read_key(key)
    raters, refused = read_raters(answers, known)
    reasons = {rater.name: inattention(rater, known) for rater in raters}
    attentive = [rater for rater in raters if keep_all or not reasons[rater.name]]
    dropped = tuple(
        f"{rater.file}: {reasons[rater.name]}; {'kept' if keep_all else 'left out'}" for rater in raters if reasons[rater.name]
    )
    if not attentive:
        first = (*refused, *dropped, "no files were given")[0]
        others = len(refused) + len(dropped) - 1
        raise UserError(f"{first}{f' (and {others} more)' if others > 0 else ''}; there is nothing left to report")
    return _counted(known, attentive, dropped, tuple(refused))


def _counted(key: Key, raters: Sequence[Rater], dropped: tuple[str, ...], refused: tuple[str, ...]) -> Report:
    said: dict[tuple[str, str, str], dict[str, list[bool]]] = {}
    """By setting, question and method, then by rater: whether the method was chosen, in each scenario."""
    units: dict[tuple[str, str], list[list[str]]] = {}
    scenarios: dict[str, set[str]] = {}
    for name, question in key.of_kind(DEPICTS).items():
        film = key.films[question["films"][0]]
        setting, method = film["setting"], film["method"]
        scenarios.setdefault(setting, set()).add(film["scenario"])
        units.setdefault((setting, DEPICTS), []).append([rater.answers[name] for rater in raters])
        for rater in raters:
            said.setdefault((setting, DEPICTS, method), {}).setdefault(rater.name, []).append(rater.answers[name] == YES)
    for name, question in key.of_kind(BEST).items():
        setting = question["setting"]
        units.setdefault((setting, BEST), []).append([key.films[rater.answers[name]]["method"] for rater in raters])
        for rater in raters:
            for film_name in question["films"]:
                chosen = rater.answers[name] == film_name
                method = key.films[film_name]["method"]
                said.setdefault((setting, BEST, method), {}).setdefault(rater.name, []).append(chosen)
    order = sorted(scenarios, key=lambda name: ({TRAINING: 0, NEW: 1}.get(name, 2), name))
    return Report(
        shares={where: _share(list(by_rater.values())) for where, by_rater in said.items()},
        agreement={where: krippendorff_alpha(ratings) for where, ratings in units.items()},
        scenarios={setting: len(scenarios[setting]) for setting in order},
        raters=len(raters),
        dropped=tuple(map(line, dropped)),
        refused=tuple(map(line, refused)),
    )


def _share(by_rater: Sequence[Sequence[bool]]) -> Share:
    """Percentage from the answers of each rater in each scenario."""
    means = np.array([np.mean(answered) for answered in by_rater])
    answers = sum(map(len, by_rater))
    interval = binomtest(sum(map(sum, by_rater)), answers).proportion_ci(method="wilson")
    return Share(100 * float(means.mean()), 100 * float(means.std()), 100 * interval.low, 100 * interval.high, answers)


NOTES = (
    "mean ± standard deviation over raters of each rater's mean over scenarios, as in the paper; in brackets Wilson's 95 %",
    "interval, which takes answers as independent and is too narrow where they are not; alpha: Krippendorff's, nominal",
)
"""Notes below the table."""
