"""Run a plan cell by cell, here or on a cluster."""

import socket
import tempfile
import time
import traceback
from argparse import ArgumentError
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ftl_lightning.apps.ablation.check import check
from ftl_lightning.apps.ablation.cluster import cluster
from ftl_lightning.apps.ablation.estimate import estimate
from ftl_lightning.apps.ablation.outcome import Outcome, Run, State, Tell
from ftl_lightning.apps.ablation.plan import Cell, Stage, part
from ftl_lightning.apps.ablation.record import by_node, counted, read_record, table, tell
from ftl_lightning.services import log_folder
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import bar
from ftl_lightning.services.text import say

if TYPE_CHECKING:
    from ftl_lightning.apps.lightning_cli import CommandLine


def run_ablation(
    stages: Sequence[Stage],
    seeds: Sequence[int],
    results: str,
    shard: str = "1/1",
    executor: Literal["local", "ray"] = "local",
    root: str = "",
    address: str = "",
    only: Sequence[int] = (),
) -> None:
    """Run all cells of all seeds, stage after stage. A failed cell does not stop the others; failures are listed at the end.

    The state of each cell is recorded beside the results, see :mod:`~ftl_lightning.apps.ablation.record`.

    Args:
        stages: stages in order; a stage may read files of earlier stages.
        seeds: each stage runs once per seed.
        results: results file.
        shard: ``'3/8'`` for the third of eight parts of the plan, run by different machines or processes.
        executor: ``'local'`` runs cells one by one in this process; ``'ray'`` runs cells in parallel on a cluster whose machines
            share this folder. A cell that loses its process or machine runs once more.
        root: ``data.root`` of every cell; empty for the value of the configurations.
        address: address of the Ray cluster, see :func:`~ftl_lightning.apps.ablation.cluster.cluster`.
        only: numbers of the stages to run, from 1; empty for all.

    Raises:
        UserError: before the first run, for cells that cannot run; at the end, naming failed cells.
    """
    from ftl_lightning.evaluation.results import add_rows

    plan = part(list(planned(stages, seeds, root, only).values()), shard)
    every = [cell for cells in plan for cell in cells]
    check(every)
    read_record(results)  # fails early if damaged
    total, number, failed = len(every), 0, []
    start = time.monotonic()
    noted = partial(tell, results)
    states: dict[str, State] = {cell.name: "queued" for cell in every}

    def record_state(cell: Cell, state: State, node: str, note: str) -> None:
        noted([cell], state, node, note)
        states[cell.name] = state
        advance(0, counted(list(states.values())))
        if state == "again":
            say(f"{cell}: runs again, lost on {node or 'its machine'}: {note}")

    with (
        _executor(executor, address, [cell for cell in every if not _is_made(cell)]) as run,
        bar("cells", total, lines=False) as advance,
    ):
        noted(every, "queued")
        for cells in plan:
            for cell, outcome in run(cells, known_hashes(results), record_state):
                number += 1
                minutes = (time.monotonic() - start) / number * (total - number) / 60
                note = f"failed: {outcome.error}\n  {cell.command}" if outcome.error else outcome.note
                say(f"[{number}/{total}, about {minutes:.0f} min left] {cell}: {note}")
                if outcome.rows is not None:
                    add_rows(results, outcome.rows)
                if outcome.error:
                    failed.append(f"{cell}: {outcome.error}")
                states[cell.name] = "failed" if outcome.error else "done"
                noted([cell], states[cell.name], outcome.node, outcome.error or outcome.note, outcome.seconds)
                advance(1, counted(list(states.values())))
    if failed or executor == "ray":
        show_cells(results, every)
    if failed:
        raise UserError(f"ablation: {len(failed)} of {total} cells failed: " + "; ".join(failed))


def planned(stages: Sequence[Stage], seeds: Sequence[int], root: str = "", only: Sequence[int] = ()) -> dict[int, list[Cell]]:
    """The cells of each stage by its number, for all seeds.

    Args:
        stages: stages in order.
        seeds: each stage runs once per seed.
        root: ``data.root`` of every cell; empty for the value of the configurations.
        only: numbers of the stages, from 1; empty for all.

    Raises:
        UserError: for no seeds, or an unknown number of a stage.
    """
    if not seeds:
        raise UserError("seeds: expected one or more, found none")
    if wrong := [number for number in only if not 1 <= number <= len(stages)]:
        raise UserError(f"only: expected numbers of stages from 1 to {len(stages)}, found {wrong[0]}")
    shared = {"data.root": root} if root else {}
    every = {number: replace(stage, options={**shared, **stage.options}) for number, stage in enumerate(stages, 1)}
    chosen = {number: stage for number, stage in every.items() if not only or number in only}
    return {number: [cell for seed in seeds for cell in stage.cells(seed)] for number, stage in chosen.items()}


def show_estimate(plan: Sequence[Sequence[Cell]], results: str, workers: int = 0) -> None:
    """Print the number of cells to run and the estimated hours, as far as known; nothing runs.

    Args:
        plan: the cells of each stage.
        results: results file.
        workers: number of parallel cells; 0 for several numbers.

    Raises:
        UserError: for cells that cannot run.
    """
    every = [cell for cells in plan for cell in cells]
    check(every)
    known = known_hashes(results)
    with bar("cells looked at", len(every), lines=False) as advance:

        def needed(cell: Cell) -> bool:
            advance()
            return not _is_done(cell, known)

        left = [[cell for cell in cells if needed(cell)] for cells in plan]
    say("\n".join(estimate(left, read_record(results), len(every), workers)))


def _is_made(cell: Cell) -> bool:
    """Whether the ``done`` file of a cell exists."""
    return bool(cell.done) and Path(cell.done).is_file()


def _is_done(cell: Cell, known: set[str]) -> bool:
    """Whether a cell need not run; a cell whose pretrained model is missing must run."""
    if _is_made(cell):
        return True
    if cell.verb == "fit" or not known:
        return False
    from ftl_lightning.apps.lightning_cli import build

    with log_folder.run(), suppress(UserError, ArgumentError):
        return _hash(build(cell.verb, [*cell.arguments, *_log(cell)])) in known
    return False


def show_cells(results: str, cells: Sequence[Cell]) -> None:
    """Print the table of cells, and their states by machine."""
    from ftl_lightning.evaluation.summary import show

    entries = read_record(results)
    show(table(entries, cells))
    say("\n".join(by_node(entries, cells)))


@contextmanager
def _executor(name: str, address: str, cells: Sequence[Cell]) -> Iterator[Run]:
    if name == "local":
        if address:
            raise UserError(f"address: expected none without --executor ray, found {address!r}")
        yield _one_after_another
        return
    with cluster(address, attempt, cells) as run:
        yield run


def _one_after_another(cells: Sequence[Cell], known: set[str], tell: Tell) -> Iterator[tuple[Cell, Outcome]]:
    for cell in cells:
        tell(cell, "running", node := socket.gethostname(), "")
        yield cell, replace(attempt(cell, known), node=node)


def attempt(cell: Cell, known: set[str], again: bool = False) -> Outcome:
    """Run a cell, unless its results are known; any error becomes its outcome.

    Args:
        cell: the cell.
        known: configuration hashes that need not run.
        again: whether the cell was lost before; pretraining then resumes from its last checkpoint, if any.
    """
    if _is_made(cell):
        return Outcome(note="done before")
    from ftl_lightning.apps.lightning_cli import build  # slow import, not needed to parse the plan
    from ftl_lightning.evaluation.results import read_rows
    from ftl_lightning.training.checkpoint import last_checkpoint

    say(cell)
    with tempfile.TemporaryDirectory() as folder, log_folder.run():
        path = Path(folder) / "results.csv"
        try:
            line = build(cell.verb, [*cell.arguments, *_log(cell), f"--evaluation.results={path}"])
            if cell.verb == "invert" and _hash(line) in known:
                return Outcome(note="in the results already")
            start = time.monotonic()
            more = {"ckpt_path": last_checkpoint(line.trainer)} if again and cell.verb == "fit" else {}
            getattr(line.trainer, cell.verb)(line.model, datamodule=line.datamodule, **more)
        except (UserError, ArgumentError) as error:
            return Outcome(error=str(error))
        except Exception as error:  # a bug or machine error must not stop other cells
            traceback.print_exc()
            return Outcome(error=repr(error))
        rows = read_rows(path) if path.is_file() else None
        seconds = time.monotonic() - start
    return Outcome(rows, "done" if rows is None else f"{len(rows)} rows", seconds=seconds)


def _log(cell: Cell) -> list[str]:
    """The option that names the log folder after the cell, unless the plan sets it."""
    option = "trainer.logger.init_args.version"
    trainers = [load(config, cell.verb).get("trainer", {}) for config in cell.configs]
    logger = next((trainer["logger"] for trainer in reversed(trainers) if "logger" in trainer), None)
    named = cell.options.get(option, "null") != "null" or "trainer.logger" in cell.options or not isinstance(logger, Mapping)
    return [] if named else [f"--{option}={cell.folder}"]


def _hash(line: "CommandLine") -> str:
    from ftl_lightning.evaluation.evaluator import Evaluator

    callbacks = line.trainer.callbacks  # type: ignore[attr-defined]
    evaluator = next(callback for callback in callbacks if isinstance(callback, Evaluator))
    return evaluator.config_hash(line.model, line.datamodule, line.trainer)


def known_hashes(results: str) -> set[str]:
    """The configuration hashes in a results file; empty if there is no file."""
    from ftl_lightning.evaluation.results import read_rows

    return set(read_rows(results)["config_hash"]) if Path(results).is_file() else set()
