"""Ablations: grids of configurations, each run through the same verbs as by hand, skipping what the results hold already."""

import importlib
import itertools
import json
import os
import re
import tempfile
import time
import traceback
from argparse import ArgumentError
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ftl_lightning.errors import UserError

if TYPE_CHECKING:
    import pandas as pd

    from ftl_lightning.learning.adaptation import Adaptation
    from ftl_lightning.lightning_cli import CommandLine


@dataclass(frozen=True)
class Stage:
    """One verb with a grid of options. ``{seed}`` in any value stands for the seed, ``{name}`` for a value of ``each``.

    Attributes:
        verb: ``fit`` or ``invert``.
        config: its configuration file.
        each: names with a list of texts each, which stand in the other values; the stage runs for their product.
        options: that all cells share, by their names on the command line.
        grid: options with a list of values each; the cells are their product.
        done: a file whose presence means that the stage need not run, such as a pretrained model; empty for never. It is the
            file alone that counts: remove it after a change of the stage's configuration.
    """

    verb: Literal["fit", "invert"]
    config: str
    each: Mapping[str, list[str]] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, list[Any]] = field(default_factory=dict)
    done: str = ""

    def cells(self, seed: int) -> Iterator["Cell"]:
        """Every cell for one seed."""
        for texts in itertools.product(*self.each.values()):
            names = {"seed": str(seed), **dict(zip(self.each, texts, strict=True))}
            for values in itertools.product(*self.grid.values()):
                options = {**self.options, **dict(zip(self.grid, values, strict=True))}
                told = {key: _text(value, names) for key, value in options.items()}
                yield Cell(self.verb, _text(self.config, names), told, _text(self.done, names))


@dataclass(frozen=True)
class Cell:
    """One run: a verb, its configuration file, options, and the file that says that it need not run."""

    verb: Literal["fit", "invert"]
    config: str
    options: Mapping[str, str]
    done: str

    @property
    def arguments(self) -> list[str]:
        """As on the command line, without the verb."""
        return [f"--config={self.config}", *(f"--{key}={value}" for key, value in self.options.items())]

    def __str__(self) -> str:
        return " ".join((self.verb, *self.arguments))


def _text(value: Any, names: Mapping[str, str]) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    for name, standing in names.items():
        text = text.replace(f"{{{name}}}", standing)
    return text


@dataclass(frozen=True)
class Outcome:
    """What became of a cell: rows of results (``None`` for none), what there is to say, and the mistake, if it failed."""

    rows: "pd.DataFrame | None" = None
    note: str = ""
    error: str = ""


def run_ablation(
    stages: Sequence[Stage], seeds: Sequence[int], results: str, shard: str = "1/1", executor: Literal["local", "ray"] = "local"
) -> None:
    """Run all cells of all seeds, stage after stage; a cell that fails is told at the end and does not stop the others.

    Args:
        stages: in order; a later one may read what an earlier one wrote.
        seeds: each stage runs once a seed.
        results: results file.
        shard: ``'3/8'`` for the third of eight parts of the plan, for as many machines or processes.
        executor: ``'local'``, one cell after another in this process; ``'ray'``, as many side by side as a cluster has room for,
            the one that ``RAY_ADDRESS`` names, whose machines share this folder, or one of this machine's processors.

    Raises:
        UserError: before anything runs, for cells that cannot; at the end, naming the cells that failed.
    """
    from ftl_lightning.evaluation.results import add_rows

    plan = [[cell for seed in seeds for cell in stage.cells(seed)] for stage in stages]
    plan = _part(plan, shard)
    check([cell for cells in plan for cell in cells])
    total, number, failed = sum(map(len, plan)), 0, []
    start = time.monotonic()
    with _executor(executor) as run:
        for cells in plan:
            for cell, outcome in run(cells, _known(results)):
                number += 1
                left = (time.monotonic() - start) / number * (total - number) / 60
                told = f"failed: {outcome.error}" if outcome.error else outcome.note
                print(f"[{number}/{total}, about {left:.0f} min left] {cell}: {told}", flush=True)
                if outcome.rows is not None:
                    add_rows(results, outcome.rows)
                if outcome.error:
                    failed.append(f"{cell}: {outcome.error}")
    if failed:
        raise UserError(f"ablation: {len(failed)} of {total} cells failed: " + "; ".join(failed))


def _part(plan: Sequence[Sequence[Cell]], shard: str) -> list[list[Cell]]:
    """Of every stage the cells of a shard: each so-manieth."""
    found = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", shard)
    if not found or int(found[1]) > int(found[2]):
        raise UserError(f"shard: expected 'number/shards' such as 3/8, found {shard!r}")
    number, shards = int(found[1]), int(found[2])
    position = itertools.count()
    return [[cell for cell in cells if next(position) % shards == number - 1] for cells in plan]


def check(cells: Sequence[Cell]) -> None:
    """Refuse cells that cannot run, before any does: for their files, keys, encoders and, of ``invert``, domains, suites and
    pretrained models.

    Raises:
        UserError: naming them.
    """
    made = {cell.options["model.output"] for cell in cells if cell.verb == "fit" and "model.output" in cell.options}
    mistakes = {}
    for cell in cells:
        try:
            _check(cell, made)
        except (UserError, ArgumentError) as error:
            mistakes[str(cell)] = " ".join(str(error).split())
    if mistakes:
        told = dict.fromkeys(mistakes.values())
        raise UserError(f"ablation: {len(mistakes)} of {len(cells)} cells cannot run, none was started: {'; '.join(told)}")


def _check(cell: Cell, made: set[str]) -> None:
    from ftl_lightning.concepts.encoder import load_encoder
    from ftl_lightning.domains.domain import load_domain
    from ftl_lightning.learning.concept_model import read_config
    from ftl_lightning.lightning_cli import parse

    if not Path(cell.config).is_file():
        folder = next(parent for parent in Path(cell.config).parents if parent.is_dir())
        there = ", ".join(sorted(entry.name for entry in folder.iterdir()))
        raise UserError(f"config: {cell.config}: expected a configuration file, found nothing; {folder} holds {there}")
    config = parse(cell.arguments)
    model, data = config["model"]["init_args"], config["data"]["init_args"]
    if cell.verb == "fit":
        load_encoder(data["encoder"], Path(), data["revision"])
        return
    if "pretrained" not in model or "domain" not in data:
        raise UserError(
            f"verb: {cell.config}: expected the configuration of an adaptation (invert), found that of a pretraining (fit)"
        )
    domain = load_domain(data["domain"])
    for key, names in (("evaluation.suites", config["evaluation"]["suites"]), ("data.suite", [data["suite"]])):
        if unknown := set(names) - set(domain.suites):
            expected = ", ".join(domain.suites)
            raise UserError(f"{key}: expected some of {expected} (domain {domain.name}), found {', '.join(sorted(unknown))}")
    if model["pretrained"] not in made:
        kinds = _class(config["model"]["class_path"]).kinds
        found = read_config(model["pretrained"])
        if found["domain"] != domain.name or found["kind"] not in kinds:
            raise UserError(
                f"model.pretrained: expected a model of {domain.name} ({' or '.join(kinds)}), found one of {found['domain']} "
                f"({found['kind']}) in {model['pretrained']}"
            )
    if "encoder" in model:
        load_encoder(model["encoder"], domain.table, model["revision"])


def _class(path: str) -> type["Adaptation"]:
    module, _, name = path.rpartition(".")
    found: type[Adaptation] = getattr(importlib.import_module(module), name)
    return found


Run = Callable[[Sequence[Cell], set[str]], Iterator[tuple[Cell, Outcome]]]
"""Runs cells, given the configuration hashes that need not be run; yields each with its outcome as it ends."""


@contextmanager
def _executor(name: str) -> Iterator[Run]:
    if name == "local":
        yield lambda cells, known: ((cell, attempt(cell, known)) for cell in cells)
        return
    try:
        import ray
    except ImportError as error:
        raise UserError("executor: 'ray' needs its extra; run: pip install 'ftl-lightning[cluster]'") from error

    def run(cells: Sequence[Cell], known: set[str]) -> Iterator[tuple[Cell, Outcome]]:
        remote = ray.remote(num_cpus=1, max_retries=0)(_attempt_in)
        waiting = {remote.remote(str(Path.cwd()), cell, known): cell for cell in cells}
        while waiting:
            (ready, *_), _ = ray.wait(list(waiting), num_returns=1)
            try:
                outcome = ray.get(ready)
            except ray.exceptions.RayError as error:  # the worker died
                outcome = Outcome(error=str(error).splitlines()[0])
            yield waiting.pop(ready), outcome

    started = not ray.is_initialized()  # else it runs on the cluster that the caller is connected to
    if started:
        os.environ.setdefault("RAY_worker_niceness", "0")  # by default workers stand back for everything else
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(log_to_driver=False, include_dashboard=False)
    try:
        yield run
    finally:
        if started:
            ray.shutdown()


def attempt(cell: Cell, known: set[str]) -> Outcome:
    """Run a cell, unless what it would measure is known; whatever goes wrong is its outcome."""
    if cell.done and Path(cell.done).is_file():
        return Outcome(note="done before")
    from ftl_lightning.evaluation.results import read_rows
    from ftl_lightning.lightning_cli import build  # seconds of import that parsing the plan does not need

    print(cell, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.csv"
        try:
            line = build([*cell.arguments, f"--evaluation.results={path}"])
            if cell.verb == "invert" and _hash(line) in known:
                return Outcome(note="in the results already")
            getattr(line.trainer, cell.verb)(line.model, datamodule=line.datamodule)
        except (UserError, ArgumentError) as error:
            return Outcome(error=str(error))
        except Exception as error:  # a fault of ours or of the machine must not cost the other cells
            traceback.print_exc()
            return Outcome(error=repr(error))
        rows = read_rows(path) if path.is_file() else None
    return Outcome(rows, note="done" if rows is None else f"{len(rows)} rows")


def _attempt_in(folder: str, cell: Cell, known: set[str]) -> Outcome:
    """Run a cell in a folder, which all machines of a cluster share."""
    os.chdir(folder)
    return attempt(cell, known)


def _hash(line: "CommandLine") -> str:
    from ftl_lightning.evaluation.evaluator import Evaluator

    callbacks = line.trainer.callbacks  # type: ignore[attr-defined]
    evaluator = next(callback for callback in callbacks if isinstance(callback, Evaluator))
    return evaluator.config_hash(line.model, line.datamodule)


def _known(results: str) -> set[str]:
    from ftl_lightning.evaluation.results import read_rows

    return set(read_rows(results)["config_hash"]) if Path(results).is_file() else set()
