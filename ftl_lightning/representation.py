"""What an object is, in a few words: one line where it is printed, a short list in a notebook."""

import html
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

from ftl_lightning.errors import LONGEST, short

MOST_NUMBERS = 6
"""Numbers of a list that are told one by one."""


class Shown(ABC):
    """Something that says what it is in a few words of its own."""

    @abstractmethod
    def _words(self) -> Iterable[str]:
        """What one wants to know of it, the most important first."""

    def __repr__(self) -> str:
        return short(f"{type(self).__name__}({', '.join(map(short, self._words()))})", LONGEST)

    def _repr_html_(self) -> str:
        """What notebooks show: names come from files, so every letter stands for itself."""
        items = "".join(f"<li>{html.escape(short(word))}</li>" for word in self._words())
        return f"<b>{html.escape(type(self).__name__)}</b><ul>{items}</ul>"


def numbers(values: Sequence[float]) -> str:
    """Some numbers in a few letters."""
    told = ", ".join(f"{value:.2f}" for value in values[:MOST_NUMBERS])
    return told if len(values) <= MOST_NUMBERS else f"{told}, ..."


def counted(count: int, what: str) -> str:
    """A number of things, such as ``'1 mode'`` and ``'5 modes'``."""
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"
