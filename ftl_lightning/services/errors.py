"""Errors that a user can cause and correct."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

LONGEST = 300
"""Maximum characters of a line on an error; paths may add 100."""


class UserError(Exception):
    """Mistake in the input. The message is a single line: file or key, expected, found, what to do.

    The command line prints it without a traceback and exits with code 2.

    Args:
        message: shortened to :data:`LONGEST` + 100 characters in a single line, since files may hold texts of any length.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(short(str(message), LONGEST + 100))


class Note(UserWarning):
    """Assumption about the input, or a change to it. The command line prints it as ``note: ...``."""


_file: ContextVar[str] = ContextVar("file", default="")
"""File of the outermost block of :func:`about`; empty outside."""


def note(message: str) -> None:
    """Warn of an assumption about the input, or of a change to it; in a block of :func:`about` the message names the file."""
    prefix = f"{_file.get()}: " if _file.get() else ""
    warnings.warn(prefix + message.removeprefix(prefix), Note, stacklevel=3)


def short(text: str, most: int = 60) -> str:
    """Shorten a text to a single line of at most ``most`` characters."""
    line = " ".join(text.split())
    half = (most - 5) // 2
    return line if len(line) <= most else f"{line[:half]} ... {line[-half:]}"


def shown(value: object, most: int = 60) -> str:
    """``repr`` of any value, shortened to ``most`` characters."""
    try:
        return short(repr(value), most)
    except (ValueError, RecursionError):  # a number of thousands of digits, or lists too deep
        return f"a very large {type(value).__name__}"


def require(condition: object, place: str, expected: str, found: object) -> None:
    """Check a condition of the input at a place: a file, a key or an argument.

    Raises:
        UserError: ``'place: expected ..., found ...'`` unless the condition holds; ``found`` by :func:`shown` unless it is a text.
    """
    if not condition:
        raise UserError(f"{place}: expected {expected}, found {found if isinstance(found, str) else shown(found)}")


@contextmanager
def about(where: str | Path) -> Iterator[None]:
    """Prefix a :class:`UserError` of the block with a file name; :data:`LONGEST` characters at most unless the name is long.

    Notes of the block name the file of the outermost block.
    """
    before = _file.set(_file.get() or str(where))
    try:
        yield
    except UserError as error:
        message = str(error).removeprefix(f"{where}: ")
        raise UserError(f"{where}: {short(message, max(LONGEST - len(str(where)) - 20, 150))}") from error.__cause__
    finally:
        _file.reset(before)


def mistake_behind(error: BaseException | None) -> UserError | None:
    """:class:`UserError` that caused an exception, if any; jsonargparse wraps what a constructor raises."""
    while error is not None and not isinstance(error, UserError):
        error = error.__cause__ or error.__context__
    return error


def mistake_of_machine(error: BaseException) -> str | None:
    """Message for an inaccessible file or too little memory, which a user can correct; ``None`` for other errors."""
    if isinstance(error, OSError):
        where = short(str(error.filename or "a file"), 150)
        reason = error.strerror or short(str(error))
        return f"{where}: expected a place that can be read and written, found another ({reason}); choose another place"
    text = str(error)
    if isinstance(error, MemoryError) or any(words in text for words in _NO_MEMORY):
        return (
            f"memory: this takes more than the machine has ({short(text, 100) or 'none is left'}); lower data.batch_size, "
            "model.budget.samples, evaluation.samples or count"
        )
    if isinstance(error, UnicodeEncodeError) or "null byte" in text or "null character" in text:
        return f"name of a file: expected letters that a file system takes, found others ({short(ascii(text), 100)})"
    return None


_NO_MEMORY = (  # messages of torch and numpy
    *("can't allocate memory", "not enough memory", "out of memory", "Unable to allocate", "Storage size calculation overflowed"),
)
