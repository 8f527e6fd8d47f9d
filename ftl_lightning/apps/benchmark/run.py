"""Run a method through suites: pretraining, learning and evaluation by the cells of ablations."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.apps.ablation.run import attempt
from ftl_lightning.apps.benchmark.submission import GIVEN, PRETRAINED, Row, Run, Submission, scored
from ftl_lightning.apps.benchmark.suite import REQUIRED, TRAINING, BenchmarkSuite, load_suite
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.results import METHOD, REFERENCE
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import UserError, about, require, short
from ftl_lightning.services.progress import bar
from ftl_lightning.services.shipped import pretrained_folder, shipped
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.text import say
from ftl_lightning.training.inversion_module import adaptation_of
from ftl_lightning.training.method import Method, class_path, load_method
from ftl_lightning.training.model_config import CONFIG

if TYPE_CHECKING:
    import pandas as pd

SHIPPED = "shipped"  # value of ``model`` for the models that the method's configurations name
CONFIGURATIONS = Path(__file__).parent / "configurations"  # configurations of the package's methods for the families


@dataclass(frozen=True)
class Candidate:
    """Method, by its registered name, with its models and configurations.

    Attributes:
        model: folder of the pretrained models, with placeholders ``{suite}`` and ``{seed}``; :data:`SHIPPED`; or empty to pretrain.
        configurations: folder with ``SUITE.yaml`` for each suite, or ``suites.yaml``; empty for those of the method's package.
        root, work: folders of the user's recordings (``None`` for none), and for models and logs.
    """

    method: str
    model: str
    configurations: str
    root: Path | None
    work: Path

    @property
    def declared(self) -> Method:
        """The method's declaration."""
        return load_method(self.method)

    def configuration(self, suite: BenchmarkSuite) -> Path:
        """The file that configures a suite; written if the method has none. Raise UserError for a folder without such a file."""
        folder = self.configurations or self.declared.configurations
        places = [Path(folder) / f"{suite.name}.yaml", Path(folder) / "suites.yaml"] if folder else []
        places += [] if self.configurations else [CONFIGURATIONS / f"{self.method}.yaml"]
        if (file := next((path for place in places if (path := shipped(place)).is_file()), None)) is not None:
            return file
        expected = f"{suite.name}.yaml or suites.yaml in {short(folder, 80)}"
        require(not self.configurations, "configurations", expected, "neither")
        return self._written(suite)

    def configurations_of(self, suite: BenchmarkSuite) -> tuple[str, ...]:
        """The suite's configuration files, in order of merging. Raise UserError if none names the method's adaptation class."""
        path, added = self.configuration(suite), shipped(f"conf/method/{self.method}.yaml")
        expected = adaptation_of(self.declared).__name__
        for files in ((path,), (path, added)):
            classes = [str((load(file, "invert").get("model") or {}).get("class_path", "")) for file in files if file.is_file()]
            if classes[-1].rpartition(".")[2] == expected:
                return tuple(map(str, files))
        raise UserError(f"{path}: invert: expected model.class_path {expected}, as {self.method} learns, found another")

    def _written(self, suite: BenchmarkSuite) -> Path:
        """Write a configuration with the defaults of the method's classes."""
        method, path = self.declared, self.work / f"{suite.name}-configuration.yaml"
        content: dict[str, Any] = {
            "defaults": ["conf/verb.yaml"],
            "data": {"init_args": {"domain": suite.domain_reference}},
            "fit": {
                "model": {"class_path": class_path(method.pretraining())} if method.pretraining else {},
                "data": {"class_path": "ftl_lightning.training.data.PretrainingData"},
            },
            "invert": {"model": {"class_path": class_path(adaptation_of(method))}},
        }
        write_text(path, yaml.safe_dump(content))
        return path

    def trained(self, suite: BenchmarkSuite, seed: int) -> Path:
        """Folder of the model of a suite and a seed. Raise UserError if a given model is missing."""
        if not self.model:
            return self.work / "models" / f"{suite.name}-seed{seed}"
        if self.model == SHIPPED:
            options = (load(self.configuration(suite), "invert").get("model") or {}).get("init_args") or {}
            place = str(options.get("pretrained") or "")
        else:
            place = self.model.replace("{suite}", suite.name).replace("{seed}", str(seed))
        there = place and (pretrained_folder(place) / CONFIG).is_file()
        require(there, "model", f"a pretrained model for suite {suite.name}", f"none in {short(place, 80) or SHIPPED!r}")
        return pretrained_folder(place)

    def cells(self, suite: BenchmarkSuite, seed: int) -> tuple[Cell | None, Cell]:
        """The cells ``fit``, unless a model is given, and ``invert``; frozen values of the suite override the method's."""
        method = self.declared
        expected = f"models of kind {method.kind}, which {method.name} does not pretrain"
        require(method.pretraining or self.model, "model", expected, "none")
        files, model = self.configurations_of(suite), self.trained(suite, seed)
        name = f"{suite.name}, seed {seed}"
        shared = {
            "seed_everything": str(seed),
            "data.domain": suite.domain_reference,
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
        # Families have no domain table of embeddings.
        fit |= {} if load_domain(suite.domain_reference).concepts.table else {"data.encoder": "hashing"}
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
        """Run a suite with a seed. Raise UserError if the data differ from the frozen data, or the method cannot be run."""
        parts = REQUIRED if self.model else (TRAINING, *REQUIRED)
        if not suite.check_data(seed, self.root, parts):
            say(f"note: suite {suite.name}, seed {seed}: this processor rounds the data in another way", error=True)
        fit, invert = self.cells(suite, seed)
        start = time.monotonic()
        if fit is not None and (error := attempt(fit, set()).error):
            raise UserError(f"suite {suite.name}, seed {seed}, pretraining: {error}")
        fitted = time.monotonic()
        outcome = attempt(invert, set())
        if (rows := outcome.rows) is None:
            raise UserError(f"suite {suite.name}, seed {seed}: {outcome.error or 'expected rows, found none'}")
        method_rows = rows[rows["role"] == METHOD]
        measured = _rows(suite, method_rows)
        tasks = {(task.setting, task.concept) for task in suite.test}
        return Run(
            suite=suite.name,
            seed=seed,
            model=str(method_rows["model_hash"].iloc[0]),
            origin=GIVEN if self.model else PRETRAINED,
            data={part: known.hash for part, known in suite.data.get(str(seed), {}).items() if part in parts},
            configuration=str(method_rows["config_hash"].iloc[0]),
            pretraining_seconds=0.0 if fit is None else round(fitted - start, 1),
            seconds=round(time.monotonic() - fitted, 1),
            rows=measured,
            references={
                str(name): _rows(suite, group, suite.headline)
                for name, group in rows[rows["role"] == REFERENCE].groupby("method", sort=True)
                if tasks <= {*group.loc[group["metric"] == suite.headline, ["setting", "task"]].itertuples(index=False, name=None)}
            },
        )


def _rows(suite: BenchmarkSuite, table: "pd.DataFrame", *needed: str) -> list[Row]:
    """Rows of the test's concepts. Raise UserError for a missing measure of those ``needed``, by default all of the suite."""
    rows = []
    for task in suite.test:
        group = table[(table["setting"] == task.setting) & (table["task"] == task.concept)]
        values = {
            str(name): float(value) for name, value in zip(group["metric"], group["value"], strict=True) if name in suite.measures
        }
        if missing := [name for name in (needed or suite.measures) if name not in values]:
            raise UserError(f"suite {suite.name}, concept {task.concept!r}: expected the measure {missing[0]}, found none")
        measures = {name: values[name] for name in suite.measures if name in values}
        rows.append(Row(setting=task.setting, concept=task.concept, n=int(group["n"].iloc[0]), measures=measures))
    return rows


def run_benchmark(candidate: Candidate, begun: Submission, names: Sequence[str], out: Path) -> Submission:
    """Run missing suites and seeds, and write the file after each. Raise UserError at the end, with the first failed suite and
    seed.
    """
    submission = begun
    failed: list[str] = []
    missing = [(suite, seed) for suite in map(load_suite, names) for seed in begun.seeds if begun.run(suite.name, seed) is None]
    with bar("cells", len(missing), lines=False) as advance:
        for number, (suite, seed) in enumerate(missing, 1):
            try:
                run = candidate.run(suite, seed)
            except UserError as error:  # other suites still run
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


def missing_of(suite: BenchmarkSuite, root: Path | None, method: str = "") -> str:
    """Why a suite cannot be run here (by a method, if named); empty if it can."""
    if suite.recordings and root is None:
        return f"suite {suite.name}: needs your own copy of the recordings (--root FOLDER)"
    try:
        domain = suite.loaded()
        if method:
            with about(f"suite {suite.name}"):
                load_method(method).check_domain(domain)
    except UserError as error:
        return str(error)
    return ""
