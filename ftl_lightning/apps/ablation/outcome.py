"""Outcomes of cells, and types of functions that run cells."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from ftl_lightning.apps.ablation.plan import Cell

if TYPE_CHECKING:
    import pandas as pd

State = Literal["queued", "running", "again", "done", "failed"]
"""State of a cell; ``again`` is queued once more, after its process or machine was lost."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a cell.

    Attributes:
        rows: rows of results, or ``None``.
        note: a short note.
        error: error of a failed cell, in one line.
        seconds: duration; 0 if nothing was run.
        node: the machine that ran the cell.
    """

    rows: "pd.DataFrame | None" = None
    note: str = ""
    error: str = ""
    seconds: float = 0.0
    node: str = ""


Tell = Callable[[Cell, State, str, str], None]
"""Callback for a new state of a cell, with machine and note."""
Run = Callable[[Sequence[Cell], set[str], Tell], Iterator[tuple[Cell, Outcome]]]
"""Runs cells, given the configuration hashes that need not run; yields each cell with its outcome."""
Attempt = Callable[[Cell, set[str], bool], Outcome]
"""Runs a cell, unless its configuration hash is known; the flag says whether it was lost before."""
