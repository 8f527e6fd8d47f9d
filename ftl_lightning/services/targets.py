"""Checks of output paths, before any work and again before writing."""

import os
import stat
import tempfile
from pathlib import Path

from ftl_lightning.services.errors import UserError, short


def check_file(path: str | Path, key: str = "") -> None:
    """Refuse an existing path that is no regular file: a folder, a device, a pipe, a socket, or a link to one.

    Args:
        path: file to write.
        key: option that names the path; empty for none.

    Raises:
        UserError: naming the path.
    """
    _expect(path, key, "file")


def check_folder(path: str | Path, key: str = "") -> None:
    """Refuse an existing path that is no folder, as :func:`check_file`."""
    _expect(path, key, "folder")


def check_writable_file(path: str | Path, key: str = "") -> None:
    """As :func:`check_file`, and refuse an invalid name or an unwritable place.

    The place is tested by an unnamed file in the nearest existing folder, before long work.
    """
    check_file(path, key)
    _expect_place(Path(path).absolute().parent, Path(path), key)


def check_new_folder(path: str | Path, key: str = "") -> None:
    """As :func:`check_folder`, and refuse a folder that is not empty.

    Raises:
        UserError: naming the path and its key.
    """
    check_folder(path, key)
    if Path(path).is_dir() and any(Path(path).iterdir()):
        name = short(f"{key}: {path}" if key else str(path), 150)
        raise UserError(f"{name}: expected an empty folder or nothing there, found one with files; choose another name")


def check_writable_folder(path: str | Path, key: str = "") -> None:
    """As :func:`check_folder`, and refuse an invalid name or an unwritable place."""
    check_folder(path, key)
    _expect_place(Path(path).absolute(), Path(path), key)


def _expect_place(folder: Path, path: Path, key: str) -> None:
    name = short(f"{key}: {path}" if key else str(path), 150)
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
            return _expect_place(folder, path, key)
        message = getattr(error, "strerror", None) or error
        raise UserError(f"{name}: cannot be written ({message}); choose a writable place with room") from error


def _expect(path: str | Path, key: str, kind: str) -> None:
    name = short(f"{key}: {path}" if key else str(path), 150)
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError:
        return  # nothing, or a link to nothing, whose target is made
    except (OSError, ValueError) as error:
        message = getattr(error, "strerror", None) or error
        raise UserError(f"{name}: cannot be written ({message}); choose another place") from error
    actual = "folder" if stat.S_ISDIR(mode) else "file" if stat.S_ISREG(mode) else "device, pipe or socket"
    if actual != kind:
        raise UserError(f"{name}: expected a {kind} or nothing there, found a {actual}; choose another name")
