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
    """Anything as Python writes it, cut to a line's length."""
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
        told = str(error).removeprefix(f"{where}: ")
        raise UserError(f"{where}: {short(told, max(LONGEST - len(str(where)) - 20, 150))}") from error.__cause__


def mistake_behind(error: BaseException | None) -> UserError | None:
    """The :class:`UserError` that an exception was raised from, if any; jsonargparse wraps what a constructor raises."""
    while error is not None and not isinstance(error, UserError):
        error = error.__cause__ or error.__context__
    return error


def mistake_of_machine(error: BaseException) -> str | None:
    """What a user can mend of a machine's refusal, in one line: a file that cannot be read or written, or memory that is not there.

    Returns:
        ``None`` for any other exception.
    """
    if isinstance(error, OSError):
        where = short(str(error.filename or "a file"), 150)
        told = error.strerror or short(str(error))
        return f"{where}: expected a place that can be read and written, found another ({told}); choose another one"
    text = str(error)
    if isinstance(error, MemoryError) or any(words in text for words in _NO_MEMORY):
        return (
            f"memory: this takes more than the machine has ({short(text, 100) or 'none is left'}); lower data.batch_size, "
            "model.budget.samples, evaluation.samples or count"
        )
    if isinstance(error, UnicodeEncodeError) or "null byte" in text or "null character" in text:
        return f"name of a file: expected letters that a file system takes, found others ({short(ascii(text), 100)})"
    return None


_NO_MEMORY = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "Unable to allocate",
    "Storage size calculation overflowed",
)
"""How torch and numpy say it."""
