"""Progress of what takes long: one bar that moves in a terminal, a few plain lines elsewhere. Both go to standard error."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from ftl_lightning.printing import plain, say

if TYPE_CHECKING:
    from rich.progress import Progress

LINES = 10
"""Lines from start to end where there is no terminal."""


class Advance(Protocol):
    """Tells a bar that work was done."""

    def __call__(self, steps: int = 1, told: str = "") -> None:
        """Move on by some steps; ``told`` stands beside the bar, such as a loss, and stays until it is told anew."""


@dataclass
class _Screen:
    """What all bars share: in a terminal one display, whose last bar is the innermost; and how many bars there are."""

    depth: int = 0
    display: "Progress | None" = None


_SCREEN = _Screen()


@contextmanager
def bar(title: str, total: int | None, done: int = 0, lines: bool = True) -> Iterator[Advance]:
    """Show how far something is, alone or inside of another bar, which goes on moving.

    In a terminal the bar disappears at the end, and an outermost one leaves a line. Elsewhere an outermost bar writes lines: at
    the start, after each tenth, and at the end; what runs inside of it writes none.

    Args:
        title: what is done.
        total: steps that it takes; ``None`` where nobody knows.
        done: steps that were done before.
        lines: whether there are lines; without them the bar is seen in a terminal alone.

    Yields:
        What to call after each step.
    """
    own = _Bar(plain(title), total, done, lines and _SCREEN.depth == 0)
    opened = _SCREEN.display is None and sys.stderr.isatty()
    if opened:
        _SCREEN.display = _display()
        _SCREEN.display.start()
    _SCREEN.depth += 1
    own.show()
    ended = False
    try:
        yield own.advance
        ended = True
    finally:
        _SCREEN.depth -= 1
        own.hide()
        if opened and _SCREEN.display is not None:
            _SCREEN.display.stop()
            _SCREEN.display = None
        if ended:
            own.end()


def _display() -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[steps]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[told]}", markup=False),
        console=Console(stderr=True, soft_wrap=True),  # paths that are printed stay in one line
        transient=True,
        # Standard output may be a file, where what is printed has to go, not to the terminal.
        redirect_stdout=sys.stdout.isatty(),
    )


@dataclass
class _Bar:
    """One bar, or the lines in its place."""

    title: str
    total: int | None
    done: int
    lines: bool
    told: str = ""
    start: float = field(default_factory=time.monotonic)
    first: int = 0
    task: int | None = None

    def show(self) -> None:
        self.first = self.done
        if _SCREEN.display is not None:
            self.task = _SCREEN.display.add_task(self.title, total=self.total, completed=self.done, steps=self._steps(), told="")
        elif self.lines:
            self._write(f"{self.title}: {self._steps()}" if self.total else self.title)

    def advance(self, steps: int = 1, told: str = "") -> None:
        before, self.done = self.done, self.done + steps
        self.told = plain(told) or self.told
        if _SCREEN.display is not None and self.task is not None:
            _SCREEN.display.update(self.task, advance=steps, steps=self._steps(), told=self.told)  # type: ignore[arg-type]
        elif self.lines and self.total and LINES * before // self.total < LINES * self.done // self.total < LINES:
            self._write(f"{self.title}: {self._steps()}, {self._time()}{self._told()}")

    def hide(self) -> None:
        if _SCREEN.display is not None and self.task is not None:
            _SCREEN.display.remove_task(self.task)  # type: ignore[arg-type]

    def end(self) -> None:
        if self.lines:
            steps = f"{self.done - self.first} steps, " if self.total else ""
            self._write(f"{self.title}: {steps}{self._time()}{self._told()}")

    def _steps(self) -> str:
        return f"{self.done}/{self.total}" if self.total else ""

    def _time(self) -> str:
        seconds = round(time.monotonic() - self.start)
        return f"{seconds // 60}:{seconds % 60:02d}"

    def _told(self) -> str:
        return f", {self.told}" if self.told else ""

    @staticmethod
    def _write(line: str) -> None:
        say(line, error=True)
