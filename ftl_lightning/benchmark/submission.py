"""What a submission file holds, and the scores that are formed from its rows."""

import dataclasses
import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ftl_lightning.benchmark.suite import BenchmarkSuite
from ftl_lightning.errors import about
from ftl_lightning.limits import expect_readable
from ftl_lightning.schema import from_mapping, read_json
from ftl_lightning.tensor_file import content_hash, write_text
from ftl_lightning.version import __version__

KIND, FORMAT = "few-shot concepts", 1
MOST = 4 * 2**20
"""Bytes of a file; nine suites with three seeds come to a twentieth."""
PRETRAINED, GIVEN = "pretrained", "given"
"""Where a model is from: pretrained in the run, or given to it."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """What was measured of one concept.

    Attributes:
        setting, concept: what was asked.
        n: samples or episodes.
        measures: values by name, rounded to six decimals.
    """

    setting: str
    concept: str
    n: int
    measures: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Run:
    """One suite with one seed.

    Attributes:
        suite, seed: which.
        model: hash of the pretrained model.
        origin: ``pretrained`` in this run, or ``given``.
        data: hashes of the data that were drawn, by part.
        configuration: hash of everything that was configured.
        pretraining_seconds, seconds: of pretraining, 0 for a model that was given, and of learning with evaluation.
        rows: of the method, one for each concept of the test.
        references: rows of the reference lines by name; the suite says whether there are some.
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
    """Of a suite: the mean of its first measure over concepts, each of which is a mean over seeds.

    Attributes:
        mean: over concepts.
        error: standard error of this mean over concepts; 0 where there is a single one.
        concepts: how many.
    """

    mean: float
    error: float
    concepts: int


@dataclass(frozen=True, kw_only=True)
class Submission:
    """A method's numbers.

    Attributes:
        kind, format: of the file.
        method: the name under which its package offers it.
        name: in tables.
        code: hash of the package that offers the method; empty for the methods of ftl-lightning itself.
        version: of ftl-lightning.
        machine: what it ran on.
        seeds: that every suite was asked with.
        suites: hashes of the suites' definitions by name.
        runs: one for each suite and seed.
        scores: by suite; none of a suite that is not complete.
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
        """That of a suite and a seed, if it is there."""
        return next((run for run in self.runs if (run.suite, run.seed) == (suite, seed)), None)

    @property
    def hash(self) -> str:
        """16-digit hash of all that it says."""
        return content_hash(dataclasses.asdict(self))

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        write_text(path, json.dumps(dataclasses.asdict(self), indent=1, ensure_ascii=False) + "\n")

    @classmethod
    def load(cls, path: Path) -> "Submission":
        """Read one; nothing that it names is imported or opened.

        Raises:
            UserError: naming the file and the key, for one that is none.
        """
        expect_readable(path, "submission", MOST)
        with about(path):
            return from_mapping(cls, read_json(path, "a submission"), "")


def machine() -> dict[str, str]:
    """What numbers depend on besides the code: processor, system, Python, torch and threads. No computer or person is named."""
    import torch

    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _processor() -> str:
    """Its name, where the system tells it."""
    about_it = Path("/proc/cpuinfo")
    lines = about_it.read_text("utf-8", errors="replace").splitlines() if about_it.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or "unknown")


def by_concept(suite: BenchmarkSuite, rows: Sequence[Sequence[Row]], measure: str) -> list[float]:
    """The mean over seeds of a measure of each concept of the test, in the suite's order.

    Args:
        suite: whose test it is.
        rows: of each seed, all concepts.
        measure: its name.
    """
    found: dict[tuple[str, str], list[float]] = {(row.setting, row.concept): [] for row in rows[0]} if rows else {}
    for some in rows:
        for row in some:
            found[row.setting, row.concept].append(row.measures[measure])
    return [sum(values) / len(values) for task in suite.test if (values := found[task.setting, task.concept])]


def score(suite: BenchmarkSuite, rows: Sequence[Sequence[Row]], measure: str = "") -> Score:
    """The score of a suite from the rows of each seed; of its first measure, or of another."""
    values = by_concept(suite, rows, measure or suite.headline)
    count, mean = len(values), sum(values) / len(values)
    variance = sum((value - mean) ** 2 for value in values) / (count - 1) if count > 1 else 0.0
    return Score(mean=round(mean, 6), error=round((variance / count) ** 0.5, 6), concepts=count)
