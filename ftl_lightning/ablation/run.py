"""Running a plan, here or on a cluster, cell by cell in the same way."""

import os
import tempfile
import time
import traceback
from argparse import ArgumentError
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ftl_lightning import log_folder, trust
from ftl_lightning.ablation.check import check
from ftl_lightning.ablation.plan import Cell, Stage, part
from ftl_lightning.configuration import load
from ftl_lightning.errors import UserError
from ftl_lightning.printing import say
from ftl_lightning.progress import bar

if TYPE_CHECKING:
    import pandas as pd

    from ftl_lightning.lightning_cli import CommandLine


@dataclass(frozen=True)
class Outcome:
    """The end of a cell: rows of results (``None`` for none), a note, and the error, if it failed."""

    rows: "pd.DataFrame | None" = None
    note: str = ""
    error: str = ""


def run_ablation(
    stages: Sequence[Stage],
    seeds: Sequence[int],
    results: str,
    shard: str = "1/1",
    executor: Literal["local", "ray"] = "local",
    root: str = "",
) -> None:
    """Run all cells of all seeds, stage after stage. A cell that fails does not stop the others; failures are listed at the end.

    Args:
        stages: in order; a later one may read what an earlier one wrote.
        seeds: each stage runs once a seed.
        results: results file.
        shard: ``'3/8'`` for the third of eight parts of the plan, for as many machines or processes.
        executor: ``'local'``, one cell after another in this process; ``'ray'``, as many side by side as a cluster has room for,
            the one that ``RAY_ADDRESS`` names, whose machines share this folder, or one of this machine's processors.
        root: ``data.root`` of every cell; empty for what their configurations say.

    Raises:
        UserError: before anything runs, for cells that cannot; at the end, naming the cells that failed.
    """
    from ftl_lightning.evaluation.results import add_rows

    if not seeds:
        raise UserError("seeds: expected one or more, found none")
    shared = {"data.root": root} if root else {}
    every = [replace(stage, options={**shared, **stage.options}) for stage in stages]
    plan = [[cell for seed in seeds for cell in stage.cells(seed)] for stage in every]
    plan = part(plan, shard)
    check([cell for cells in plan for cell in cells])
    total, number, failed = sum(map(len, plan)), 0, []
    start = time.monotonic()
    with _executor(executor) as run, bar("cells", total, lines=False) as advance:
        for cells in plan:
            for cell, outcome in run(cells, _known(results)):
                number += 1
                left = (time.monotonic() - start) / number * (total - number) / 60
                told = f"failed: {outcome.error}\n  {cell.command}" if outcome.error else outcome.note
                say(f"[{number}/{total}, about {left:.0f} min left] {cell}: {told}")
                advance()
                if outcome.rows is not None:
                    add_rows(results, outcome.rows)
                if outcome.error:
                    failed.append(f"{cell}: {outcome.error}")
    if failed:
        raise UserError(f"ablation: {len(failed)} of {total} cells failed: " + "; ".join(failed))


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
        waiting = {remote.remote(str(Path.cwd()), cell, known, trust.vouched()): cell for cell in cells}
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
    """Run a cell, unless its results are known; an error of any kind becomes its outcome."""
    if cell.done and Path(cell.done).is_file():
        return Outcome(note="done before")
    from ftl_lightning.evaluation.results import read_rows
    from ftl_lightning.lightning_cli import build  # seconds of import that parsing the plan does not need

    say(cell)
    with tempfile.TemporaryDirectory() as folder, log_folder.run():
        path = Path(folder) / "results.csv"
        try:
            line = build(cell.verb, [*cell.arguments, *_log(cell), f"--evaluation.results={path}"])
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


def _log(cell: Cell) -> list[str]:
    """The option that names the log folder of a cell after it, unless the plan names it."""
    option = "trainer.logger.init_args.version"
    logger = load(cell.config, cell.verb).get("trainer", {}).get("logger")
    named = cell.options.get(option, "null") != "null" or "trainer.logger" in cell.options or not isinstance(logger, Mapping)
    return [] if named else [f"--{option}={cell.folder}"]


def _attempt_in(folder: str, cell: Cell, known: set[str], vouched: frozenset[str]) -> Outcome:
    """Run a cell in the folder that all machines of a cluster share, with the modules that a person vouches for."""
    os.chdir(folder)
    with trust.vouching(vouched):
        return attempt(cell, known)


def _hash(line: "CommandLine") -> str:
    from ftl_lightning.evaluation.evaluator import Evaluator

    callbacks = line.trainer.callbacks  # type: ignore[attr-defined]
    evaluator = next(callback for callback in callbacks if isinstance(callback, Evaluator))
    return evaluator.config_hash(line.model, line.datamodule, line.trainer)


def _known(results: str) -> set[str]:
    from ftl_lightning.evaluation.results import read_rows

    return set(read_rows(results)["config_hash"]) if Path(results).is_file() else set()
