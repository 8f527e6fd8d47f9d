"""States of cells in a file beside the results, written by all shards; their table; estimated cost of a grid."""

import heapq
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Literal, get_args

from rich.table import Table

from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.evaluation.summary import literal
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.tensor_file import alone, write_text
from ftl_lightning.services.text import counted, line
from ftl_lightning.services.validation import check_type, read_json

if TYPE_CHECKING:
    import pandas as pd

KIND = "cells of an ablation"
FORMAT = 1
MINUTE, HOUR = 60.0, 3600.0
_SEED = re.compile(r", seed \d+$")

State = Literal["queued", "running", "again", "done", "failed"]
"""State of a cell; ``again`` is queued a second time, after the loss of its process or machine."""


@dataclass(frozen=True)
class Outcome:
    """Result of a cell: rows (or ``None``), note, single-line error if it failed, seconds (0 if nothing was run), and machine;
    hash of its settings, and configuration hash of its rows.
    """

    rows: "pd.DataFrame | None" = None
    note: str = ""
    error: str = ""
    seconds: float = 0.0
    node: str = ""
    settings: str = ""
    config_hash: str = ""


_NOTHING = Outcome()
Tell = Callable[[Cell, State, str, str], None]  #: Callback for a new state of a cell, with machine and note.
Run = Callable[[Sequence[Cell], set[str], Tell], Iterator[tuple[Cell, Outcome]]]
"""Runs cells, given the configuration hashes that need not run; yields each cell with its outcome."""
Attempt = Callable[[Cell, set[str], bool], Outcome]
"""Runs a cell, unless its configuration hash is known; the flag marks a second attempt."""


@dataclass(frozen=True)
class CellRecord:
    """Recorded state of a cell, with configuration files, last machine, attempts by the last command, and outcome or error.
    ``seconds`` is the duration of the last complete run; 0 for none. ``config_hash`` is that of its rows, if it has any;
    ``settings`` then is the hash of its options, defaults included, and of the pretraining of its model.
    """

    state: State = "queued"
    configs: tuple[str, ...] = ()
    node: str = ""
    runs: int = 0
    seconds: float = 0.0
    note: str = ""
    settings: str = ""
    config_hash: str = ""


def record_path(results: str | Path) -> Path:
    """The record of a results file: ``results/agent.cells.json`` for ``results/agent.csv``."""
    return Path(results).with_suffix(".cells.json")


def read_record(results: str | Path) -> dict[str, CellRecord]:
    """Read the entries by cell name; empty if there is no file. Raise UserError for a damaged file."""
    path = record_path(results)
    if not path.exists():
        return {}
    content = read_json(path, KIND)
    with about(path):
        if not isinstance(content, dict) or (content.get("kind"), content.get("format")) != (KIND, FORMAT):
            raise UserError(f"expected {KIND} of format {FORMAT}, found another file; remove it, it holds no results")
        entries: dict[str, CellRecord] = check_type(content.get("cells"), dict[str, CellRecord], "cells")
        return entries


def tell(results: str | Path, cells: Sequence[Cell], state: State, outcome: Outcome = _NOTHING) -> None:
    """Record a state of cells; what is empty in the outcome keeps its recorded value. Processes write in turn."""
    path = record_path(results)
    with alone(path.parent):
        entries = read_record(results)
        for cell in cells:
            before = entries.get(cell.name, CellRecord())
            entries[cell.name] = CellRecord(
                state=state,
                configs=cell.configs,
                node=outcome.node or ("" if state == "queued" else before.node),
                runs=0 if state == "queued" else before.runs + (state == "running"),
                seconds=round(outcome.seconds, 2) or before.seconds,
                note=line(outcome.error or outcome.note),
                settings=outcome.settings or before.settings,
                config_hash=outcome.config_hash or before.config_hash,
            )
        content = {"kind": KIND, "format": FORMAT, "cells": {name: asdict(entry) for name, entry in entries.items()}}
        write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def table(entries: Mapping[str, CellRecord], cells: Sequence[Cell]) -> Table:
    """Table of cells with state, machine, runs, seconds, and outcome or error; cells without an entry were never started."""
    records = {cell.name: entries.get(cell.name, CellRecord()) for cell in cells}
    states_table = Table(title=count_states([entry.state for entry in records.values()]))
    for name in ("cell", "state", "node", "runs", "seconds", "note"):
        states_table.add_column(name, justify="right" if name in ("runs", "seconds") else "left")
    for name, entry in records.items():
        seconds = f"{entry.seconds:.0f}" if entry.seconds else ""
        runs = str(entry.runs or "")
        states_table.add_row(*(literal(text) for text in (name, entry.state, entry.node, runs, seconds, short(entry.note, 100))))
    return states_table


def count_states(states: Sequence[str]) -> str:
    """Count cells by state: ``'4 cells: 1 queued, 3 done'``."""
    parts = [f"{states.count(state)} {state}" for state in get_args(State) if state in states]
    cells = counted(len(states), "cell")
    return f"{cells}: {', '.join(parts)}" if parts else cells


def by_node(entries: Mapping[str, CellRecord], cells: Sequence[Cell]) -> list[str]:
    """Lines with the number of cells by state, for each machine."""
    records = [entries[cell.name] for cell in cells if cell.name in entries]
    nodes = sorted({entry.node for entry in records if entry.node})
    return [f"{node}: {count_states([entry.state for entry in records if entry.node == node])}" for node in nodes]


def seconds_of(cell: Cell, entries: Mapping[str, CellRecord]) -> float | None:
    """Measured seconds of a cell, or else the mean of the same cell with other seeds, or of the same files with other options, if
    known.
    """
    measured = {name: entry for name, entry in entries.items() if entry.seconds}
    if cell.name in measured:
        return measured[cell.name].seconds
    plain = _SEED.sub("", cell.name)
    same = [entry.seconds for name, entry in measured.items() if _SEED.sub("", name) == plain]
    verb = f"{cell.verb} "
    similar = same or [entry.seconds for name, entry in measured.items() if entry.configs == cell.configs and name.startswith(verb)]
    return mean(similar) if similar else None


def makespan(seconds: Sequence[Sequence[float]], workers: int) -> float:
    """Total seconds of consecutive stages from the durations of their cells; the first free worker takes the next cell."""
    total = 0.0
    for stage in seconds:
        free = [0.0] * workers
        for duration in stage:
            heapq.heapreplace(free, free[0] + duration)
        total += max(free)
    return total


def estimate(plan: Sequence[Sequence[Cell]], entries: Mapping[str, CellRecord], total: int, workers: int = 0) -> list[str]:
    """Lines with the number of cells to run and the estimated hours, if known, for some parallel ``workers`` (0 for the powers of
    two up to the number of cells). ``plan`` has the cells to run of each stage; ``total`` counts all.
    """
    cells = [cell for stage in plan for cell in stage]
    lines = [f"{total} cells: {total - len(cells)} need not be run, {len(cells)} to run"]
    if not cells:
        return lines
    times = [[(cell, seconds_of(cell, entries)) for cell in stage] for stage in plan]
    known = [[seconds for _, seconds in stage if seconds is not None] for stage in times]
    unknown = [cell.name for stage in times for cell, seconds in stage if seconds is None]
    count = len(cells) - len(unknown)
    if not count:
        return [*lines, "hours: not known, as no similar cell was measured; run some, for example with --shard, and ask again"]
    if unknown:
        lines.append(
            f"not known: {len(unknown)} of them, without a similar measured cell, such as {unknown[0]}; their time is added"
        )
    repeated = sum(entries[cell.name].seconds > 0 for cell in cells if cell.name in entries)
    lines.append(f"measured: {repeated} of them before, {count - repeated} estimated from other seeds or options of the same files")
    counts = [workers] if workers else [2**power for power in range((len(cells) - 1).bit_length() + 1)]
    return [*lines, *(f"{number} at a time: {_time(makespan(known, number))}" for number in counts)]


def _time(seconds: float) -> str:
    """Format a time in hours, minutes or seconds."""
    if seconds >= HOUR:
        return f"{seconds / HOUR:.1f} hours"
    return f"{seconds / MINUTE:.0f} minutes" if seconds >= 2 * MINUTE else f"{seconds:.0f} seconds"
