"""What a check found in some demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

Severity = Literal["note", "warning", "error"]
MOST_NAMED = 6
"""Demonstrations that are named one by one."""


@dataclass(frozen=True)
class Finding:
    """Something that a check found.

    Attributes:
        text: one sentence without a full stop, which goes on after the demonstrations' numbers where there are any.
        severity: ``'note'`` for what is good to know, ``'warning'`` for what is likely a fault, ``'error'`` for what nothing can be
            learned from.
        rows: which demonstrations, from 0; empty where it is about all of them. Texts count from 1.
    """

    text: str
    severity: Severity = "warning"
    rows: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{numbered(self.rows)}: {self.text}" if self.rows else self.text

    def among(self, rows: Sequence[int]) -> Self:
        """The same of demonstrations that are these rows of more."""
        return replace(self, rows=tuple(rows[row] for row in self.rows))

    def within(self, rows: Sequence[int]) -> Self:
        """The inverse of :meth:`among`."""
        return replace(self, rows=tuple(rows.index(row) for row in self.rows))


def numbered(rows: Sequence[int]) -> str:
    """Demonstrations by their numbers from 1: ``'demonstration 3'``, ``'demonstrations 1, 2 and 5'``."""
    if len(rows) == 1:
        return f"demonstration {rows[0] + 1}"
    if len(rows) > MOST_NAMED:
        return f"{len(rows)} demonstrations ({', '.join(str(row + 1) for row in rows[:3])}, ...)"
    return f"demonstrations {', '.join(str(row + 1) for row in rows[:-1])} and {rows[-1] + 1}"
