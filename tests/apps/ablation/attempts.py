"""What cells do in tests of how they are placed, lost, counted and shown: next to nothing."""

import os
import signal
import time
from dataclasses import asdict
from pathlib import Path

import pandas as pd
import pytest

from ftl_lightning.apps.ablation import run
from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.apps.ablation.record import Outcome
from ftl_lightning.evaluation.results import Row


def attempt(cell: Cell, known: set[str], again: bool) -> Outcome:
    """Do what the cell's name says."""
    if cell.name == "fails":
        raise ValueError("the third concept has no demonstrations")
    if cell.name == "kills its process":
        os.kill(os.getpid(), signal.SIGKILL)
    if cell.name == "takes long":
        signal.pause()
    return Outcome(note="done")


def rows(cell: Cell, known: set[str], again: bool) -> Outcome:
    """Give three rows, unless they are known. Two of the cells wait for a file, and two for another."""
    if cell.name in known:
        return Outcome(note="in the results already")
    while not Path("first" if cell.options["model.omega"] in ("1", "2") else "go").exists():
        time.sleep(0.1)
    return three_rows(cell)


def at_once(cell: Cell, known: set[str], again: bool = False) -> Outcome:
    """The same without waiting; a cell whose name says that it is steep fails."""
    return Outcome(error="the loss became nan") if "steep" in cell.name else three_rows(cell)


def three_rows(cell: Cell) -> Outcome:
    """Of a cell that took a second."""
    name, omega = cell.name, cell.options["model.omega"]
    what = {"domain": "d", "setting": "s", "method": "m", "metric": "a", "value": 1.0, "model_hash": "", "config_hash": name}
    made = [Row(task=task, K=1, omega=omega, demonstrations=5, seed=0, n=1, **what) for task in "abc"]  # type: ignore[arg-type]
    return Outcome(pd.DataFrame([asdict(row) for row in made]), "3 rows", seconds=1)


@pytest.fixture
def nothing_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of this process are only counted: files that they name need not be there."""
    monkeypatch.setattr(run, "attempt", at_once)
    monkeypatch.setattr(run, "check", lambda cells: None)
    monkeypatch.setattr(run, "_before", lambda cell, known, record: Outcome() if cell.name in known else None)
