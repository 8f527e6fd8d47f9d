"""Running a method through suites: pretraining, learning and evaluation by the same cells as an ablation."""

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from ftl_lightning.ablation.plan import Cell
from ftl_lightning.ablation.run import attempt
from ftl_lightning.benchmark.submission import GIVEN, PRETRAINED, Row, Run, Submission, score
from ftl_lightning.benchmark.suite import ASKED, TRAINING, BenchmarkSuite, load_suite
from ftl_lightning.configuration import load
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.errors import UserError, about, short
from ftl_lightning.evaluation.row import METHOD, REFERENCE
from ftl_lightning.learning.method import Method
from ftl_lightning.learning.methods import load_method
from ftl_lightning.learning.model_config import CONFIG
from ftl_lightning.printing import say
from ftl_lightning.progress import bar
from ftl_lightning.shipped import pretrained_folder, shipped
from ftl_lightning.tensor_file import write_text

if TYPE_CHECKING:
    import pandas as pd

SHIPPED = "shipped"
"""In place of a folder: the models that the method's configurations name."""
OURS = Path(__file__).parent / "configurations"
"""Configurations of our methods for suites of which ``conf`` has none: the families."""
KEPT_CONFIGURATION = "configuration.yaml"


@dataclass(frozen=True)
class Entry:
    """What is run.

    Attributes:
        method: the name under which its package offers it.
        model: folder of the pretrained models, in which ``{suite}`` and ``{seed}`` stand for these; :data:`SHIPPED`; or empty to
            pretrain.
        configurations: folder with a file ``SUITE.yaml`` for each suite, or ``suites.yaml`` for all others; empty for those of the
            method's package.
        root: folder of the user's recordings; ``None`` for none.
        work: folder for models and logs.
    """

    method: str
    model: str
    configurations: str
    root: Path | None
    work: Path

    @property
    def declared(self) -> Method:
        """What its package says it is."""
        return load_method(self.method)

    def configuration(self, suite: BenchmarkSuite) -> Path:
        """The file that configures ``fit`` and ``invert`` for a suite; written where the method brings none.

        Raises:
            UserError: for a folder that does not hold one.
        """
        folder = self.configurations or self.declared.configurations
        places = [Path(folder) / f"{suite.name}.yaml", Path(folder) / "suites.yaml"] if folder else []
        places += [] if self.configurations else [OURS / f"{self.method}.yaml"]
        if (found := next((path for place in places if (path := shipped(place)).is_file()), None)) is not None:
            return found
        if self.configurations:
            raise UserError(f"configurations: expected {suite.name}.yaml or suites.yaml in {short(folder, 80)}, found neither")
        return self._written(suite)

    def configurations_of(self, suite: BenchmarkSuite) -> tuple[str, ...]:
        """The files of a suite, in the order in which they are added to one another.

        Raises:
            UserError: where none of them names the method's way to learn.
        """
        path, added = self.configuration(suite), shipped(f"conf/method/{self.method}.yaml")
        expected = self.declared.adaptation.rpartition(":")[2]
        for files in ((path,), (path, added)):
            classes = [str((load(file, "invert").get("model") or {}).get("class_path", "")) for file in files if file.is_file()]
            if classes[-1].rpartition(".")[2] == expected:
                return tuple(map(str, files))
        raise UserError(f"{path}: invert: expected model.class_path {expected}, as {self.method} learns, found another")

    def _written(self, suite: BenchmarkSuite) -> Path:
        """The defaults of the method's classes."""
        method, path = self.declared, self.work / f"{suite.name}-{KEPT_CONFIGURATION}"
        content: dict[str, Any] = {
            "defaults": ["conf/verb.yaml"],
            "data": {"init_args": {"domain": suite.domain}},
            "fit": {
                "model": {"class_path": method.pretraining.replace(":", ".")},
                "data": {"class_path": "ftl_lightning.domains.data.PretrainingData"},
            },
            "invert": {"model": {"class_path": method.adaptation.replace(":", ".")}},
        }
        write_text(path, yaml.safe_dump(content))
        return path

    def trained(self, suite: BenchmarkSuite, seed: int) -> Path:
        """Where the model of a suite and a seed is, or will be.

        Raises:
            UserError: for a place where no model is that should be there.
        """
        if not self.model:
            return self.work / "models" / f"{suite.name}-seed{seed}"
        if self.model == SHIPPED:
            options = (load(self.configuration(suite), "invert").get("model") or {}).get("init_args") or {}
            place = str(options.get("pretrained") or "")
        else:
            place = self.model.replace("{suite}", suite.name).replace("{seed}", str(seed))
        if not place or not (pretrained_folder(place) / CONFIG).is_file():
            raise UserError(
                f"model: expected a pretrained model for suite {suite.name}, found none in {short(place, 80) or SHIPPED!r}"
            )
        return pretrained_folder(place)

    def cells(self, suite: BenchmarkSuite, seed: int) -> tuple[Cell | None, Cell]:
        """``fit``, unless a model is given, and ``invert``. What the suite freezes is not the method's to choose."""
        method = self.declared
        if not method.pretraining and not self.model:
            raise UserError(f"model: expected models of kind {method.kind}, which {method.name} does not pretrain, found none")
        files, model = self.configurations_of(suite), self.trained(suite, seed)
        name = f"{suite.name}, seed {seed}"
        shared = {
            "seed_everything": str(seed),
            "data.domain": suite.domain,
            "data.seed": str(seed),
            "trainer.enable_progress_bar": "false",
            "trainer.logger.init_args.save_dir": str(self.work / "logs"),
            "evaluation.figures": "0",
            "evaluation.samples": str(suite.samples),
            "evaluation.seed": str(seed),
        }
        if self.root is not None and suite.recordings:
            shared["data.root"] = str(self.root)
        fit = {"model.output": str(model), "data.samples_per_concept": str(suite.training.count), "data.more": "null"}
        fit |= {"data.recoveries": str(suite.training.recoveries), "evaluation.samples": "10"}
        # Rows of the domain table are there for texts that it knows; families have none.
        fit |= {} if load_domain(suite.domain).concepts.table else {"data.encoder": "hashing"}
        invert = {
            "model.pretrained": str(model),
            "data.suite": suite.test_suite,
            "data.demonstrations": "null",
            "data.demonstrations_per_concept": str(suite.demonstrations),
            "evaluation.suites": f"[{suite.test_suite}]",
            "evaluation.closed_loop": str(suite.closed_loop).lower(),
            "evaluation.references": str(suite.references).lower(),
            "evaluation.diversity": str("coverage" in suite.measures).lower(),
            "evaluation.environments": "[]",
        }
        done = str(model / CONFIG)
        pretraining = None if self.model else Cell("fit", files, shared | fit, done, f"fit {name}")
        return pretraining, Cell("invert", files, shared | invert, "", f"invert {name}")

    def run(self, suite: BenchmarkSuite, seed: int) -> Run:
        """Run a suite with a seed.

        Raises:
            UserError: for data that are not the frozen ones, and for whatever keeps the method from being run.
        """
        parts = ASKED if self.model else (TRAINING, *ASKED)
        if not suite.expect_data(seed, self.root, parts):
            say(f"note: suite {suite.name}, seed {seed}: this processor rounds the data in another way", error=True)
        fit, invert = self.cells(suite, seed)
        start = time.monotonic()
        if fit is not None and (failed := attempt(fit, set()).error):
            raise UserError(f"suite {suite.name}, seed {seed}, pretraining: {failed}")
        fitted = time.monotonic()
        outcome = attempt(invert, set())
        if outcome.error or outcome.rows is None:
            raise UserError(f"suite {suite.name}, seed {seed}: {outcome.error or 'expected rows, found none'}")
        rows = outcome.rows
        own = rows[rows["role"] == METHOD]
        measured = _rows(suite, own)
        asked = {(task.setting, task.concept) for task in suite.test}
        return Run(
            suite=suite.name,
            seed=seed,
            model=str(own["model_hash"].iloc[0]),
            origin=GIVEN if self.model else PRETRAINED,
            data={part: one.hash for part, one in suite.data.get(str(seed), {}).items() if part in parts},
            configuration=str(own["config_hash"].iloc[0]),
            pretraining_seconds=0.0 if fit is None else round(fitted - start, 1),
            seconds=round(time.monotonic() - fitted, 1),
            rows=measured,
            references={
                str(name): _rows(suite, some, suite.headline)
                for name, some in rows[rows["role"] == REFERENCE].groupby("method", sort=True)
                if asked <= _measured(some, suite.headline)
            },
        )


def _measured(table: "pd.DataFrame", measure: str) -> set[tuple[str, str]]:
    """Settings and concepts of which a measure is there; some reference lines are there for some settings alone."""
    own = table[table["metric"] == measure]
    return {*zip(own["setting"], own["task"], strict=True)}


def _rows(suite: BenchmarkSuite, table: "pd.DataFrame", *least: str) -> list[Row]:
    """Rows of the test's concepts; of a reference line those measures that it has, if it has at least some.

    Raises:
        UserError: naming a concept or a measure that is missing.
    """
    found = []
    for task in suite.test:
        own = table[(table["setting"] == task.setting) & (table["task"] == task.concept)]
        values = {
            str(name): float(value) for name, value in zip(own["metric"], own["value"], strict=True) if name in suite.measures
        }
        if missing := [name for name in (least or suite.measures) if name not in values]:
            raise UserError(f"suite {suite.name}, concept {task.concept!r}: expected the measure {missing[0]}, found none")
        n = int(own["n"].iloc[0])
        found.append(
            Row(
                setting=task.setting,
                concept=task.concept,
                n=n,
                measures={name: values[name] for name in suite.measures if name in values},
            )
        )
    return found


def run_benchmark(entry: Entry, begun: Submission, names: Sequence[str], out: Path) -> Submission:
    """Run all suites and seeds of a submission that it does not have yet; the file is written after each.

    Raises:
        UserError: at the end, naming suite and seed of the first that could not be run; what was done is in the file.
    """
    submission = begun
    failed: list[str] = []
    missing = [(suite, seed) for suite in map(load_suite, names) for seed in begun.seeds if begun.run(suite.name, seed) is None]
    with bar("cells", len(missing), lines=False) as advance:
        for number, (suite, seed) in enumerate(missing, 1):
            try:
                run = entry.run(suite, seed)
            except UserError as error:  # the other suites are run all the same
                failed.append(str(error))
                say(f"[{number}/{len(missing)}] failed: {error}")
                continue
            submission = scored(replace(submission, runs=[*submission.runs, run]))
            submission.save(out)
            shown = ", ".join(f"{row.measures[suite.headline]:.2f}" for row in run.rows)
            say(f"[{number}/{len(missing)}] {suite.name}, seed {seed}: {suite.headline} {shown} ({run.seconds:.0f} s)")
            advance()
    if failed:
        raise UserError(f"benchmark: {len(failed)} of {len(missing)} runs failed: {failed[0]}")
    return submission


def scored(submission: Submission) -> Submission:
    """With the scores of the suites that are complete."""
    found = {}
    for name in submission.suites:
        runs = [run for seed in submission.seeds if (run := submission.run(name, seed)) is not None]
        if len(runs) == len(submission.seeds):
            found[name] = score(load_suite(name), [run.rows for run in runs])
    return replace(submission, scores=found)


@contextmanager
def temporary(entry: Entry) -> Iterator[Entry]:
    """The same in a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        yield replace(entry, work=Path(folder))


def missing_of(suite: BenchmarkSuite, root: Path | None, method: str = "") -> str:
    """Why a suite cannot be run here, by a method if one is named, in words; empty if it can be."""
    if suite.recordings and root is None:
        return f"suite {suite.name}: needs your own copy of the recordings (--root FOLDER)"
    try:
        domain = suite.loaded()
        if method:
            with about(f"suite {suite.name}"):
                load_method(method).expect_domain(domain)
    except UserError as error:
        return str(error)
    return ""


def references_of(runs: Mapping[str, Sequence[Run]]) -> dict[str, dict[str, Sequence[Sequence[Row]]]]:
    """Rows of the reference lines of each seed, by suite and name, where all seeds have them."""
    found: dict[str, dict[str, Sequence[Sequence[Row]]]] = {}
    for suite, some in runs.items():
        names = set.intersection(*({*run.references} for run in some)) if some else set()
        found[suite] = {name: [run.references[name] for run in some] for name in sorted(names)}
    return found
