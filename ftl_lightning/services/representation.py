"""Short representations of objects: a line in print, a list in notebooks."""

import html
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

from ftl_lightning.services.errors import LONGEST, short

MOST_NUMBERS = 6
"""Maximum number of values shown of a list."""


class Shown(ABC):
    """Object with a short representation."""

    @abstractmethod
    def _words(self) -> Iterable[str]:
        """Descriptive words, most important first."""

    def __repr__(self) -> str:
        return short(f"{type(self).__name__}({', '.join(map(short, self._words()))})", LONGEST)

    def _repr_html_(self) -> str:
        """HTML for notebooks; names come from files, so they are escaped."""
        items = "".join(f"<li>{html.escape(short(word))}</li>" for word in self._words())
        return f"<b>{html.escape(type(self).__name__)}</b><ul>{items}</ul>"


def numbers(values: Sequence[float]) -> str:
    """Short text of numbers."""
    text = ", ".join(f"{value:.2f}" for value in values[:MOST_NUMBERS])
    return text if len(values) <= MOST_NUMBERS else f"{text}, ..."


def counted(count: int, what: str) -> str:
    """Count with a noun, such as ``'1 mode'`` and ``'5 modes'``."""
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"
