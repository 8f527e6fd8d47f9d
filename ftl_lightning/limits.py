"""What a file may hold, looked at before it is read: a regular file of a bounded size.

The limits are far above what an honest file of this kind has, and far below what would hang a laptop. Who has larger files raises
them by an environment variable (:data:`VARIABLE`, in bytes), for files of tensors and for what is compressed in them.
"""

import os
import stat
from pathlib import Path

from ftl_lightning.errors import UserError, short

VARIABLE = "FTL_LIGHTNING_MOST_BYTES"
MOST_BYTES = 2 * 2**30
"""Of a file of tensors: a model, a checkpoint, demonstrations."""
MOST_TEXT = 32 * 2**20
"""Bytes of a text: JSON, CSV, Markdown."""
MOST_HEADER = 8 * 2**20
"""Bytes of the header of a safetensors file, which holds a text for each demonstration; in larger files the more."""
MOST_TENSORS = 20_000
"""Tensors in a file."""
MOST_UNPACKED = 128 * 2**20
"""Bytes that compressed arrays may come to, where that is more than :data:`MOST_RATIO` times those of the file."""
MOST_RATIO = 100


def most_bytes() -> int:
    """:data:`MOST_BYTES`, or what the environment says in its place.

    Raises:
        UserError: if that is no number of bytes.
    """
    text = os.environ.get(VARIABLE, "")
    if text and not (text.isdecimal() and len(text) < 20):
        raise UserError(f"{VARIABLE}: expected a number of bytes, found {short(text)!r}")
    return int(text) if text else MOST_BYTES


def raised(most: int) -> int:
    """A limit, as many times as high as the user has raised that of files."""
    return int(most * max(1, most_bytes() / MOST_BYTES))


def expect_readable(path: str | Path, kind: str, most: int | None = None) -> int:
    """Refuse what is no regular file, or too large a one. Nothing is opened: a pipe would wait for ever.

    Args:
        path: of the file.
        kind: what it is expected to be, for messages.
        most: bytes; ``None`` for those of a file of tensors.

    Returns:
        Its size in bytes.

    Raises:
        UserError: naming the file.
    """
    try:
        found = Path(path).stat()
    except (OSError, ValueError) as error:
        told = "nothing" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or str(error)
        raise UserError(f"{short(str(path), 150)}: expected a {kind} file, found {told}") from error
    if not stat.S_ISREG(found.st_mode):
        told = "a folder" if stat.S_ISDIR(found.st_mode) else "a device, pipe or socket"
        raise UserError(f"{path}: expected a {kind} file, found {told}")
    if found.st_size > (limit := most_bytes() if most is None else most):
        mend = f"; if it is honest, set {VARIABLE} to more" if most is None else ""
        raise UserError(f"{path}: expected a {kind} file of at most {limit} bytes, found {found.st_size}{mend}")
    return found.st_size


def expect_unpacked(size: int, packed: int, what: str) -> None:
    """Refuse compressed content that would come to far more than honest content does.

    Args:
        size: bytes that it would come to.
        packed: bytes that it has.
        what: it is, for messages.

    Raises:
        UserError: naming both sizes.
    """
    if size > (most := min(raised(max(MOST_UNPACKED, MOST_RATIO * packed)), most_bytes())):
        raise UserError(f"{what}: expected at most {most} bytes in a file of {packed}, found {size}; save it without compression")


def read_text(path: str | Path, kind: str, most: int = MOST_TEXT, encoding: str = "utf-8") -> str:
    """A text file.

    Raises:
        UserError: naming the file, as :func:`expect_readable`, or if it cannot be read or is in another encoding.
    """
    expect_readable(path, kind, most)
    try:
        return Path(path).read_text(encoding=encoding)
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: expected a {kind} file in {encoding}, found other bytes; save it as UTF-8") from error
    except OSError as error:
        raise UserError(f"{path}: expected a {kind} file, found one that cannot be read ({error.strerror})") from error
