"""Progress of long work on standard error: a moving bar in a terminal, a few plain lines elsewhere."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from ftl_lightning.services.text import plain, say

if TYPE_CHECKING:
    from rich.progress import Progress

LINES = 10
"""Number of lines of a bar without a terminal."""


WAIT = 1.0
"""Seconds between two signs of :func:`waiting`."""


@contextmanager
def waiting(title: str) -> Iterator[None]:
    """Show in a terminal that work goes on which reports nothing, such as imports, by its seconds; the line disappears."""
    if not sys.stderr.isatty():
        yield
        return
    ended, begin = threading.Event(), time.monotonic()

    def show() -> None:
        while not ended.wait(WAIT):
            sys.stderr.write(f"\r{title}, {time.monotonic() - begin:.0f} s")
            sys.stderr.flush()

    shown = threading.Thread(target=show, daemon=True)
    shown.start()
    try:
        yield
    finally:
        ended.set()
        shown.join()
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()


class Advance(Protocol):
    """Move a bar on by some steps. The ``note`` beside it, such as a loss, stays until it is replaced."""

    def __call__(self, steps: int = 1, note: str = "") -> None: ...


@dataclass
class _Screen:
    """State of all bars: the number of open bars, and in a terminal their display, innermost bar last."""

    depth: int = 0
    display: "Progress | None" = None


_SCREEN = _Screen()


@contextmanager
def bar(title: str, total: int | None, done: int = 0, lines: bool = True) -> Iterator[Advance]:
    """Show the progress of work, alone or inside another bar; yield the function to call after each step.

    In a terminal the bar disappears at the end, and an outermost bar leaves a line. Elsewhere an outermost bar writes lines: at the
    start, after each tenth, and at the end; inner bars write none.

    Args:
        title: name of the work.
        total: number of steps; ``None`` if unknown.
        done: number of steps done before.
        lines: whether to write lines; otherwise the bar is visible only in a terminal.
    """
    current = _Bar(plain(title), total, done, lines and _SCREEN.depth == 0)
    opened = _SCREEN.display is None and sys.stderr.isatty()
    if opened:
        _SCREEN.display = _display()
        _SCREEN.display.start()
    _SCREEN.depth += 1
    current.show()
    ended = False
    try:
        yield current.advance
        ended = True
    finally:
        _SCREEN.depth -= 1
        current.hide()
        if opened and _SCREEN.display is not None:
            _SCREEN.display.stop()
            _SCREEN.display = None
        if ended:
            current.end()


def _display() -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[steps]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=Console(stderr=True, soft_wrap=True),  # no line breaks in printed paths
        transient=True,
        # If standard output is a file, printed text must go there, not to the terminal.
        redirect_stdout=sys.stdout.isatty(),
    )


@dataclass
class _Bar:
    """A bar, or the lines in its place."""

    title: str
    total: int | None
    done: int
    lines: bool
    note: str = ""
    start: float = field(default_factory=time.monotonic)
    first: int = 0
    task: int | None = None

    def show(self) -> None:
        self.first = self.done
        if _SCREEN.display is not None:
            # rich stops the clock of a bar that is full, while work goes on.
            total = None if self.total is None else self.total + 1e-3
            self.task = _SCREEN.display.add_task(self.title, total=total, completed=self.done, steps=self._steps(), note="")
        elif self.lines:
            say(f"{self.title}: {self._steps()}" if self.total else self.title, error=True)

    def advance(self, steps: int = 1, note: str = "") -> None:
        before, self.done = self.done, self.done + steps
        self.note = plain(note) or self.note
        if self.total and self.done > self.total:  # the end is unknown from now on
            self.total = 0
        if _SCREEN.display is not None and self.task is not None:
            longer = 2 * self.done if self.total == 0 else None
            _SCREEN.display.update(self.task, advance=steps, total=longer, steps=self._steps(), note=self.note)  # type: ignore[arg-type]
        elif self.lines and self.total and LINES * before // self.total < LINES * self.done // self.total < LINES:
            say(f"{self.title}: {self._steps()}, {self._time()}", error=True)

    def hide(self) -> None:
        if _SCREEN.display is not None and self.task is not None:
            _SCREEN.display.remove_task(self.task)  # type: ignore[arg-type]

    def end(self) -> None:
        if self.lines:
            count = self.done - self.first
            steps = "" if self.total is None else f"{count} step{'' if count == 1 else 's'}, "
            say(f"{self.title}: {steps}{self._time()}", error=True)

    def _steps(self) -> str:
        return f"{self.done}/{self.total}" if self.total else f"{self.done}" if self.done else ""

    def _time(self) -> str:
        """Elapsed time, and the text of the last step."""
        seconds = round(time.monotonic() - self.start)
        return f"{seconds // 60}:{seconds % 60:02d}{self.note and f', {self.note}'}"
