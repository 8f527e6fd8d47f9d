"""Answers of raters, and the paper's table of a study: how often each method depicts a concept, and how often it does so best."""

import math
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich import box
from rich.table import Table
from scipy.stats import binomtest

from ftl_lightning.apps.study.page import FORMAT, KEY_KIND
from ftl_lightning.apps.study.questions import BEST, CHECK, DEPICTS, NEW, NO, REPEAT, TRAINING, YES, FilmSource
from ftl_lightning.evaluation.summary import literal
from ftl_lightning.services.errors import UserError, about, require, short, shown
from ftl_lightning.services.tensor_file import check_kind
from ftl_lightning.services.text import line
from ftl_lightning.services.validation import from_mapping, read_json

ANSWERS_KIND = "study answers"
REPEATS_THAT_MAY_DIFFER = 0.5  #: Maximum fraction of repeated questions that an attentive rater may answer inconsistently.
LABELS = {BEST: "judged best", DEPICTS: "depicts the concept"}  #: Labels of the questions, in the order of the paper's table.
NOTES = (
    "mean ± standard deviation over raters of each rater's mean over scenarios, as in the paper; in brackets Wilson's 95 %",
    "interval, which takes answers as independent and is too narrow where they are not; alpha: Krippendorff's, nominal",
)
"""Notes below the table."""


@dataclass(frozen=True)
class Question:
    """Meaning of a question about films, by id: the known answer of a check, or scenario and setting of a comparison."""

    kind: Literal["depicts", "best", "check", "repeat"]
    text: str
    films: tuple[str, ...]
    expected: str = ""
    scenario: str = ""
    setting: str = ""


@dataclass(frozen=True)
class Key:
    """Meaning of a study's questions and films, by id, with 16-digit identifiers of the study and of its page."""

    study: str
    page: str
    questions: Mapping[str, Question]
    films: Mapping[str, FilmSource]

    def of_kind(self, kind: str) -> dict[str, Question]:
        """Questions of a kind, by id."""
        return {name: question for name, question in self.questions.items() if question.kind == kind}

    def repeated(self) -> dict[str, str]:
        """Id of the original of each repeated question; empty if there is none."""
        original = {(question.text, question.films): name for name, question in self.of_kind(DEPICTS).items()}
        return {name: original.get((question.text, question.films), "") for name, question in self.of_kind(REPEAT).items()}


@dataclass(frozen=True)
class Rater:
    """Answers of a person by question id: ``'yes'``, ``'no'``, or a film's id; the name is 16 digits drawn by the browser."""

    file: Path
    name: str
    answers: Mapping[str, str]


def _json(path: Path, kind: str) -> dict[str, Any]:
    with about(path):
        return check_kind(read_json(path, f"a {kind} file"), kind, FORMAT)


def read_key(path: Path) -> Key:
    """Read the key written by ``study``. Raise UserError naming the file, if it is missing, damaged or of another kind."""
    content = _json(path, KEY_KIND)
    with about(path):
        key = from_mapping(Key, {name: content[name] for name in ("study", "page", "questions", "films") if name in content}, "")
        for name, question in key.questions.items():
            known = question.films and {*question.films} <= key.films.keys()
            require(known, f"key 'questions.{short(name)}.films'", "some of the key's films", short(", ".join(question.films)))
            complete = {CHECK: question.expected, BEST: question.setting and question.scenario}.get(question.kind, True)
            require(
                complete, f"key 'questions.{short(name)}'", "what a check expects, or a comparison's scenario and setting", "none"
            )
        require(all(key.repeated().values()), "key 'questions'", "the original of each repeated question", "none")
    return key


def read_rater(path: Path, key: Key) -> Rater:
    """Read a file of answers. Raise UserError if it is missing, damaged, of another study or page, or not finished."""
    content = _json(path, ANSWERS_KIND)
    for part, expected in (("study", key.study), ("page", key.page)):
        actual = f"{shown(content.get(part))}; the answers are of another {part}"
        require(content.get(part) == expected, f"{path}: key {part!r}", expected, actual)
    name, given = content.get("rater"), content.get("answers")
    if not isinstance(name, str) or not name or not isinstance(given, list):
        raise UserError(f"{path}: expected a rater and a list of answers, found a damaged file")
    answers: dict[str, str] = {}
    for entry in given:
        if entry is None:  # a question that was not reached
            continue
        identifier = entry.get("id") if isinstance(entry, dict) else None
        question = key.questions.get(identifier) if isinstance(identifier, str) else None
        if question is None or entry["id"] in answers:
            raise UserError(f"{path}: key 'answers': expected one answer to each question, found {shown(entry)}")
        allowed, answer = question.films if question.kind == BEST else (YES, NO), entry.get("answer")
        require(answer in allowed, f"{path}: answer to {entry['id']}", " or ".join(allowed), shown(answer))
        answers[entry["id"]] = entry["answer"]
    finished = content.get("finished") and len(answers) == len(key.questions)
    expected = f"{len(key.questions)} answers of a finished run"
    require(finished, str(path), expected, f"{len(answers)}; finish it in the same browser")
    return Rater(path, name, answers)


def read_raters(paths: Sequence[Path], key: Key) -> tuple[list[Rater], list[str]]:
    """Read raters from files, or folders with files ``answers*.json``; also a line for each refused file."""
    files: list[Path] = []
    refused: list[str] = []
    for path in paths:
        inside = sorted(path.glob("answers*.json")) if path.is_dir() else [path]
        if not inside:
            refused.append(f"{path}: expected files answers*.json in this folder, found none")
        files += inside
    raters: dict[str, Rater] = {}
    for path in dict.fromkeys(files):
        try:
            rater = read_rater(path, key)
            expected = f"another rater than {raters.get(rater.name, rater).file} has"
            require(rater.name not in raters, str(path), expected, "the same; keep one of the two")
            raters[rater.name] = rater
        except UserError as error:
            refused.append(str(error))
    return list(raters.values()), refused


def inattention(rater: Rater, key: Key) -> str:
    """Reason to exclude a rater's answers, or empty: any check answered wrongly, or more than :data:`REPEATS_THAT_MAY_DIFFER` of
    the repeated questions answered inconsistently.
    """
    checks = key.of_kind(CHECK)
    wrong = sum(rater.answers[name] != question.expected for name, question in checks.items())
    if wrong:
        return f"{wrong} of {len(checks)} attention checks answered wrongly"
    pairs = key.repeated()
    differ = sum(rater.answers[repeat] != rater.answers[original] for repeat, original in pairs.items())
    if differ > REPEATS_THAT_MAY_DIFFER * len(pairs):
        return f"{differ} of {len(pairs)} questions that were asked twice answered in two ways"
    return ""


def krippendorff_alpha(units: Iterable[Sequence[Hashable]]) -> float:
    """Krippendorff's alpha of categories without an order: 1 for full agreement, 0 for chance, negative below chance.
    ``1 - D_observed / D_expected``, see K. Krippendorff, "Computing Krippendorff's Alpha-Reliability", 2011, part C and D. A unit
    has the raters' categories; units with fewer than two are ignored. NaN if all categories are equal.
    """
    paired = [Counter(unit) for unit in units if len(unit) > 1]
    totals = sum(paired, Counter())
    count = totals.total()
    # Pairs within a unit that differ, weighted so that every value counts once.
    observed = sum((u.total() ** 2 - sum(n * n for n in u.values())) / (u.total() - 1) for u in paired)
    expected = count**2 - sum(n * n for n in totals.values())
    return 1 - (count - 1) * observed / expected if expected else math.nan


@dataclass(frozen=True)
class Share:
    """Percentage of answers in a setting for a method.

    Attributes:
        mean: mean over raters and scenarios.
        spread: standard deviation over raters of each rater's mean over scenarios (divisor: number of raters, as in the paper).
        low, high: Wilson's 95 % interval, as if the ``answers`` were independent.
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
        shares: share of answers for a method, by setting, question and method.
        agreement: Krippendorff's alpha by setting and question.
        scenarios, raters: number of scenarios by setting, and of raters whose answers count.
        dropped, refused: lines about inattentive raters, and about files without finished answers to this study.
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
        """Table with a row per setting and question and a column per method."""
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
    """Evaluate a study's answers, in files or in folders of ``answers*.json``; ``keep_all`` includes raters who failed attention
    checks. Raise UserError for a key that cannot be read, and if no rater is left, with the first reason.
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
    # By setting, question and method, then by rater: whether the method was chosen, in each scenario.
    chosen: dict[tuple[str, str, str], dict[str, list[bool]]] = {}
    units: dict[tuple[str, str], list[list[str]]] = {}
    scenarios: dict[str, set[str]] = {}
    for name, question in key.of_kind(DEPICTS).items():
        film = key.films[question.films[0]]
        scenarios.setdefault(film.setting, set()).add(film.scenario)
        units.setdefault((film.setting, DEPICTS), []).append([rater.answers[name] for rater in raters])
        where = (film.setting, DEPICTS, film.method)
        for rater in raters:
            chosen.setdefault(where, {}).setdefault(rater.name, []).append(rater.answers[name] == YES)
    for name, question in key.of_kind(BEST).items():
        units.setdefault((question.setting, BEST), []).append([key.films[rater.answers[name]].method for rater in raters])
        for rater in raters:
            for film_name in question.films:
                where = (question.setting, BEST, key.films[film_name].method)
                chosen.setdefault(where, {}).setdefault(rater.name, []).append(rater.answers[name] == film_name)
    order = sorted(scenarios, key=lambda name: ({TRAINING: 0, NEW: 1}.get(name, 2), name))
    return Report(
        shares={where: _share(list(by_rater.values())) for where, by_rater in chosen.items()},
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
