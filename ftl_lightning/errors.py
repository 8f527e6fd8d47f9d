"""The one kind of error that a user can cause and mend."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST = 300
"""Characters of a line that tells a mistake."""


class UserError(Exception):
    """A mistake in the input. The message is one line: file or key, expected, found, what to do.

    The command line prints it without a traceback and exits with code 2.
    """


def short(text: str, most: int = 60) -> str:
    """A text in one line of at most so many characters."""
    line = " ".join(text.split())
    half = (most - 5) // 2
    return line if len(line) <= most else f"{line[:half]} ... {line[-half:]}"


def shown(value: object, most: int = 60) -> str:
    """Anything as Python writes it, likewise."""
    try:
        return short(repr(value), most)
    except (ValueError, RecursionError):  # a number of thousands of digits, or lists too deep
        return f"a very large {type(value).__name__}"


@contextmanager
def about(where: str | Path) -> Iterator[None]:
    """Name a file before a mistake that is found in what it holds.

    Raises:
        UserError: the block's, in one line of at most :data:`LONGEST` characters unless the name is long.
    """
    try:
        yield
    except UserError as error:
        raise UserError(f"{where}: {short(str(error), max(LONGEST - len(str(where)) - 20, 150))}") from error.__cause__


def mistake_behind(error: BaseException | None) -> UserError | None:
    """The :class:`UserError` that an exception was raised from, if any; jsonargparse wraps what a constructor raises."""
    while error is not None and not isinstance(error, UserError):
        error = error.__cause__ or error.__context__
    return error
