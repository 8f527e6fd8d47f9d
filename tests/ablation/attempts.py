"""What cells do in tests of how they are placed and lost: next to nothing, on a machine of the cluster."""

import os
import signal
import time
from pathlib import Path

from ftl_lightning.ablation.outcome import Outcome
from ftl_lightning.ablation.plan import Cell


def attempt(cell: Cell, known: set[str]) -> Outcome:
    """Do what the cell's name says."""
    before = Path(f"{cell.folder}.begun").exists()
    Path(f"{cell.folder}.begun").touch()
    if cell.name == "fails":
        raise ValueError("the third concept has no demonstrations")
    if cell.name == "kills its process twice" or (cell.name == "kills its process once" and not before):
        os.kill(os.getpid(), signal.SIGKILL)
    if cell.name == "takes long":
        time.sleep(600)
    return Outcome(note="second" if before else "first")
