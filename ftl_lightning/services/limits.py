"""Limits of files, checked before they are read: a regular file of a bounded size.

The limits are far above the sizes of honest files, and far below what would hang a laptop. An environment variable
(:data:`VARIABLE`, in bytes) raises them for files of tensors and their compressed content.
"""

import os
import stat
from pathlib import Path

from ftl_lightning.services.errors import UserError, short

VARIABLE = "FTL_LIGHTNING_MOST_BYTES"
MOST_BYTES = 2 * 2**30
"""Maximum bytes of a file of tensors: a model, a checkpoint, demonstrations."""
MOST_TEXT = 32 * 2**20
"""Maximum bytes of a text: JSON, CSV, Markdown."""
MOST_HEADER = 8 * 2**20
"""Maximum bytes of a safetensors header, which holds a text for each demonstration; scaled by :func:`raised`."""
MOST_TENSORS = 20_000
"""Maximum number of tensors in a file."""
MOST_UNPACKED = 128 * 2**20
"""Maximum bytes of unpacked arrays, or :data:`MOST_RATIO` times the bytes of the file if that is more."""
MOST_RATIO = 100


def most_bytes() -> int:
    """:data:`MOST_BYTES`, or the value of the environment variable.

    Raises:
        UserError: if the value is no number of bytes.
    """
    text = os.environ.get(VARIABLE, "")
    if text and not (text.isdecimal() and len(text) < 20):
        raise UserError(f"{VARIABLE}: expected a number of bytes, found {short(text)!r}")
    return int(text) if text else MOST_BYTES


def raised(most: int) -> int:
    """Scale a limit by the user's file-size factor."""
    return int(most * max(1, most_bytes() / MOST_BYTES))


def check_readable(path: str | Path, kind: str, most: int | None = None) -> int:
    """Refuse anything but a regular file of bounded size. The file is not opened: a pipe would wait for ever.

    Args:
        path: path of the file.
        kind: expected kind, for messages.
        most: maximum bytes; ``None`` for the limit of a file of tensors.

    Returns:
        Size in bytes.

    Raises:
        UserError: naming the file.
    """
    try:
        status = Path(path).stat()
    except (OSError, ValueError) as error:
        actual = "nothing" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or str(error)
        raise UserError(f"{short(str(path), 150)}: expected a {kind} file, found {actual}") from error
    if not stat.S_ISREG(status.st_mode):
        actual = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, pipe or socket"
        raise UserError(f"{path}: expected a {kind} file, found {actual}")
    if status.st_size > (limit := most_bytes() if most is None else most):
        mend = f"; if it is honest, set {VARIABLE} to more" if most is None else ""
        raise UserError(f"{path}: expected a {kind} file of at most {limit} bytes, found {status.st_size}{mend}")
    return status.st_size


def check_unpacked(size: int, packed: int, what: str) -> None:
    """Refuse compressed content that unpacks to far more than honest content does.

    Args:
        size: unpacked bytes.
        packed: packed bytes.
        what: name of the content, for messages.

    Raises:
        UserError: naming both sizes.
    """
    if size > (most := min(raised(max(MOST_UNPACKED, MOST_RATIO * packed)), most_bytes())):
        raise UserError(f"{what}: expected at most {most} bytes in a file of {packed}, found {size}; save it without compression")


def read_text(path: str | Path, kind: str, most: int = MOST_TEXT, encoding: str = "utf-8") -> str:
    """Read a text file.

    Raises:
        UserError: naming the file, as :func:`check_readable`, or if it cannot be read or is in another encoding.
    """
    check_readable(path, kind, most)
    try:
        return Path(path).read_text(encoding=encoding)
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: expected a {kind} file in {encoding}, found other bytes; save it as UTF-8") from error
    except OSError as error:
        raise UserError(f"{path}: expected a {kind} file, found one that cannot be read ({error.strerror})") from error
