"""Check paths of inputs and outputs before files are read or written.

Size limits are far above legitimate files and far below a laptop's memory. An environment variable (:data:`VARIABLE`, in bytes)
raises them for files of tensors and their compressed content.
"""

import codecs
import os
import re
import stat
import tempfile
from pathlib import Path
from typing import Literal

from ftl_lightning.services.errors import UserError, require, short

VARIABLE = "FTL_LIGHTNING_MOST_BYTES"
MOST_BYTES = 2 * 2**30
"""Maximum bytes of a file of tensors: a model, a checkpoint, demonstrations."""
MOST_TEXT = 32 * 2**20
"""Maximum bytes of a text: JSON, CSV, Markdown."""
MOST_HEADER = 8 * 2**20
"""Maximum bytes of a safetensors header, which holds a text for each demonstration; scaled by :func:`raised`."""
MOST_TENSORS = 20_000
"""Maximum number of tensors in a file."""
MOST_UNPACKED = 32 * 2**20
"""Maximum bytes of unpacked arrays, or :data:`MOST_RATIO` times the bytes of the file if that is more."""
MOST_RATIO = 100


def most_bytes() -> int:
    """:data:`MOST_BYTES`, or the value of the environment variable.

    Raises:
        UserError: if the value is not a number of bytes.
    """
    text = os.environ.get(VARIABLE, "")
    require(not text or (text.isdecimal() and len(text) < 20), VARIABLE, "a number of bytes", repr(short(text)))
    return int(text) if text else MOST_BYTES


def raised(most: int) -> int:
    """Scale a limit by the user's file-size factor."""
    return int(most * max(1, most_bytes() / MOST_BYTES))


def check_readable(path: str | Path, kind: str, most: int | None = None) -> int:
    """Refuse anything but a regular file of bounded size, and return its size in bytes. It is not opened: a pipe would block.

    Args:
        path: path of the file.
        kind: expected kind, for messages.
        most: maximum bytes; ``None`` for the limit of a file of tensors.

    Raises:
        UserError: naming the file.
    """
    place = short(str(path), 150)
    try:
        status = Path(path).stat()
    except (OSError, ValueError) as error:
        raise UserError(f"{place}: expected a {kind} file, found {_reason(error)}") from error
    require(stat.S_ISREG(status.st_mode), place, f"a {kind} file", f"a {_kind(status.st_mode)}")
    limit = most_bytes() if most is None else most
    advice = f"; if it is honest, set {VARIABLE} to more" if most is None else ""
    require(status.st_size <= limit, place, f"a {kind} file of at most {limit} bytes", f"{status.st_size}{advice}")
    return status.st_size


def _reason(error: OSError | ValueError) -> str:
    return "nothing" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or str(error)


def _kind(mode: int) -> str:
    return "folder" if stat.S_ISDIR(mode) else "file" if stat.S_ISREG(mode) else "device, pipe or socket"


def check_unpacked(size: int, packed: int, what: str) -> None:
    """Refuse compressed content of ``packed`` bytes whose unpacked ``size`` is far above that of honest content.

    Raises:
        UserError: naming the content (``what``) and both sizes.
    """
    most = min(raised(max(MOST_UNPACKED, MOST_RATIO * packed)), most_bytes())
    require(size <= most, what, f"at most {most} bytes in a file of {packed}", f"{size}; save it without compression")


def read_text(path: str | Path, kind: str, most: int = MOST_TEXT, encoding: str = "utf-8") -> str:
    """Read a text file, without a byte order mark.

    Raises:
        UserError: naming the file, as :func:`check_readable`, or if it cannot be read or is in another encoding.
    """
    check_readable(path, kind, most)
    try:
        return Path(path).read_text(encoding=encoding).removeprefix(codecs.BOM_UTF8.decode(encoding))
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: expected a {kind} file in {encoding}, found other bytes; save it as UTF-8") from error
    except OSError as error:
        raise UserError(f"{path}: expected a {kind} file, found one that cannot be read ({error.strerror})") from error


def check_writable_file(path: str | Path, key: str = "") -> None:
    """As :func:`check_file`, and refuse an invalid name or an unwritable place.

    The place is tested by an unnamed file in the nearest existing folder, before long work.
    """
    check_file(path, key)
    _check_place(Path(path).absolute().parent, Path(path), key)


def check_writable_folder(path: str | Path, key: str = "") -> None:
    """As :func:`check_writable_file`, for a folder."""
    check_file(path, key, "folder")
    _check_place(Path(path).absolute(), Path(path), key)


def check_new_folder(path: str | Path, key: str = "") -> None:
    """As :func:`check_writable_folder`, and refuse a folder that is not empty.

    Raises:
        UserError: naming the path.
    """
    check_writable_folder(path, key)
    empty = not Path(path).is_dir() or not any(Path(path).iterdir())
    require(empty, _named(path, key), "an empty folder or nothing there", "one with files; choose another name")


def _named(path: str | Path, key: str) -> str:
    return short(f"{key}: {path}" if key else str(path), 150)


def check_file(path: str | Path, key: str = "", kind: str = "file") -> None:
    """Refuse an existing path of another kind, such as a device, a pipe, a socket, or a link to any of them.

    Args:
        path: path to write.
        key: option that names the path; empty for none.
        kind: ``'file'`` or ``'folder'``.

    Raises:
        UserError: naming the path.
    """
    try:
        actual = _kind(Path(path).stat().st_mode)
    except FileNotFoundError:
        return  # nothing, or a link to nothing, whose target is made
    except (OSError, ValueError) as error:
        raise UserError(f"{_named(path, key)}: cannot be written ({_reason(error)}); choose another place") from error
    require(actual == kind, _named(path, key), f"a {kind} or nothing there", f"a {actual}; choose another name")


def _check_place(folder: Path, path: Path, key: str) -> None:
    there = next(parent for parent in (folder, *folder.parents) if parent.exists())
    try:
        longest = os.pathconf(there, "PC_NAME_MAX")
        for part in path.absolute().relative_to(there).parts:
            if len(os.fsencode(part)) > longest:
                raise OSError(f"a name of {len(os.fsencode(part))} bytes, more than {longest}")
        with tempfile.TemporaryFile(dir=there):
            pass
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError) and not there.exists():  # another process has just removed it
            return _check_place(folder, path, key)
        message = getattr(error, "strerror", None) or error
        raise UserError(f"{_named(path, key)}: cannot be written ({message}); choose a writable place with room") from error


Kind = Literal["file", "folder", "minari", "lerobot"]
"""Kind of demonstrations: a file, a folder of files, a Minari data set, or a folder that is a LeRobot data set."""
MINARI = re.compile(r"[\w./-]+-v\d+")
"""Pattern of names of Minari data sets."""
INFO = Path("meta") / "info.json"
"""File that marks a folder as a LeRobot data set."""
FILES = (".npz", ".safetensors", ".npy", ".json", ".mat", ".h5", ".hdf5", ".pt", ".pth", ".csv", ".parquet")
"""Suffixes of files of demonstrations."""


def read_from(name: str) -> tuple[Kind, str]:
    """Resolve a name of demonstrations to read: their kind, and the name of the data set, the folder or the file.

    Args:
        name: ``'minari:NAME'``, ``'lerobot:FOLDER'``, a folder (of a LeRobot data set if it has :data:`INFO`), the name of a Minari
            data set unless a file has it, or a file.
    """
    kind, rest = written_to(name)
    if kind != "file" or Path(name).suffix in FILES:
        return kind, rest
    try:
        if (Path(name) / INFO).is_file():
            return "lerobot", name
        if Path(name).is_dir():
            return "folder", name
        exists = Path(name).exists()
    except (OSError, ValueError):  # an invalid path, reported when it is opened
        return "file", name
    return ("minari" if MINARI.fullmatch(name) and not exists else "file"), name


def written_to(name: str) -> tuple[Kind, str]:
    """Resolve a name of demonstrations to write by its prefix alone: ``'minari:NAME'``, ``'lerobot:FOLDER'``, or a file."""
    kind, colon, rest = name.partition(":")
    return (("minari" if kind == "minari" else "lerobot"), rest) if colon and kind in ("minari", "lerobot") else ("file", name)
