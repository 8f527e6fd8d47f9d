"""What may be written to: looked at before any work, and once more when it is written."""

import stat
from pathlib import Path

from ftl_lightning.errors import UserError


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


def _expect(path: str | Path, key: str, kind: str) -> None:
    name = f"{key}: {path}" if key else str(path)
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError:
        return  # nothing, or a link to nothing, whose target is made
    except (OSError, ValueError) as error:
        raise UserError(f"{name}: cannot be written ({getattr(error, 'strerror', error)}); choose another place") from error
    found = "folder" if stat.S_ISDIR(mode) else "file" if stat.S_ISREG(mode) else "device, pipe or socket"
    if found != kind:
        raise UserError(f"{name}: expected a {kind} or nothing there, found a {found}; choose another name")
