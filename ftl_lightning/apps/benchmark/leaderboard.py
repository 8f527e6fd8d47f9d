"""Leaderboard page from a folder of submissions, with references: committed scores, which no submission changes."""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ftl_lightning.apps.benchmark.check import check_submission
from ftl_lightning.apps.benchmark.submission import GIVEN, PRETRAINED, Run, Score, Submission, score
from ftl_lightning.apps.benchmark.suite import BenchmarkSuite, load_suite, suite_names
from ftl_lightning.services.errors import about, require
from ftl_lightning.services.shipped import list_models, pretrained_folder
from ftl_lightning.services.tensor_file import file_hash, visible, write_text
from ftl_lightning.services.text import markdown
from ftl_lightning.services.validation import from_mapping, read_json
from ftl_lightning.training.model_folder import WEIGHTS

FILE = Path(__file__).parent / "references.json"
BEGIN, END = "<!-- leaderboard: begin -->\n", "<!-- leaderboard: end -->\n"
MARK = "≈"  # mark of methods whose numbers cannot be recomputed to the digit
HEAD = """# Leaderboard

How good are the submitted methods? `ftl-lightning benchmark --leaderboard docs/leaderboard.md` makes this page from the checked
files in `results/submissions`. Reference policies are in italics. [Benchmark](benchmark.md) explains the numbers and how to add
a method.
"""


@dataclass(frozen=True, kw_only=True)
class References:
    """Scores of reference policies.

    Attributes:
        version, machine: version of ftl-lightning and machine on which they were computed.
        suites: hashes of the suites' definitions by name.
        scores: scores by suite, reference policy and measure; without measures that a policy lacks.
    """

    version: str
    machine: Mapping[str, str]
    suites: Mapping[str, str]
    scores: Mapping[str, Mapping[str, Mapping[str, Score]]]

    @classmethod
    def load(cls) -> "References":
        """Read the committed file."""
        with about(FILE):
            return from_mapping(cls, read_json(FILE, "references"), "")

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        write_text(path, json.dumps(dataclasses.asdict(self), indent=1, ensure_ascii=False) + "\n")

    @classmethod
    def of(cls, run: Submission) -> "References":
        """References that a run of this package measured beside its method."""
        scores: dict[str, dict[str, dict[str, Score]]] = {}
        for name in sorted(run.suites):
            suite, runs = load_suite(name), [entry for entry in run.runs if entry.suite == name]
            for line in sorted(set.intersection(*(set(entry.references) for entry in runs))):
                rows = [entry.references[line] for entry in runs]
                measured = set.intersection(*({*row.measures} for seed_rows in rows for row in seed_rows))
                scores.setdefault(name, {})[line] = {
                    measure: score(suite, rows, measure) for measure in suite.measures if measure in measured
                }
        suites = {name: run.suites[name] for name in scores}
        return cls(version=run.version, machine=run.machine, suites=suites, scores=scores)


def suite_table() -> str:
    """Markdown table of suites, without hashes."""
    head = ["suite", "to pretrain on", "to tune on", "in the test", "demonstrations of each", "measures", "needs"]
    lines = []
    for suite in map(load_suite, suite_names()):
        more = f", and up to {suite.training.recoveries} recoveries of each" if suite.training.recoveries else ""
        lines.append(
            [
                f"`{suite.name}`",
                f"{suite.training.count} of each of {len(suite.training.concepts)} concepts{more}",
                str(len(suite.validation)),
                str(len({task.concept for task in suite.test})),
                str(suite.demonstrations),
                ", ".join(suite.measures),
                f"extra `{suite.needs}`" if suite.needs else "your own copy of the recordings" if suite.recordings else "nothing",
            ]
        )
    return "\n".join(_row(cells) for cells in (head, ["---"] * len(head), *lines))


def read_submissions(folder: Path) -> list[Submission]:
    """Submissions of a folder by name. Raise UserError for an invalid file, two submissions of a method, or an empty folder."""
    files = visible(folder, "*.json") if folder.is_dir() else []
    require(files, str(folder), "a folder of submissions (.json)", "none")
    by_name: dict[str, Submission] = {}
    for path in files:
        submission, _ = check_submission(path)
        require(submission.name not in by_name, str(path), f"one submission of {submission.name!r}", "two; remove one")
        by_name[submission.name] = submission
    return [by_name[name] for name in sorted(by_name)]


def leaderboard(submissions: Sequence[Submission]) -> str:
    """Leaderboard page in Markdown."""
    suites, references = [load_suite(name) for name in suite_names()], References.load()
    marks = {entry.name: reason for entry in submissions if (reason := inexact(entry, references))}
    chosen = [suite for suite in suites if any(suite.name in entry.suites for entry in submissions)]
    parts = [HEAD, BEGIN, *(_section(suite, submissions, references, marks) for suite in chosen)]
    if marks:
        parts.append(f"{MARK} These numbers cannot be recomputed to the digit ([how they are checked](benchmark.md)):\n")
        parts += [f"- {markdown(name)}: {reason}" for name, reason in marks.items()] + [""]
    if missing := [suite.title for suite in suites if suite not in chosen]:
        parts.append(f"No submission has these suites yet: {', '.join(map(markdown, missing))}.\n")
    return "\n".join((*parts, END))


def inexact(submission: Submission, references: References) -> str:
    """Why numbers of a submission cannot be recomputed to the digit, in Markdown; empty if they can. The machine that computed the
    references recomputes.
    """
    reasons = []
    ours = {"ftl-lightning": references.version, **references.machine}
    theirs = {"ftl-lightning": submission.version, **submission.machine}
    if different := [f"{key} {theirs.get(key) or 'unknown'}" for key in ours | theirs if ours.get(key) != theirs.get(key)]:
        reasons.append(f"measured with {markdown(', '.join(different))}")
    foreign = sorted({run.suite for run in submission.runs if run.origin == GIVEN and run.model not in _shipped_hashes()})
    if foreign:
        reasons.append(f"given models that do not ship: {', '.join(foreign)}")
    return "; ".join(reasons)


@cache
def _shipped_hashes() -> frozenset[str]:
    """Hashes of all models that ship."""
    files = (pretrained_folder(name) / WEIGHTS for name in list_models(baselines=True))
    return frozenset(file_hash(path) for path in files if path.is_file())


def _section(suite: BenchmarkSuite, submissions: Sequence[Submission], references: References, marks: Mapping[str, str]) -> str:
    runs = {
        entry.name: [run for run in entry.runs if run.suite == suite.name] for entry in submissions if suite.name in entry.suites
    }
    measures = [name if kind == "rate" else f"{name} (less is better)" for name, kind in suite.measures.items()]
    head = ["method", *measures, "model", "pretraining, s", "learning and evaluation, s"]
    lines = [*_lines(suite, runs, marks), *_reference_lines(suite, references)]
    lines.sort(key=lambda line: -line[0])
    table = [_row(head), f"|{'---|' * len(head)}", *(_row(cells) for _, cells in lines)]
    return f"## {markdown(suite.title)}\n\n" + "\n".join(table) + "\n"


def _lines(suite: BenchmarkSuite, runs: Mapping[str, Sequence[Run]], marks: Mapping[str, str]) -> Iterator[tuple[float, list[str]]]:
    """Score and cells of each method."""
    for name, group in runs.items():
        scores = [score(suite, [run.rows for run in group], measure) for measure in suite.measures]
        method = f"**{markdown(name)}**{f' {MARK}' if name in marks else ''}"
        pretraining = [run.pretraining_seconds for run in group if run.origin != GIVEN]
        times = [f"{sum(known) / len(known):.0f}" if known else "-" for known in (pretraining, [run.seconds for run in group])]
        yield scores[0].mean, [method, *map(_shown, scores), _origins(group), *times]


def _origins(group: Sequence[Run]) -> str:
    """Origin of the models; with seeds where it differs."""
    seeds = {origin: [str(run.seed) for run in group if run.origin == origin] for origin in (PRETRAINED, GIVEN)}
    known = {origin: numbers for origin, numbers in seeds.items() if numbers}
    if len(known) == 1:
        return next(iter(known))
    return ", ".join(f"{origin} (seed{'s' * (len(numbers) > 1)} {', '.join(numbers)})" for origin, numbers in known.items())


def _reference_lines(suite: BenchmarkSuite, references: References) -> Iterator[tuple[float, list[str]]]:
    """Score and cells of each reference policy; without model and times, which a reader of Markdown leaves empty."""
    for name, scores in references.scores.get(suite.name, {}).items():
        cells = [_shown(scores[measure]) if measure in scores else "-" for measure in suite.measures]
        yield scores[suite.headline].mean, [f"*{markdown(name)}*", *cells]


def _shown(value: Score) -> str:
    return f"{value.mean:.2f} ± {value.error:.2f}" if value.concepts > 1 else f"{value.mean:.2f}"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
