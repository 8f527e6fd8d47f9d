"""The end of a cell, and how what runs cells is called."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from ftl_lightning.ablation.plan import Cell

if TYPE_CHECKING:
    import pandas as pd

State = Literal["queued", "running", "again", "done", "failed"]
"""Of a cell; ``again`` is queued a second time, after its process or its machine was lost."""


@dataclass(frozen=True)
class Outcome:
    """The end of a cell.

    Attributes:
        rows: of results; ``None`` for none.
        note: in a few words.
        error: of a cell that failed, one line.
        seconds: that it took; 0 where nothing had to be run.
        node: the machine that ran it.
    """

    rows: "pd.DataFrame | None" = None
    note: str = ""
    error: str = ""
    seconds: float = 0.0
    node: str = ""


Tell = Callable[[Cell, State, str, str], None]
"""Is told that a cell is in a state from now on, the machine, and a note."""
Run = Callable[[Sequence[Cell], set[str], Tell], Iterator[tuple[Cell, Outcome]]]
"""Runs cells, given the configuration hashes that need not be run; yields each with its outcome as it ends."""
Attempt = Callable[[Cell, set[str], bool], Outcome]
"""Runs one cell, unless its configuration hash is among those; for the second time, if it was lost before."""
