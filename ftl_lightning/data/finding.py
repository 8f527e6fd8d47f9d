"""Findings of checks of demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

Severity = Literal["note", "warning", "error"]
MOST_NAMED = 6
"""Maximum number of demonstrations to list individually."""


@dataclass(frozen=True)
class Finding:
    """Finding of a check.

    Attributes:
        text: a sentence without a full stop, which follows the demonstrations' numbers if there are any.
        severity: ``'note'`` for information, ``'warning'`` for a likely fault, ``'error'`` for data that nothing can be learned
            from.
        rows: demonstrations, from 0; empty for all. Texts count from 1.
    """

    text: str
    severity: Severity = "warning"
    rows: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{numbered(self.rows)}: {self.text}" if self.rows else self.text

    def among(self, rows: Sequence[int]) -> Self:
        """Map rows of a selection to all demonstrations; ``rows`` is the selection."""
        return replace(self, rows=tuple(rows[row] for row in self.rows))

    def within(self, rows: Sequence[int]) -> Self:
        """Invert :meth:`among`."""
        return replace(self, rows=tuple(rows.index(row) for row in self.rows))


def numbered(rows: Sequence[int]) -> str:
    """Demonstrations by their numbers from 1: ``'demonstration 3'``, ``'demonstrations 1, 2 and 5'``."""
    if len(rows) == 1:
        return f"demonstration {rows[0] + 1}"
    if len(rows) > MOST_NAMED:
        return f"{len(rows)} demonstrations ({', '.join(str(row + 1) for row in rows[:3])}, ...)"
    return f"demonstrations {', '.join(str(row + 1) for row in rows[:-1])} and {rows[-1] + 1}"
