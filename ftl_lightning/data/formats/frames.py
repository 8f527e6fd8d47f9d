"""Frames of episodes in a table: their order, faults of their times, and changes of the task."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

SAME_RATE = 0.01
"""Relative difference between rates that is rounding."""
SAME_TIME = 1e-4
"""Difference in seconds between times that is rounding, as in LeRobot."""
MOST_SHOWN = 8
"""Maximum number of episodes in a note."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Frames:
    """Columns of the frames of all episodes, each ``(frame,)``.

    Attributes:
        episode, task: numbers of the episode and of the task.
        number: number of the frame in its episode, from 0; ``None`` if not stored.
        seconds: time in its episode; ``None`` if not stored.
    """

    episode: NDArray[np.int64]
    task: NDArray[np.int64]
    number: NDArray[np.int64] | None = None
    seconds: NDArray[np.float64] | None = None

    def order(self) -> NDArray[np.int64]:
        """Rows ``(frame,)`` sorted by episode, then number, then time; equal ones keep their order."""
        keys = [key for key in (self.seconds, self.number) if key is not None]
        return np.lexsort((*keys, self.episode))

    def rows(self, order: NDArray[np.int64]) -> "Frames":
        """Frames in another order."""
        number = None if self.number is None else self.number[order]
        seconds = None if self.seconds is None else self.seconds[order]
        return Frames(self.episode[order], self.task[order], number, seconds)

    def segments(self) -> list[tuple[int, int]]:
        """First frame and end of each part of an episode with a single task, of sorted frames."""
        ends = [0, *(np.flatnonzero(~self._within | (np.diff(self.task) != 0)) + 1).tolist(), len(self.episode)]
        return list(pairwise(ends))

    @property
    def _within(self) -> Flags:
        """Whether the steps ``(frame - 1,)`` stay in an episode."""
        return np.diff(self.episode) == 0

    def notes(self, order: NDArray[np.int64], fps: float | None) -> Iterator[str]:
        """Describe the faults of sorted frames, by kind, with the numbers of the episodes.

        Args:
            order: rows of these frames before they were sorted.
            fps: frames per second, as stated; ``None`` if unknown.
        """
        within = self._within
        sorted_by = "timestamp" if self.number is None else "frame_index"
        yield from self._note(f"frames in another order than {sorted_by!r}; sorted", (np.diff(order) < 0) & within)
        steps = np.ones(len(within)) if self.number is None else np.diff(self.number.astype(np.float64))
        if self.number is not None:
            first = np.append(True, ~within) & (self.number != 0)
            yield from self._note("several frames of the same 'frame_index'", (steps == 0) & within)
            yield from self._note("gaps in 'frame_index'; frames are missing", first | np.append(False, (steps > 1) & within))
        if self.seconds is not None:
            yield from self._note("'timestamp' that is not finite", ~np.isfinite(self.seconds))
            with np.errstate(invalid="ignore"):
                passed = np.diff(self.seconds)
            valid = within & np.isfinite(passed) & (steps > 0)
            yield from self._note("'timestamp' that does not increase", valid & (passed <= 0))
            if fps is not None:
                yield from self._rate_notes(passed / np.maximum(steps, 1), valid & (passed > 0), fps)
        yield from self._note("several tasks; each is a demonstration", (np.diff(self.task) != 0) & within)

    def _rate_notes(self, periods: NDArray[np.float64], valid: Flags, fps: float) -> Iterator[str]:
        """Compare the seconds of each frame ``(frame - 1,)`` with the rate; other steps than ``valid`` are ignored."""
        assert self.seconds is not None
        periods, episodes = periods[valid], self.episode[1:][valid]
        rounding = 4 * np.finfo(np.float32).eps * np.abs(self.seconds[1:][valid]) + min(SAME_TIME, 0.1 / fps)
        uneven = np.abs(periods - 1 / fps) > SAME_RATE / fps + rounding
        if not uneven.any():
            return
        numbers, starts, counts = np.unique(episodes, return_index=True, return_counts=True)
        medians = periods[np.lexsort((periods, episodes))][starts + counts // 2]
        other = np.abs(medians * fps - 1) > SAME_RATE + SAME_TIME * fps
        if other.any():
            actual = f"{1 / medians[other][0]:.4g} frames a second by 'timestamp', not {fps:g} as in info.json"
            yield f"{_listed(numbers[other])}: {actual}"
        uneven &= ~np.repeat(other, counts)
        if uneven.any():
            yield f"{_listed(np.unique(episodes[uneven]))}: 'timestamp' with uneven steps"

    def _note(self, fault: str, where: Flags) -> Iterator[str]:
        """Note on a fault of frames ``(frame,)`` or steps ``(frame - 1,)``; none without any."""
        if where.any():
            yield f"{_listed(np.unique(self.episode[-len(where) :][where]))}: {fault}"


def _listed(episodes: NDArray[np.int64]) -> str:
    numbers = ", ".join(map(str, episodes[:MOST_SHOWN].tolist()))
    more = f" and {len(episodes) - MOST_SHOWN} others" if len(episodes) > MOST_SHOWN else ""
    return f"episode{'s' if len(episodes) > 1 else ''} {numbers}{more}"
