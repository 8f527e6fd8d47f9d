"""Check submissions: form, completeness and consistency, and a part of the numbers by running it again.

Only numbers and known names of suites and concepts are read from a file. No code that it names is run: the user names the method.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from tempfile import TemporaryDirectory

from ftl_lightning.apps.benchmark.run import SHIPPED, Candidate
from ftl_lightning.apps.benchmark.submission import FORMAT, GIVEN, KIND, PRETRAINED, Row, Run, Submission, machine, scored
from ftl_lightning.apps.benchmark.suite import REQUIRED, SEEDS, TRAINING, BenchmarkSuite, load_suite, suite_names
from ftl_lightning.services.errors import about, require, short
from ftl_lightning.services.tensor_file import content_hash
from ftl_lightning.services.text import say
from ftl_lightning.training.method import code_hash, load_method
from ftl_lightning.version import __version__

HASH = re.compile(r"(\d+:)?[0-9a-f]{16}")
NAME = re.compile(r"[\w .+()-]{1,60}")  # allowed names of methods
ROUNDING = 2e-6  # tolerance for values rounded to six decimals
ERRORS = 3  # tolerance of rates in standard errors on another machine, where learning amplifies rounding
DISTANCE = 0.2  # relative tolerance of distances on another machine, taken as ERRORS standard errors
LEVEL = 0.001  # two-sided probability that the tests of signed differences refuse an honest submission, all together
MOST_REFERENCES, MOST_MACHINE, MOST_VERSION = 20, 20, 60


def check_submission(path: Path) -> tuple[Submission, dict[str, BenchmarkSuite]]:
    """Read a submission with its suites by name, and check its completeness and its agreement with itself and the frozen suites.
    Raise UserError naming the file and the first error.
    """
    submission = Submission.load(path)
    with about(path):
        _check_header(submission)
        suites = {name: load_suite(name) for name in submission.suites}
        for name, suite in suites.items():
            recorded = submission.suites[name]
            require(recorded == suite.hash, f"suites.{short(name)}", f"the frozen suite's hash {suite.hash}", short(recorded))
        runs: dict[tuple[str, int], Run] = {}
        for index, run in enumerate(submission.runs):
            key, where = f"runs[{index}]", f"{run.suite}, seed {run.seed}"
            require(run.suite in suites, f"{key}.suite", f"one of {', '.join(suites)}", run.suite)
            require(run.seed in submission.seeds, f"{key}.seed", f"one of {list(submission.seeds)}", run.seed)
            require((run.suite, run.seed) not in runs, key, f"one run of {where}", "two")
            runs[run.suite, run.seed] = run
            _check_run(run, suites[run.suite], where)
        for name in suites:
            for seed in submission.seeds:
                require((name, seed) in runs, "runs", f"one of {name}, seed {seed}", "none")
        _check_scores(submission)
    return submission, suites


def _check_header(submission: Submission) -> None:
    require(submission.kind == KIND, "kind", repr(KIND), repr(short(submission.kind)))
    require(submission.format == FORMAT, "format", str(FORMAT), submission.format)
    for key in ("method", "name"):
        value = getattr(submission, key)
        require(NAME.fullmatch(value), key, "letters, digits and a few signs, at most 60", short(value))
    require(tuple(submission.seeds) == SEEDS, "seeds", str(list(SEEDS)), list(submission.seeds))
    require(submission.suites, "suites", f"some of {', '.join(suite_names())}", "none")
    require(not submission.code or HASH.fullmatch(submission.code), "code", "a hash of 16 digits", "another text")
    require(len(submission.version) <= MOST_VERSION, "version", f"at most {MOST_VERSION} characters", len(submission.version))
    require(len(submission.machine) <= MOST_MACHINE, "machine", f"at most {MOST_MACHINE} entries", len(submission.machine))
    for key, value in submission.machine.items():
        require(len(key) + len(value) <= 200, "machine", "short texts", f"{len(key) + len(value)} characters")


def _check_run(run: Run, suite: BenchmarkSuite, where: str) -> None:
    for key in ("model", "configuration"):
        value = getattr(run, key)
        require(HASH.fullmatch(value), f"{where}: {key}", "a hash of 16 digits", short(value))
    require(run.origin in (PRETRAINED, GIVEN), f"{where}: origin", f"{PRETRAINED} or {GIVEN}", short(run.origin))
    known, drawn_parts = suite.data.get(str(run.seed), {}), (TRAINING, *REQUIRED) if run.origin == PRETRAINED else REQUIRED
    parts = [part for part in known if part in drawn_parts]
    for part in parts:
        value = short(run.data.get(part, "none"))
        require(value == known[part].hash, f"{where}: data.{part}", f"the frozen data's hash {known[part].hash}", value)
    require(set(run.data) == set(parts), f"{where}: data", ", ".join(parts) or "nothing", short(", ".join(run.data)))
    for key in ("seconds", "pretraining_seconds"):
        seconds = getattr(run, key)
        require(seconds >= 0, f"{where}: {key}", "0 or more", seconds)
    _check_rows(run.rows, suite, where, suite.measures)
    require(len(run.references) <= MOST_REFERENCES, f"{where}: references", f"at most {MOST_REFERENCES}", len(run.references))
    for name, rows in run.references.items():
        require(NAME.fullmatch(name), f"{where}: references", "names of reference policies", short(name))
        _check_rows(rows, suite, f"{where}, {name}", {suite.headline})


def _check_rows(rows: Sequence[Row], suite: BenchmarkSuite, where: str, needed: Iterable[str]) -> None:
    """Check that each concept of the test occurs once, with the needed measures and the suite's number of samples."""
    tasks = [(task.setting, task.concept) for task in suite.test]
    measured = [(row.setting, row.concept) for row in rows]
    for task in tasks:
        count = measured.count(task)
        require(count == 1, f"{where}: rows", f"one of {task[1]!r} ({task[0]})", count or "none")
    for row in rows:
        place = f"{where}, {short(row.concept, 40)}"
        require((row.setting, row.concept) in tasks, f"{where}: rows", "concepts of the test alone", short(row.concept))
        require(row.n == suite.samples, f"{place}: n", str(suite.samples), row.n)
        complete = set(needed) <= set(row.measures) <= set(suite.measures)
        require(complete, f"{place}: measures", ", ".join(needed), short(", ".join(row.measures)))
        for name, value in row.measures.items():
            rate, key = suite.is_rate(name), f"{place}: {name}"
            require(value >= 0 and (value <= 1 or not rate), key, "0 to 1" if rate else "0 or more", value)
            whole = abs(value * row.n - round(value * row.n)) <= row.n * ROUNDING
            require(whole or not rate, key, f"a whole number of {row.n} samples", value)


def _check_scores(submission: Submission) -> None:
    expected = scored(submission).scores
    require(set(submission.scores) == set(expected), "scores", ", ".join(expected), short(", ".join(submission.scores)))
    for name, score in expected.items():
        submitted = submission.scores[name]
        require(submitted.concepts == score.concepts, f"scores.{name}.concepts", str(score.concepts), submitted.concepts)
        for key in ("mean", "error"):
            computed, given = getattr(score, key), getattr(submitted, key)
            require(abs(computed - given) <= ROUNDING, f"scores.{name}.{key}", f"{computed}, computed from the rows", given)


def drawn(submission: Submission, share: float, salt: str, whole: bool = False) -> list[Run]:
    """Draw the runs to run again, with at least a share of all rows, and all runs of the drawn suites if ``whole``. The draw
    depends on the file and a word, ``salt``: who does not know the word cannot tune a file to a favourable draw.
    """
    file_hash = submission.hash
    order = sorted(submission.runs, key=lambda run: content_hash([salt, file_hash, run.suite, run.seed]))
    minimum = share * sum(len(run.rows) for run in submission.runs)
    runs: list[Run] = []
    while sum(len(run.rows) for run in runs) < minimum:
        runs.append(order[len(runs)])
    suites = {run.suite for run in runs}
    return [run for run in submission.runs if run.suite in suites] if whole else runs


def allowed(submitted: float, repeated: float, n: int, rate: bool, alike: bool) -> bool:
    """Whether a number was reproduced: exactly on an alike machine (same processor, versions and threads), else approximately. A
    rate is a fraction of ``n`` samples; other numbers may differ by :data:`DISTANCE` on another machine.
    """
    difference = abs(submitted - repeated)
    if alike or difference <= ROUNDING:
        return difference <= ROUNDING
    if not rate:
        return difference <= DISTANCE * max(submitted, repeated)
    # Keep the standard error above 0 when all samples are right or wrong.
    mean = min(max((submitted + repeated) / 2, 1 / n), 1 - 1 / n)
    return difference <= ERRORS * (2 * mean * (1 - mean) / n) ** 0.5


def differences(run: Run, again: Run, suite: BenchmarkSuite, alike: bool) -> Iterator[str]:
    """Differences between a submitted run and the same run here, in words."""

    def difference(where: str, submitted: object, repeated: object) -> str:
        return f"{run.suite}, seed {run.seed}, {short(where, 80)}: submitted {submitted}, found {repeated}"

    if alike and run.configuration != again.configuration:
        yield difference("configuration", run.configuration, again.configuration)
    if (alike or again.origin == GIVEN) and run.model != again.model:
        yield difference("model", run.model, again.model)
    for name, rows in {"": run.rows, **run.references}.items():
        repeated_rows = again.references.get(name, ()) if name else again.rows
        known = {(row.setting, row.concept): row.measures for row in repeated_rows}
        for row in rows:
            repeated = known.get((row.setting, row.concept), {})
            for measure, value in row.measures.items():
                where = ", ".join(filter(None, (name, row.concept, measure)))
                if measure not in repeated:
                    yield difference(where, value, "none")
                elif not allowed(value, repeated[measure], row.n, suite.is_rate(measure), alike):
                    yield difference(where, value, repeated[measure])


@dataclass
class _Shift:
    """Sums over pairs of a submitted and a repeated value of a measure: the values, their signed differences, and the variances
    of these.
    """

    rows: int = 0
    submitted: float = 0.0
    repeated: float = 0.0
    difference: float = 0.0
    variance: float = 0.0

    def add(self, submitted: float, repeated: float, n: int, rate: bool) -> None:
        """Add a pair. Rates are fractions of ``n`` samples; distances are compared by their logarithms."""
        self.rows, self.submitted, self.repeated = self.rows + 1, self.submitted + submitted, self.repeated + repeated
        if rate:
            # Variance of a 2 x 2 table with fixed margins, as in the test of Cochran, Mantel and Haenszel.
            mean = (submitted + repeated) / 2
            self.difference += submitted - repeated
            self.variance += 4 * mean * (1 - mean) / (2 * n - 1)
        elif submitted > 0 and repeated > 0:
            self.difference += math.log(submitted / repeated)
            self.variance += (math.log1p(DISTANCE) / ERRORS) ** 2

    @property
    def standardised(self) -> float:
        """Sum of the differences in its standard errors; about standard normal if both values have the same expectation."""
        return self.difference / self.variance**0.5 if self.variance else 0.0


def shifted(pairs: Sequence[tuple[Run, Run]], suites: Mapping[str, BenchmarkSuite]) -> Iterator[str]:
    """Measures whose submitted values are, all rows of a suite together, further from the repeated ones than chance explains, in
    words. The scores of several suites are tested together, too. :data:`LEVEL` is shared equally by the tests.
    """
    shifts: dict[tuple[str, str], _Shift] = {}
    for run, again in pairs:
        known = {(row.setting, row.concept): row.measures for row in again.rows}
        for row in run.rows:
            repeated = known.get((row.setting, row.concept), {})
            for measure in row.measures.keys() & repeated.keys():
                shift = shifts.setdefault((run.suite, measure), _Shift())
                shift.add(row.measures[measure], repeated[measure], row.n, suites[run.suite].is_rate(measure))
    scores = [shifts[name, suite.headline] for name, suite in suites.items() if (name, suite.headline) in shifts]
    bound = NormalDist().inv_cdf(1 - LEVEL / 2 / max(len(shifts) + (len(scores) > 1), 1))
    for (name, measure), shift in sorted(shifts.items()):
        if abs(shift.standardised) > bound:
            means = f"submitted {shift.submitted / shift.rows:.3f}, found {shift.repeated / shift.rows:.3f}"
            errors = f"{shift.standardised:+.1f} standard errors, expected {bound:.1f} at most"
            yield f"{name}, mean {measure} of {shift.rows} rows: {means}: {errors}"
    together = sum(shift.standardised for shift in scores) / max(len(scores), 1) ** 0.5
    if len(scores) > 1 and abs(together) > bound:
        yield f"scores of {len(scores)} suites together: {together:+.1f} standard errors, expected {bound:.1f} at most"


def recompute(
    candidate: Candidate, submission: Submission, suites: Mapping[str, BenchmarkSuite], share: float, salt: str
) -> list[str]:
    """Run a part of a submission again; return the differences. Raise UserError for a method that is another or missing."""
    method = load_method(candidate.method)
    expected = f"{submission.method!r}, the method of the submission"
    require(method.name == submission.name, "method", expected, repr(candidate.method))
    if submission.code != code_hash(candidate.method):
        say("note: the method's code is not that of the submission", error=True)
    alike = dict(submission.machine) == machine() and submission.version == __version__
    chosen = drawn(submission, share, salt, whole=not alike)
    all_differences: list[str] = []
    pairs: list[tuple[Run, Run]] = []
    count, total = (sum(len(run.rows) for run in runs) for runs in (chosen, submission.runs))
    say(f"running {len(chosen)} of {len(submission.runs)} runs again, {count} of {total} rows")
    if not alike:
        rates = "each rate may differ by three standard errors, and the rates of a suite together by chance"
        say(f"note: another machine or version: {rates}; whole suites are run again", error=True)
    with TemporaryDirectory() as work:
        for run in chosen:
            # Given models default to the shipped models.
            model = SHIPPED if run.origin == GIVEN and not candidate.model else candidate.model
            again = replace(candidate, model=model, work=Path(work)).run(suites[run.suite], run.seed)
            found = list(differences(run, again, suites[run.suite], alike))
            say(f"{run.suite}, seed {run.seed}: {f'{len(found)} numbers differ' if found else 'the same'}")
            all_differences += found
            pairs.append((run, again))
    return all_differences if alike else [*all_differences, *shifted(pairs, suites)]
