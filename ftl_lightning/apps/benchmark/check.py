"""Check a submission: its form, completeness and consistency, and a part of its numbers by running it again.

Only numbers and known names of suites and concepts are read from a file. No code that it names is run: the user names the method.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ftl_lightning.apps.benchmark.run import SHIPPED, Entry, scored, temporary
from ftl_lightning.apps.benchmark.submission import FORMAT, GIVEN, KIND, PRETRAINED, Row, Run, Submission, machine
from ftl_lightning.apps.benchmark.suite import ASKED, SEEDS, TRAINING, BenchmarkSuite, load_suite, suite_names
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.tensor_file import content_hash
from ftl_lightning.services.text import say
from ftl_lightning.training.methods import code_hash, load_method
from ftl_lightning.version import __version__

HASH = re.compile(r"[0-9a-f]{16}")
NAME = re.compile(r"[\w .+()-]{1,60}")
"""Allowed names of methods."""
ROUNDING = 2e-6
"""Tolerance for values rounded to six decimals."""
ERRORS = 3
"""Tolerance of rates in standard errors on another machine, where learning amplifies rounding."""
LEAST, MOST = 0.0, 1.0


def check_submission(path: Path) -> tuple[Submission, dict[str, BenchmarkSuite]]:
    """Read a submission and check its completeness and its agreement with itself and the frozen suites.

    Returns:
        The submission, and its suites by name.

    Raises:
        UserError: naming the file and the first error, with expected and actual value.
    """
    submission = Submission.load(path)
    with about(path):
        _expect_header(submission)
        suites = {name: _expect_suite(submission, name) for name in submission.suites}
        _expect_runs(submission, suites)
        _expect_scores(submission)
    return submission, suites


def _expect(good: bool, key: str, expected: object, value: object) -> None:
    if not good:
        raise UserError(f"{key}: expected {expected}, found {short(str(value), 80)}")


def _expect_header(submission: Submission) -> None:
    _expect(submission.kind == KIND, "kind", repr(KIND), repr(submission.kind))
    _expect(submission.format == FORMAT, "format", FORMAT, submission.format)
    for key in ("method", "name"):
        value = getattr(submission, key)
        _expect(NAME.fullmatch(value) is not None, key, "letters, digits and a few signs, at most 60", repr(value))
    _expect(tuple(submission.seeds) == SEEDS, "seeds", list(SEEDS), list(submission.seeds))
    _expect(bool(submission.suites), "suites", f"some of {', '.join(suite_names())}", "none")
    _expect(not submission.code or HASH.fullmatch(submission.code) is not None, "code", "a hash of 16 digits", "another text")
    for key, value in submission.machine.items():
        _expect(len(key) + len(value) <= 200, "machine", "short texts", f"{len(key) + len(value)} characters")


def _expect_suite(submission: Submission, name: str) -> BenchmarkSuite:
    suite = load_suite(name)
    _expect(
        submission.suites[name] == suite.hash,
        f"suites.{short(name)}",
        f"the frozen suite's hash {suite.hash}",
        submission.suites[name],
    )
    return suite


def _expect_runs(submission: Submission, suites: Mapping[str, BenchmarkSuite]) -> None:
    seen = set()
    for index, run in enumerate(submission.runs):
        key = f"runs[{index}]"
        _expect(run.suite in suites, f"{key}.suite", f"one of {', '.join(suites)}", repr(run.suite))
        _expect(run.seed in submission.seeds, f"{key}.seed", f"one of {list(submission.seeds)}", run.seed)
        where = f"{run.suite}, seed {run.seed}"
        _expect((run.suite, run.seed) not in seen, key, f"one run of {where}", "two")
        seen.add((run.suite, run.seed))
        _expect_run(run, suites[run.suite], where)
    for name in suites:
        for seed in submission.seeds:
            _expect((name, seed) in seen, "runs", f"one of {name}, seed {seed}", "none")


def _expect_run(run: Run, suite: BenchmarkSuite, where: str) -> None:
    for key, value in (("model", run.model), ("configuration", run.configuration)):
        _expect(HASH.fullmatch(value) is not None, f"{where}: {key}", "a hash of 16 digits", repr(value))
    _expect(run.origin in (PRETRAINED, GIVEN), f"{where}: origin", f"{PRETRAINED} or {GIVEN}", repr(run.origin))
    known = suite.data.get(str(run.seed), {})
    parts = [part for part in known if part in ((TRAINING, *ASKED) if run.origin == PRETRAINED else ASKED)]
    for part in parts:
        value = run.data.get(part, "none")
        _expect(value == known[part].hash, f"{where}: data.{part}", f"the frozen data's hash {known[part].hash}", value)
    _expect(set(run.data) == set(parts), f"{where}: data", ", ".join(parts) or "nothing", ", ".join(run.data))
    for key, seconds in (("seconds", run.seconds), ("pretraining_seconds", run.pretraining_seconds)):
        _expect(seconds >= 0, f"{where}: {key}", "0 or more", seconds)
    _expect_rows(run.rows, suite, where, tuple(suite.measures))
    _expect(len(run.references) <= 20, f"{where}: references", "at most 20", len(run.references))
    for name, rows in run.references.items():
        _expect(NAME.fullmatch(name) is not None, f"{where}: references", "names of reference lines", repr(name))
        _expect_rows(rows, suite, f"{where}, {name}", (suite.headline,))


def _expect_rows(rows: Sequence[Row], suite: BenchmarkSuite, where: str, measures: Sequence[str]) -> None:
    """Check that each concept of the test occurs once, with the measures and the suite's number of samples."""
    tasks = [(task.setting, task.concept) for task in suite.test]
    measured = [(row.setting, row.concept) for row in rows]
    for task in tasks:
        count = measured.count(task)
        _expect(count == 1, f"{where}: rows", f"one of {task[1]!r} ({task[0]})", count or "none")
    for row in rows:
        _expect((row.setting, row.concept) in tasks, f"{where}: rows", "concepts of the test alone", repr(row.concept))
        place = f"{where}, {short(row.concept, 40)}"
        _expect(row.n == suite.samples, f"{place}: n", suite.samples, row.n)
        _expect(
            set(measures) <= set(row.measures) <= set(suite.measures),
            f"{place}: measures",
            ", ".join(measures),
            ", ".join(row.measures),
        )
        for name, value in row.measures.items():
            rate = suite.is_rate(name)
            _expect(value >= LEAST and (not rate or value <= MOST), f"{place}: {name}", "0 to 1" if rate else "0 or more", value)
            whole = abs(value * row.n - round(value * row.n)) <= row.n * ROUNDING
            _expect(not rate or whole, f"{place}: {name}", f"a whole number of {row.n} samples", value)


def _expect_scores(submission: Submission) -> None:
    expected = scored(submission).scores
    _expect(set(submission.scores) == set(expected), "scores", ", ".join(expected), ", ".join(submission.scores))
    for name, score in expected.items():
        submitted = submission.scores[name]
        _expect(submitted.concepts == score.concepts, f"scores.{name}.concepts", score.concepts, submitted.concepts)
        for key in ("mean", "error"):
            mine, theirs = getattr(score, key), getattr(submitted, key)
            _expect(abs(mine - theirs) <= ROUNDING, f"scores.{name}.{key}", f"{mine}, which the rows come to", theirs)


def drawn(submission: Submission, share: float, salt: str) -> list[Run]:
    """The runs to run again, with at least a share of all rows.

    The draw depends on a hash of the file and a word of the checker: without the word, a file cannot be tuned to a favourable
    draw.

    Args:
        submission: the checked submission.
        share: share of its rows, 0 for none.
        salt: the word; may be empty.
    """
    whole = submission.hash
    order = sorted(submission.runs, key=lambda run: content_hash([salt, whole, run.suite, run.seed]))
    wanted = share * sum(len(run.rows) for run in submission.runs)
    runs: list[Run] = []
    while sum(len(run.rows) for run in runs) < wanted:
        runs.append(order[len(runs)])
    return runs


@dataclass(frozen=True)
class Difference:
    """A number that was not reproduced."""

    run: Run
    where: str
    submitted: object
    found: object

    def __str__(self) -> str:
        return f"{self.run.suite}, seed {self.run.seed}, {short(self.where, 80)}: submitted {self.submitted}, found {self.found}"


def allowed(submitted: float, found: float, n: int, rate: bool, alike: bool) -> bool:
    """Whether a number was reproduced: exactly on a machine of the same kind, else approximately.

    Args:
        submitted, found: the numbers.
        n: number of samples.
        rate: whether the numbers are shares; other numbers may differ by a fifth on another machine.
        alike: whether processor, versions and threads are the same.
    """
    apart = abs(submitted - found)
    if apart <= ROUNDING:
        return True
    if alike:
        return False
    if not rate:
        return apart <= 0.2 * max(submitted, found)
    # Keep the standard error above 0 when all samples are right or wrong.
    mean = min(max((submitted + found) / 2, 1 / n), 1 - 1 / n)
    return apart <= ERRORS * (2 * mean * (1 - mean) / n) ** 0.5


def differences(run: Run, again: Run, suite: BenchmarkSuite, alike: bool) -> Iterator[Difference]:
    """Differences between a submitted run and the same run here."""
    if alike and run.configuration != again.configuration:
        yield Difference(run, "configuration", run.configuration, again.configuration)
    if (alike or again.origin == GIVEN) and run.model != again.model:
        yield Difference(run, "model", run.model, again.model)
    pairs = [("", run.rows, again.rows), *((name, rows, again.references.get(name, ())) for name, rows in run.references.items())]
    for name, rows, repeated in pairs:
        known = {(row.setting, row.concept): row for row in repeated}
        for row in rows:
            repeat = known.get((row.setting, row.concept))
            for measure, value in row.measures.items():
                where = ", ".join(filter(None, (name, row.concept, measure)))
                if repeat is None or measure not in repeat.measures:
                    yield Difference(run, where, value, "none")
                elif not allowed(value, repeat.measures[measure], row.n, suite.is_rate(measure), alike):
                    yield Difference(run, where, value, repeat.measures[measure])


def recompute(
    entry: Entry, submission: Submission, suites: Mapping[str, BenchmarkSuite], share: float, salt: str
) -> list[Difference]:
    """Run a part of a submission again and return the differences.

    Raises:
        UserError: for another method, or one that cannot be run here.
    """
    method = load_method(entry.method)
    if method.name != submission.name:
        raise UserError(f"method: expected {submission.method!r}, which the submission is of, found {entry.method!r}")
    if submission.code != code_hash(entry.method):
        say("note: the method's code is not that of the submission", error=True)
    alike = dict(submission.machine) == machine() and submission.version == __version__
    chosen = drawn(submission, share, salt)
    differing: list[Difference] = []
    count, total = (sum(len(run.rows) for run in runs) for runs in (chosen, submission.runs))
    say(f"running {len(chosen)} of {len(submission.runs)} runs again, {count} of {total} rows")
    if not alike:
        say("note: another machine or version: rates may differ by three standard errors, as rounding does", error=True)
    with temporary(entry) as copy:
        for run in chosen:
            # Given models default to the shipped models.
            same = replace(copy, model=SHIPPED) if run.origin == GIVEN and not copy.model else copy
            again = same.run(suites[run.suite], run.seed)
            differ = list(differences(run, again, suites[run.suite], alike))
            say(f"{run.suite}, seed {run.seed}: {f'{len(differ)} numbers differ' if differ else 'the same'}")
            differing += differ
    return differing
