"""What is printed: text without what moves a terminal's cursor, changes its colours or turns writing round.

Names come from files, which others may have written. Everything that is printed goes through :func:`say`, everything that is put
into one line of a table, a figure or a message through :func:`line`.
"""

import io
import sys
from dataclasses import dataclass
from unicodedata import category


def plain(text: str) -> str:
    """A text of any number of lines with a question mark for everything that is not printable, and wide spaces as plain ones."""
    return "".join(one if one.isprintable() or one in "\n\t" else " " if category(one) == "Zs" else "?" for one in text)


def line(text: str) -> str:
    """The same in one line, with single spaces."""
    return plain(" ".join(text.split()))


@dataclass
class _Voice:
    silent: bool = False


_VOICE = _Voice()


def silence() -> None:
    """Print nothing from now on: of several processes of one run the first one speaks."""
    _VOICE.silent = True


def say(*parts: object, error: bool = False) -> None:
    """Print, as :func:`plain` has it, at once.

    Args:
        parts: printed with a space between two of them.
        error: whether it goes to standard error.
    """
    if not _VOICE.silent:
        print(*(plain(str(part)) for part in parts), file=sys.stderr if error else sys.stdout, flush=True)


def any_terminal() -> None:
    """Let standard output take every letter: one that its encoding does not have, such as ± in ASCII, becomes a question mark."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # not a notebook's
        sys.stdout.reconfigure(errors="replace")
