"""Leaderboard page from a folder of submissions."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ftl_lightning.apps.benchmark.check import check_submission
from ftl_lightning.apps.benchmark.submission import GIVEN, Row, Run, Score, Submission, score
from ftl_lightning.apps.benchmark.suite import BenchmarkSuite, load_suite, suite_names
from ftl_lightning.services.errors import require
from ftl_lightning.services.tensor_file import visible
from ftl_lightning.services.text import markdown

BEGIN, END = "<!-- leaderboard: begin -->\n", "<!-- leaderboard: end -->\n"
HEAD = """# Leaderboard

This page is made by `ftl-lightning benchmark --leaderboard docs/leaderboard.md` from the files in `results/submissions`,
each of which passes `benchmark --check`. [The protocol](benchmark.md) says what the numbers mean and how to add a line.
"""


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
    suites = [load_suite(name) for name in suite_names()]
    chosen = [suite for suite in suites if any(suite.name in entry.suites for entry in submissions)]
    parts = [HEAD, BEGIN, *(_section(suite, submissions) for suite in chosen)]
    if missing := [suite.title for suite in suites if suite not in chosen]:
        parts.append(f"No submission has these suites yet: {', '.join(map(markdown, missing))}.\n")
    return "\n".join((*parts, END))


def _section(suite: BenchmarkSuite, submissions: Sequence[Submission]) -> str:
    runs = {
        entry.name: [run for run in entry.runs if run.suite == suite.name] for entry in submissions if suite.name in entry.suites
    }
    measures = [name if kind == "rate" else f"{name} (less is better)" for name, kind in suite.measures.items()]
    head = ["method", *measures, "model", "pretraining, s", "learning and evaluation, s"]
    lines = sorted(_lines(suite, runs), key=lambda line: -line[0])
    table = [_row(head), _row(["---"] * len(head)), *(_row(cells) for _, cells in lines)]
    return f"## {markdown(suite.title)}\n\n" + "\n".join(table) + "\n"


def _lines(suite: BenchmarkSuite, runs: Mapping[str, Sequence[Run]]) -> Iterator[tuple[float, list[str]]]:
    """Score and cells of each line: methods, then reference policies of the first submission with them."""
    others = [name for name in suite.measures if name != suite.headline]
    for name, group in runs.items():
        rows = [run.rows for run in group]
        main = score(suite, rows)
        model = "given" if group[0].origin == GIVEN else "pretrained"
        times = [f"{sum(getattr(run, key) for run in group) / len(group):.0f}" for key in ("pretraining_seconds", "seconds")]
        times[0] = "-" if group[0].origin == GIVEN else times[0]
        yield (
            main.mean,
            [f"**{markdown(name)}**", _shown(main), *(_shown(score(suite, rows, measure)) for measure in others), model, *times],
        )
    references: dict[str, list[Sequence[Row]]] = {}
    for group in runs.values():
        common = set.intersection(*(set(run.references) for run in group))
        references = {name: [run.references[name] for run in group] for name in sorted(common)} | references
    for name, known in references.items():
        main = score(suite, known)
        measured = set.intersection(*({*row.measures} for seed_rows in known for row in seed_rows))
        cells = [_shown(score(suite, known, measure)) if measure in measured else "-" for measure in others]
        yield main.mean, [f"*{markdown(name)}*", _shown(main), *cells, "-", "-", "-"]


def _shown(value: Score) -> str:
    return f"{value.mean:.2f} ± {value.error:.2f}" if value.concepts > 1 else f"{value.mean:.2f}"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
