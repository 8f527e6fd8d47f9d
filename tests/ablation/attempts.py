"""What cells do in tests of how they are placed and lost: next to nothing, on a machine of the cluster."""

import os
import signal
import time
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from ftl_lightning.ablation.outcome import Outcome
from ftl_lightning.ablation.plan import Cell
from ftl_lightning.evaluation.results import Row


def attempt(cell: Cell, known: set[str], again: bool) -> Outcome:
    """Do what the cell's name says."""
    if cell.name == "fails":
        raise ValueError("the third concept has no demonstrations")
    if cell.name == "kills its process":
        os.kill(os.getpid(), signal.SIGKILL)
    if cell.name == "takes long":
        time.sleep(600)
    return Outcome(note="done")


def rows(cell: Cell, known: set[str], again: bool) -> Outcome:
    """Take a second and give three rows, unless they are known. Two of the cells wait for a file first."""
    if cell.name in known:
        return Outcome(note="in the results already")
    while cell.options["model.omega"] in ("3", "4") and not Path("go").exists():
        time.sleep(0.1)
    time.sleep(1)
    name, omega = cell.name, cell.options["model.omega"]
    what = {"domain": "d", "setting": "s", "method": "m", "metric": "a", "value": 1.0, "model_hash": "", "config_hash": name}
    made = [Row(task=task, K=1, omega=omega, demonstrations=5, seed=0, n=1, **what) for task in "abc"]  # type: ignore[arg-type]
    return Outcome(pd.DataFrame([asdict(row) for row in made]), "3 rows", seconds=1)
