"""Log folders of runs, never shared by two runs, in whatever processes and however close they start."""

import contextvars
import fcntl
import itertools
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from ftl_lightning.services.errors import require
from ftl_lightning.services.files import check_writable_folder

LOCK = ".running"
"""File in the folder of an active run, which locks it."""


@dataclass
class _Run:
    """Folders of a run, and whether it has begun to learn."""

    folders: ExitStack = field(default_factory=ExitStack)
    learns: bool = False


_run: contextvars.ContextVar[_Run | None] = contextvars.ContextVar("run", default=None)


@contextmanager
def run() -> Iterator[None]:
    """Hold folders that are claimed within the block.

    At its end, empty folders made for the run are removed. If the run was refused before it learned anything, all of them are, and
    new files in the folder of an earlier run.
    """
    current = _Run()
    token = _run.set(current)
    with current.folders:
        try:
            yield
            current.learns = True
        finally:
            _run.reset(token)


def keep() -> None:
    """Keep the files of this run however it ends, since it learns."""
    if (current := _run.get()) is not None:
        current.learns = True


def claim(parent: Path, name: str, new: bool) -> str:
    """Make a folder and hold it until the end of the run.

    Args:
        parent: parent folder.
        name: name of the folder.
        new: whether an existing folder counts as taken, even if no run holds it.

    Returns:
        The name, or the name with the smallest free number: ``invert``, ``invert_1``, ``invert_2``.

    Raises:
        UserError: if no folder can be made.
    """
    numbered = (f"{name}_{number}" if number else name for number in itertools.count())
    return next(candidate for candidate in numbered if _claimed(parent / candidate, new))


def hold(folder: Path) -> None:
    """Hold the folder of a run that is continued.

    Raises:
        UserError: if another run holds it.
    """
    free = _claimed(folder, new=False)
    require(free, str(folder), "the log folder of a run that has ended", "that of a run that goes on; wait for its end")


def _claimed(folder: Path, new: bool) -> bool:
    """Claim a folder for this run; return whether it was free."""
    current, lock = _run.get(), folder / LOCK
    check_writable_folder(folder)
    while True:
        missing = [path for path in (folder, *folder.parents) if not path.exists()]
        try:
            try:
                folder.mkdir(parents=True)
            except FileExistsError:  # a folder, as checked above, which this run never removes
                if new:
                    return False
                missing = []
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # a run that ended has just removed a parent folder
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return False
        if not os.fstat(handle).st_nlink:  # removed by a run that has just ended
            os.close(handle)
            continue
        if current is None:  # outside of a run, nothing marks its end
            _end(_Run(learns=True), lock, handle, [], set())
        else:
            current.folders.callback(_end, current, lock, handle, missing, set(folder.rglob("*")))
        return True


def _end(ended: _Run, lock: Path, handle: int, made: list[Path], before: set[Path]) -> None:
    """Release a folder, and remove the empty folders that were made for it, innermost first."""
    if lock.parent in made and not ended.learns:
        shutil.rmtree(lock.parent, ignore_errors=True)
    elif not ended.learns:
        for path in sorted(set(lock.parent.rglob("*")) - before, reverse=True):  # the content of a folder before the folder
            with suppress(OSError):
                path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    lock.unlink(missing_ok=True)
    os.close(handle)
    for folder in made:
        with suppress(OSError):
            folder.rmdir()
