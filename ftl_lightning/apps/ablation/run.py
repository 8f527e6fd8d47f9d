"""Check a plan, and run it cell by cell, here or on a cluster."""

import importlib
import itertools
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

from ftl_lightning.apps.ablation.cluster import cluster
from ftl_lightning.apps.ablation.plan import Cell, Stage
from ftl_lightning.apps.ablation.record import (
    CellRecord,
    Outcome,
    Run,
    State,
    Tell,
    by_node,
    count_states,
    estimate,
    read_record,
    table,
    tell,
)
from ftl_lightning.services import log_folder
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.progress import bar
from ftl_lightning.services.shipped import pretrained_folder
from ftl_lightning.services.tensor_file import content_hash
from ftl_lightning.services.text import say
from ftl_lightning.services.trust import check_module

if TYPE_CHECKING:
    from ftl_lightning.apps.lightning_cli import CommandLine
    from ftl_lightning.training.adaptation import Adaptation


MOST_SEEDS = 1000
"""Maximum number of seeds of an ablation."""
IN_RESULTS = "in the results already"
"""Note of a cell that need not be run."""


def check(cells: Sequence[Cell]) -> None:
    """Check files, keys and encoder of each cell and, for ``invert``, domain, suites and model, before any cell starts. Raise
    UserError with all mistakes.
    """
    outputs = {cell.options["model.output"] for cell in cells if cell.verb == "fit" and "model.output" in cell.options}
    mistakes = {}
    with bar("cells to check", len(cells), lines=False) as advance:
        for cell in cells:
            try:
                _check(cell, outputs)
            except (UserError, ArgumentError) as error:
                mistakes[cell.command] = " ".join(str(error).split())
            advance()
    if mistakes:
        messages = dict.fromkeys(mistakes.values())
        raise UserError(f"ablation: {len(mistakes)} of {len(cells)} cells cannot run, none was started: {'; '.join(messages)}")


def _check(cell: Cell, made: set[str]) -> None:
    from ftl_lightning.apps.lightning_cli import parse
    from ftl_lightning.domains.registry import load_domain
    from ftl_lightning.networks.text_encoder import load_encoder
    from ftl_lightning.training.model_config import read_config
    from ftl_lightning.training.model_folder import kinds_for, model_class

    config = parse(cell.verb, cell.arguments)
    model, data = config["model"]["init_args"], config["data"]["init_args"]
    if cell.verb == "fit":
        load_encoder(data["encoder"], Path(), data["revision"])
        return
    adaptation = "pretrained" in model and "domain" in data
    expected = "the configuration of an adaptation (invert)"
    require(adaptation, f"verb: {', '.join(cell.configs)}", expected, "that of a pretraining (fit)")
    if ":" in data["domain"]:
        check_module(data["domain"], "data.domain")
    domain = load_domain(data["domain"])
    for key, names in (("evaluation.suites", config["evaluation"]["suites"] or ()), ("data.suite", [data["suite"]])):
        unknown = sorted(set(names) - set(domain.concepts.suites))
        require(not unknown, key, f"some of {', '.join(domain.concepts.suites)} (domain {domain.name})", ", ".join(unknown))
    if model["pretrained"] not in made:
        module, _, name = config["model"]["class_path"].rpartition(".")
        adaptation_class: type[Adaptation] = getattr(importlib.import_module(module), name)
        trained = read_config(pretrained_folder(model["pretrained"]))
        network = model_class(trained["kind"])
        fitting = trained["domain"] == domain.name and network is not None and adaptation_class.adapts(network)
        expected = f"a model of {domain.name} ({' or '.join(kinds_for(adaptation_class.adapts))})"
        actual = f"one of {trained['domain']} ({trained['kind']}) in {model['pretrained']}"
        require(fitting, "model.pretrained", expected, actual)
    if "encoder" in model:
        load_encoder(model["encoder"], domain.concepts.table, model["revision"])


def run_ablation(
    plan: Sequence[Sequence[Cell]], results: str, executor: Literal["local", "ray"] = "local", address: str = ""
) -> None:
    """Run all cells, stage after stage, and record their states beside the results. A failed cell does not stop the others. Raise
    UserError before the first run, for cells that cannot run; at the end, naming failed cells.

    Args:
        plan: cells of each stage, in order; a stage may read files of earlier stages.
        results: results file.
        executor: ``'local'`` runs cells in turn in this process; ``'ray'`` in parallel on a cluster whose machines share this
            folder. A cell that loses its process or machine runs once more.
        address: address of the Ray cluster, see :func:`~ftl_lightning.apps.ablation.cluster.cluster`.
    """
    from ftl_lightning.evaluation.results import add_rows

    all_cells = [cell for cells in plan for cell in cells]
    check(all_cells)
    known_outcomes = outcomes(plan, results)
    total, number, failed = len(all_cells), 0, []
    start = time.monotonic()
    noted = partial(tell, results)
    states: dict[str, State] = {cell.name: "queued" for cell in all_cells}

    def record_state(cell: Cell, state: State, node: str, note: str) -> None:
        noted([cell], state, Outcome(note=note, node=node))
        states[cell.name] = state
        advance(0, count_states(list(states.values())))
        if state == "again":
            say(f"{cell}: runs again, lost on {node or 'its machine'}: {note}")

    with (
        _executor(executor, address, [cell for cells in to_run(known_outcomes) for cell in cells]) as run,
        bar("cells", total, lines=False) as advance,
    ):
        noted(all_cells, "queued")
        for stage, needed in zip(known_outcomes, to_run(known_outcomes), strict=True):
            skipped = ((cell, outcome) for cell, outcome in stage if outcome is not None)
            for cell, outcome in itertools.chain(skipped, run(needed, known_hashes(results), record_state)):
                number += 1
                minutes = (time.monotonic() - start) / number * (total - number) / 60
                note = f"failed: {outcome.error}\n  {cell.command}" if outcome.error else outcome.note
                say(f"[{number}/{total}, about {minutes:.0f} min left] {cell}: {note}")
                if outcome.rows is not None:
                    add_rows(results, outcome.rows)
                if outcome.error:
                    failed.append(f"{cell}: {outcome.error}")
                states[cell.name] = "failed" if outcome.error else "done"
                if outcome.config_hash:
                    outcome = replace(outcome, settings=settings_of(cell))
                noted([cell], states[cell.name], outcome)
                advance(1, count_states(list(states.values())))
    if failed or executor == "ray":
        show_cells(results, all_cells)
    if failed:
        raise UserError(f"ablation: {len(failed)} of {total} cells failed: " + "; ".join(failed))


def planned(stages: Sequence[Stage], seeds: Sequence[int], root: str = "", only: Sequence[int] = ()) -> dict[int, list[Cell]]:
    """The cells of each stage by its number, from 1, for all seeds.

    Args:
        stages: stages in order.
        seeds: each stage runs once per seed.
        root: ``data.root`` of every cell; empty for the value of the configurations.
        only: numbers of the stages; empty for all.

    Raises:
        UserError: without seeds, or for a number that is no stage.
    """
    require(stages, "stages", "one or more", "none")
    require(seeds, "seeds", "one or more", "none")
    require(len(seeds) <= MOST_SEEDS, "seeds", f"at most {MOST_SEEDS}", str(len(seeds)))
    for number in only:
        require(1 <= number <= len(stages), "only", f"numbers of stages from 1 to {len(stages)}", number)
    shared = {"data.root": root} if root else {}
    rooted = [replace(stage, options={**shared, **stage.options}) for stage in stages]
    every = {number: [cell for seed in seeds for cell in stage.cells(seed)] for number, stage in enumerate(rooted, 1)}
    fits = {cell.options.get("model.output", ""): cell for cells in every.values() for cell in cells if cell.verb == "fit"}
    return {
        number: [
            cell if cell.verb == "fit" else replace(cell, pretraining=fits.get(cell.options.get("model.pretrained", "")))
            for cell in cells
        ]
        for number, cells in every.items()
        if not only or number in only
    }


def show_estimate(plan: Sequence[Sequence[Cell]], results: str, workers: int = 0) -> None:
    """Check the cells of each stage; print how many are to run, and the estimated hours for some workers (0: several numbers)."""
    check([cell for cells in plan for cell in cells])
    say("\n".join(estimate(to_run(outcomes(plan, results)), read_record(results), sum(map(len, plan)), workers)))


def outcomes(plan: Sequence[Sequence[Cell]], results: str) -> list[list[tuple[Cell, Outcome | None]]]:
    """The cells of each stage with the outcome of an earlier run; ``None`` if a cell must run. A pretraining whose model is missing
    must run if a cell of the plan that must run reads the model, or if no cell of the plan reads it.
    """
    known, record = known_hashes(results), read_record(results)
    found: list[list[tuple[Cell, Outcome | None]]] = []
    read: dict[str, bool] = {}  # by folder of a model: whether a cell that must run reads it
    with bar("cells compared", sum(map(len, plan)), lines=False) as advance:
        for cells in reversed(plan):
            found.insert(0, [])
            for cell in cells:
                if cell.verb == "fit":
                    again = not _is_made(cell) and read.get(cell.options.get("model.output", ""), True)
                    outcome = None if again else Outcome(note="done before")
                else:
                    outcome = _before(cell, known, record)
                    model = cell.options.get("model.pretrained", "")
                    read[model] = outcome is None or read.get(model, False)
                found[0].append((cell, outcome))
                advance()
    return found


def to_run(found: Sequence[Sequence[tuple[Cell, Outcome | None]]]) -> list[list[Cell]]:
    """The cells of each stage of :func:`outcomes` that must run."""
    return [[cell for cell, outcome in stage if outcome is None] for stage in found]


def _is_made(cell: Cell) -> bool:
    """Whether the ``done`` file of a cell exists."""
    return bool(cell.done) and Path(cell.done).is_file()


def _before(cell: Cell, known: set[str], record: Mapping[str, CellRecord]) -> Outcome | None:
    """Outcome of an inversion whose rows are in the results. The hash of its configuration contains that of the pretrained model;
    where the model is missing, the record of a run with the same settings decides.
    """
    if _is_made(cell):
        return Outcome(note="done before")
    if not known:
        return None
    entry = record.get(cell.name, CellRecord())
    if entry.config_hash in known and entry.settings == settings_of(cell):
        return Outcome(note=IN_RESULTS)
    from ftl_lightning.apps.lightning_cli import build

    with log_folder.run(), suppress(UserError, ArgumentError):
        found = _hash(build(cell.verb, [*cell.arguments, *_log(cell)]))
        return Outcome(note=IN_RESULTS, config_hash=found) if found in known else None
    return None


def settings_of(cell: Cell) -> str:
    """Hash of the values of all options of a cell, but the folder of recordings, and of its pretraining."""
    from ftl_lightning.apps.lightning_cli import parse

    values = [parse(one.verb, one.arguments) for one in (cell, cell.pretraining) if one]
    for options in values:
        options["data"]["init_args"].pop("root", None)
    return content_hash(values)


def show_cells(results: str, cells: Sequence[Cell]) -> None:
    """Print the table of cells, and their states by machine."""
    from ftl_lightning.evaluation.summary import show

    entries = read_record(results)
    show(table(entries, cells))
    say("\n".join(by_node(entries, cells)))


@contextmanager
def _executor(name: str, address: str, cells: Sequence[Cell]) -> Iterator[Run]:
    if name == "local":
        require(not address, "address", "none without --executor ray", address)
        yield _one_after_another
        return
    with cluster(address, attempt, cells) as run:
        yield run


def _one_after_another(cells: Sequence[Cell], known: set[str], tell: Tell) -> Iterator[tuple[Cell, Outcome]]:
    for cell in cells:
        tell(cell, "running", node := socket.gethostname(), "")
        yield cell, replace(attempt(cell, known), node=node)


def attempt(cell: Cell, known: set[str], again: bool = False) -> Outcome:
    """Run a cell, unless its configuration hash is known; any error becomes its outcome. Pretraining that was lost before
    (``again``) resumes from its last checkpoint, if any.
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
                return Outcome(note=IN_RESULTS, config_hash=_hash(line))
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
    note, config_hash = ("done", "") if rows is None else (f"{len(rows)} rows", rows["config_hash"].iloc[0])
    return Outcome(rows, note, seconds=seconds, config_hash=config_hash)


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
