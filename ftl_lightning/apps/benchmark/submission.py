"""Submission files, and scores from their rows."""

import dataclasses
import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ftl_lightning.apps.benchmark.suite import BenchmarkSuite, load_suite
from ftl_lightning.services.errors import about
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.tensor_file import content_hash, write_text
from ftl_lightning.services.validation import from_mapping, read_json
from ftl_lightning.version import __version__

KIND, FORMAT = "few-shot concepts", 1
MOST = 4 * 2**20  # maximum size of a file in bytes; nine suites with three seeds need a twentieth
PRETRAINED, GIVEN = "pretrained", "given"  # origins of a model: pretrained in the run, or given


@dataclass(frozen=True, kw_only=True)
class Row:
    """Measurements of a test task: ``n`` samples or episodes, and values by name, rounded to six decimals."""

    setting: str
    concept: str
    n: int
    measures: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Run:
    """Run of a suite with a seed.

    Attributes:
        model, configuration: hashes of the pretrained model, and of the whole configuration.
        origin: ``pretrained`` in this run, or ``given``.
        data: hashes of the drawn data, by part.
        pretraining_seconds, seconds: duration of pretraining (0 for a given model), and of learning with evaluation.
        rows, references: a row for each concept of the test, of the method and of reference policies by name, if the suite has
            them.
    """

    suite: str
    seed: int
    model: str
    origin: str
    data: Mapping[str, str]
    configuration: str
    pretraining_seconds: float
    seconds: float
    rows: Sequence[Row]
    references: Mapping[str, Sequence[Row]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Mean over concepts of a suite's first measure, averaged over seeds, with standard error, 0 for a single concept."""

    mean: float
    error: float
    concepts: int


@dataclass(frozen=True, kw_only=True)
class Submission:
    """Results of a method.

    Attributes:
        method, name: registered name of the method, and name in tables.
        code: hash of the package with the method; empty for methods of ftl-lightning.
        version, machine: version of ftl-lightning, and description of the machine.
        seeds, suites: seeds of every suite, and hashes of the suites' definitions by name.
        runs, scores: a run for each suite and seed, and scores of complete suites.
    """

    kind: str = KIND
    format: int = FORMAT
    method: str
    name: str
    code: str = ""
    version: str = __version__
    machine: Mapping[str, str]
    seeds: Sequence[int]
    suites: Mapping[str, str]
    runs: Sequence[Run] = ()
    scores: Mapping[str, Score] = field(default_factory=dict)

    def run(self, suite: str, seed: int) -> Run | None:
        """The run of a suite and a seed, or ``None``."""
        return next((run for run in self.runs if (run.suite, run.seed) == (suite, seed)), None)

    @property
    def hash(self) -> str:
        """16-digit hash of the content."""
        return content_hash(dataclasses.asdict(self))

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        write_text(path, json.dumps(dataclasses.asdict(self), indent=1, ensure_ascii=False) + "\n")

    @classmethod
    def load(cls, path: Path) -> "Submission":
        """Read a file; nothing that it names is imported or opened. Raise UserError for an invalid file, naming file and key."""
        check_readable(path, "submission", MOST)
        with about(path):
            return from_mapping(cls, read_json(path, "a submission"), "")


def machine() -> dict[str, str]:
    """Processor, system, Python, torch and threads, on which numbers depend; no name of a computer or person."""
    import torch

    file = Path("/proc/cpuinfo")
    lines = file.read_text("utf-8", errors="replace").splitlines() if file.is_file() else []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return {
        "processor": next(models, platform.processor() or "unknown"),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def score(suite: BenchmarkSuite, rows: Sequence[Sequence[Row]], measure: str = "") -> Score:
    """Score of a suite from the rows of each seed, for its first measure by default."""
    values: dict[tuple[str, str], list[float]] = {}
    for seed_rows in rows:
        for row in seed_rows:
            values.setdefault((row.setting, row.concept), []).append(row.measures[measure or suite.headline])
    tasks = [values[task.setting, task.concept] for task in suite.test]
    means = [sum(known) / len(known) for known in tasks]
    count, mean = len(means), sum(means) / len(means)
    variance = sum((value - mean) ** 2 for value in means) / (count - 1) if count > 1 else 0.0
    return Score(mean=round(mean, 6), error=round((variance / count) ** 0.5, 6), concepts=count)


def scored(submission: Submission) -> Submission:
    """Add the scores of complete suites."""
    scores = {}
    for name in submission.suites:
        runs = [run for seed in submission.seeds if (run := submission.run(name, seed)) is not None]
        if len(runs) == len(submission.seeds):
            scores[name] = score(load_suite(name), [run.rows for run in runs])
    return dataclasses.replace(submission, scores=scores)
