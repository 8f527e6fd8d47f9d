"""What may be written to: looked at before any work, and once more when it is written."""

import os
import stat
import tempfile
from pathlib import Path

from ftl_lightning.errors import UserError, short


def expect_file(path: str | Path, key: str = "") -> None:
    """Refuse a target that is there and no regular file: a folder, a device, a pipe, a socket, or a link to one of them.

    Args:
        path: of a file to write.
        key: option that names it; empty for none.

    Raises:
        UserError: naming it.
    """
    _expect(path, key, "file")


def expect_folder(path: str | Path, key: str = "") -> None:
    """The same of a folder that files are to be written to."""
    _expect(path, key, "folder")


def expect_writable_file(path: str | Path, key: str = "") -> None:
    """As :func:`expect_file`, and refuse a place that nothing can be written to, or a name that it does not take.

    Tried before long work: a file without a name is made in the nearest folder that is there.
    """
    expect_file(path, key)
    _expect_place(Path(path).absolute().parent, Path(path), key)


def expect_new_folder(path: str | Path, key: str = "") -> None:
    """As :func:`expect_folder`, and refuse a folder that holds something.

    Raises:
        UserError: naming the path and its key.
    """
    expect_folder(path, key)
    if Path(path).is_dir() and any(Path(path).iterdir()):
        name = short(f"{key}: {path}" if key else str(path), 150)
        raise UserError(f"{name}: expected an empty folder or nothing there, found one with files; choose another name")


def expect_writable_folder(path: str | Path, key: str = "") -> None:
    """The same of a folder that files are to be written to."""
    expect_folder(path, key)
    _expect_place(Path(path).absolute(), Path(path), key)


def _expect_place(folder: Path, path: Path, key: str) -> None:
    name = short(f"{key}: {path}" if key else str(path), 150)
    there = next(one for one in (folder, *folder.parents) if one.exists())
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
        told = getattr(error, "strerror", None) or error
        raise UserError(f"{name}: cannot be written ({told}); choose a writable place with room") from error


def _expect(path: str | Path, key: str, kind: str) -> None:
    name = short(f"{key}: {path}" if key else str(path), 150)
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError:
        return  # nothing, or a link to nothing, whose target is made
    except (OSError, ValueError) as error:
        told = getattr(error, "strerror", None) or error
        raise UserError(f"{name}: cannot be written ({told}); choose another place") from error
    found = "folder" if stat.S_ISDIR(mode) else "file" if stat.S_ISREG(mode) else "device, pipe or socket"
    if found != kind:
        raise UserError(f"{name}: expected a {kind} or nothing there, found a {found}; choose another name")
