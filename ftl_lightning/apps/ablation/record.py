"""States of cells: a file beside the results, written by all shards, and its table."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from rich.table import Table

from ftl_lightning.apps.ablation.outcome import State
from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.evaluation.summary import literal
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.tensor_file import alone, write_text
from ftl_lightning.services.text import line
from ftl_lightning.services.validation import check_type, read_json

KIND = "cells of an ablation"
FORMAT = 1
_SEED = re.compile(r", seed \d+$")


@dataclass(frozen=True)
class Entry:
    """State of a cell.

    Attributes:
        state: last reported state.
        configs: configuration files of the cell.
        node: last machine of the cell.
        runs: number of attempts by the last command.
        seconds: duration of the last complete run; 0 for none.
        note: outcome, or the error.
    """

    state: Literal["queued", "running", "again", "done", "failed"] = "queued"
    configs: tuple[str, ...] = ()
    node: str = ""
    runs: int = 0
    seconds: float = 0.0
    note: str = ""


def record_path(results: str | Path) -> Path:
    """The record of a results file: ``results/agent.cells.json`` for ``results/agent.csv``."""
    return Path(results).with_suffix(".cells.json")


def read_record(results: str | Path) -> dict[str, Entry]:
    """Read the entries by cell name; empty if there is no file.

    Raises:
        UserError: for a damaged file.
    """
    path = record_path(results)
    if not path.exists():
        return {}
    content = read_json(path, KIND)
    with about(path):
        kind, version = (content.get("kind"), content.get("format")) if isinstance(content, dict) else (None, None)
        if (kind, version) != (KIND, FORMAT):
            raise UserError(f"expected {KIND} of format {FORMAT}, found another file; remove it, it holds no results")
        entries: dict[str, Entry] = check_type(content.get("cells"), dict[str, Entry], "cells")
        return entries


def tell(results: str | Path, cells: Sequence[Cell], state: State, node: str = "", note: str = "", seconds: float = 0.0) -> None:
    """Record a new state of cells. The file is locked against other processes.

    Args:
        results: the results file.
        cells: the cells.
        state: the new state.
        node: the machine; empty to keep the known machine.
        note: the outcome, the error, or the reason for another run.
        seconds: duration of a completed run; 0 to keep the known duration.
    """
    path = record_path(results)
    with alone(path.parent):
        entries = read_record(results)
        for cell in cells:
            before = entries.get(cell.name, Entry())
            runs = 0 if state == "queued" else before.runs + (state == "running")
            known = "" if state == "queued" else before.node
            entries[cell.name] = replace(
                before,
                state=state,
                configs=cell.configs,
                node=node or known,
                runs=runs,
                seconds=round(seconds, 2) or before.seconds,
                note=line(note),
            )
        content = {"kind": KIND, "format": FORMAT, "cells": {name: asdict(entry) for name, entry in entries.items()}}
        write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def without_seed(name: str) -> str:
    """The name of a cell without its seed; cells with the same name take about as long."""
    return _SEED.sub("", name)


def table(entries: Mapping[str, Entry], cells: Sequence[Cell]) -> Table:
    """Table of cells with state, machine, runs, seconds, and outcome or error.

    Args:
        entries: entries of the record.
        cells: cells of the plan, in order; cells without an entry were never started.
    """
    known = {cell.name: entries.get(cell.name, Entry()) for cell in cells}
    shown = Table(title=counted([entry.state for entry in known.values()]))
    for name in ("cell", "state", "node"):
        shown.add_column(name)
    for name in ("runs", "seconds"):
        shown.add_column(name, justify="right")
    shown.add_column("note")
    for name, entry in known.items():
        seconds = f"{entry.seconds:.0f}" if entry.seconds else ""
        runs = str(entry.runs or "")
        shown.add_row(*(literal(text) for text in (name, entry.state, entry.node, runs, seconds, short(entry.note, 100))))
    return shown


def counted(states: Sequence[str]) -> str:
    """Count cells by state: ``'4 cells: 1 queued, 3 done'``."""
    parts = [f"{states.count(state)} {state}" for state in get_args(State) if state in states]
    cells = f"{len(states)} {'cell' if len(states) == 1 else 'cells'}"
    return f"{cells}: {', '.join(parts)}" if parts else cells


def by_node(entries: Mapping[str, Entry], cells: Sequence[Cell]) -> list[str]:
    """Counts of cells by state, in a line for each machine."""
    known = [entries[cell.name] for cell in cells if cell.name in entries]
    nodes = sorted({entry.node for entry in known if entry.node})
    return [f"{node}: {counted([entry.state for entry in known if entry.node == node])}" for node in nodes]
