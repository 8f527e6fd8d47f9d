"""The log folder of a run, which no other run has at the same time, in whatever process or however close they start."""

import contextvars
import fcntl
import itertools
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from ftl_lightning.errors import UserError
from ftl_lightning.targets import expect_writable_folder

LOCK = ".running"
"""File in the folder of a run that goes on, locked by it."""


@dataclass
class _Run:
    """What a run holds, and whether it has begun to learn."""

    held: ExitStack = field(default_factory=ExitStack)
    learns: bool = False


_run: contextvars.ContextVar[_Run | None] = contextvars.ContextVar("run", default=None)


@contextmanager
def run() -> Iterator[None]:
    """Within the block, folders that are claimed stay the run's own.

    At its end those are removed that were made for it and that nothing was written to; all of them, if it was refused before it
    learned anything.
    """
    own = _Run()
    token = _run.set(own)
    with own.held:
        try:
            yield
            own.learns = True
        finally:
            _run.reset(token)


def keep() -> None:
    """What this run writes is worth keeping, however it ends: it learns."""
    if (own := _run.get()) is not None:
        own.learns = True


def claim(parent: Path, name: str, new: bool) -> str:
    """Make a folder and hold it until the end of the run.

    Args:
        parent: folder of the folder.
        name: of it.
        new: whether one that is there is taken, even if no run holds it.

    Returns:
        The name, or with the smallest number after it that is free: ``invert``, ``invert_1``, ``invert_2``.

    Raises:
        UserError: where no folder can be made.
    """
    return next(found for found in _numbered(name) if _claimed(parent / found, new))


def hold(folder: Path) -> None:
    """Hold a folder that a run goes on in.

    Raises:
        UserError: if another run holds it.
    """
    if not _claimed(folder, new=False):
        raise UserError(
            f"{folder}: expected the log folder of a run that has ended, found that of one that goes on; wait for its end"
        )


def _numbered(name: str) -> Iterator[str]:
    return (f"{name}_{number}" if number else name for number in itertools.count())


def _claimed(folder: Path, new: bool) -> bool:
    """Whether the folder is this run's from now on."""
    own, lock = _run.get(), folder / LOCK
    expect_writable_folder(folder)
    while True:
        missing = [one for one in (folder, *folder.parents) if not one.exists()]
        try:
            try:
                folder.mkdir(parents=True)
            except FileExistsError:  # a folder, which was looked at above; whoever made it, this run did not and never removes it
                if new:
                    return False
                missing = []
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # a run that ended has just removed a folder above it
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return False
        if not os.fstat(handle).st_nlink:  # of a run that has just ended
            os.close(handle)
            continue
        if own is None:  # nobody says when the run ends
            _end(_Run(learns=True), lock, handle, [])
        else:
            own.held.callback(_end, own, lock, handle, missing)
        return True


def _end(own: _Run, lock: Path, handle: int, made: list[Path]) -> None:
    """Let go of a folder. Of those that were made for it, the innermost first, the empty ones are removed."""
    if lock.parent in made and not own.learns:
        shutil.rmtree(lock.parent, ignore_errors=True)
    lock.unlink(missing_ok=True)
    os.close(handle)
    for folder in made:
        with suppress(OSError):
            folder.rmdir()
