"""Print text without characters that move a terminal's cursor, change its colours or reverse writing.

Names come from files, which others may have written. All printed text goes through :func:`say`, all text in a line of a table, a
figure or a message through :func:`line`.
"""

import io
import sys
from dataclasses import dataclass
from unicodedata import category


def plain(text: str) -> str:
    """Replace unprintable characters by question marks, but for line breaks and tabs, and wide spaces by plain ones."""
    return "".join(char if char.isprintable() or char in "\n\t" else " " if category(char) == "Zs" else "?" for char in text)


def line(text: str) -> str:
    """:func:`plain` in a single line, with single spaces."""
    return plain(" ".join(text.split()))


@dataclass
class _Voice:
    silent: bool = False


_VOICE = _Voice()


def silence() -> None:
    """Print nothing from now on: of several processes of a run only the first prints."""
    _VOICE.silent = True


def say(*parts: object, error: bool = False) -> None:
    """Print a text by :func:`plain`, at once.

    Args:
        parts: values, separated by spaces.
        error: whether to print to standard error.
    """
    if not _VOICE.silent:
        print(*(plain(str(part)) for part in parts), file=sys.stderr if error else sys.stdout, flush=True)


def any_terminal() -> None:
    """Let standard output replace characters that its encoding lacks, such as ± in ASCII, by question marks."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # not a notebook's
        sys.stdout.reconfigure(errors="replace")
