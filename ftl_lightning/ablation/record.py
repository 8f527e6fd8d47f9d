"""What became of each cell: a file beside the results, which all shards write, and the table that it is read in."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from rich.table import Table

from ftl_lightning.ablation.outcome import State
from ftl_lightning.ablation.plan import Cell
from ftl_lightning.errors import UserError, about, short
from ftl_lightning.evaluation.summary import literal
from ftl_lightning.printing import line
from ftl_lightning.schema import expect_type, read_json
from ftl_lightning.tensor_file import alone, write_text

KIND = "cells of an ablation"
FORMAT = 1
_SEED = re.compile(r", seed \d+$")


@dataclass(frozen=True)
class Entry:
    """What became of a cell.

    Attributes:
        state: the last that was told.
        configs: its configuration files.
        node: the machine that ran it last.
        runs: how often it was begun by the last command that ran it.
        seconds: that its last complete run took; 0 for none.
        note: its outcome, or the error.
    """

    state: Literal["queued", "running", "again", "done", "failed"] = "queued"
    configs: tuple[str, ...] = ()
    node: str = ""
    runs: int = 0
    seconds: float = 0.0
    note: str = ""


def record_path(results: str | Path) -> Path:
    """The file beside a results file: ``results/agent.csv`` has ``results/agent.cells.json``."""
    return Path(results).with_suffix(".cells.json")


def read_record(results: str | Path) -> dict[str, Entry]:
    """Entries by the names of their cells; none where there is no file.

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
        found: dict[str, Entry] = expect_type(content.get("cells"), dict[str, Entry], "cells")
        return found


def tell(results: str | Path, cells: Sequence[Cell], state: State, node: str = "", note: str = "", seconds: float = 0.0) -> None:
    """Put down that cells are in a state from now on. Processes that write the same file wait for one another.

    Args:
        results: the results file.
        cells: all in the same state.
        state: from now on.
        node: the machine; empty for the one known before.
        note: the outcome, the error, or why it runs again.
        seconds: that a run which ended took; 0 to keep what is known.
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
    """The name of a cell without its seed: cells that share it take about as long."""
    return _SEED.sub("", name)


def table(entries: Mapping[str, Entry], cells: Sequence[Cell]) -> Table:
    """How far cells are: one line for each, with its state, machine, runs, seconds, and outcome or error.

    Args:
        entries: of the record.
        cells: of the plan, in order; one without an entry was never begun.
    """
    found = {cell.name: entries.get(cell.name, Entry()) for cell in cells}
    shown = Table(title=counted([entry.state for entry in found.values()]))
    for name in ("cell", "state", "node"):
        shown.add_column(name)
    for name in ("runs", "seconds"):
        shown.add_column(name, justify="right")
    shown.add_column("note")
    for name, entry in found.items():
        seconds = f"{entry.seconds:.0f}" if entry.seconds else ""
        runs = str(entry.runs or "")
        shown.add_row(*(literal(text) for text in (name, entry.state, entry.node, runs, seconds, short(entry.note, 100))))
    return shown


def counted(states: Sequence[str]) -> str:
    """Cells by state, in one line: ``'4 cells: 1 queued, 3 done'``."""
    parts = [f"{states.count(state)} {state}" for state in get_args(State) if state in states]
    cells = f"{len(states)} {'cell' if len(states) == 1 else 'cells'}"
    return f"{cells}: {', '.join(parts)}" if parts else cells


def by_node(entries: Mapping[str, Entry], cells: Sequence[Cell]) -> list[str]:
    """The same by machine, in one line for each."""
    found = [entries[cell.name] for cell in cells if cell.name in entries]
    nodes = sorted({entry.node for entry in found if entry.node})
    return [f"{node}: {counted([entry.state for entry in found if entry.node == node])}" for node in nodes]
