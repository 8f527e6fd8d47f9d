"""Estimated cost of a grid, from completed cells."""

import heapq
from collections.abc import Callable, Mapping, Sequence
from statistics import mean

from ftl_lightning.apps.ablation.plan import Cell
from ftl_lightning.apps.ablation.record import Entry, without_seed

MINUTE, HOUR = 60.0, 3600.0


def seconds_of(cell: Cell, entries: Mapping[str, Entry]) -> float | None:
    """Duration of a cell: its measured duration, or else the mean over similar cells.

    Similar cells are, in order: the same cell with other seeds; cells of the same configuration files with other options.

    Returns:
        Seconds; ``None`` without measurements.
    """
    measured = {name: entry for name, entry in entries.items() if entry.seconds}
    if cell.name in measured:
        return measured[cell.name].seconds
    nearest: tuple[Callable[[str, Entry], bool], ...] = (
        lambda name, entry: without_seed(name) == without_seed(cell.name),
        lambda name, entry: entry.configs == cell.configs and name.startswith(f"{cell.verb} "),
    )
    for alike in nearest:
        if seconds := [entry.seconds for name, entry in measured.items() if alike(name, entry)]:
            return mean(seconds)
    return None


def makespan(seconds: Sequence[Sequence[float]], workers: int) -> float:
    """Total seconds of consecutive stages, when the next cell goes to the first free worker.

    Args:
        seconds: durations of the cells of each stage, in order.
        workers: number of parallel cells.
    """
    total = 0.0
    for stage in seconds:
        free = [0.0] * workers
        for duration in stage:
            heapq.heapreplace(free, free[0] + duration)
        total += max(free)
    return total


def estimate(plan: Sequence[Sequence[Cell]], entries: Mapping[str, Entry], total: int, workers: int = 0) -> list[str]:
    """Lines with the number of cells to run and the estimated hours, if known.

    Args:
        plan: the cells to run of each stage.
        entries: entries of the record.
        total: number of cells of the whole plan.
        workers: number of parallel cells; 0 for 1, 2, 4, 8 and so on, up to the number of cells.
    """
    cells = [cell for stage in plan for cell in stage]
    lines = [f"{total} cells: {total - len(cells)} need not be run, {len(cells)} to run"]
    if not cells:
        return lines
    times = [[seconds_of(cell, entries) for cell in stage] for stage in plan]
    known = [[time for time in stage if time is not None] for stage in times]
    count = sum(map(len, known))
    repeated = sum(entries[cell.name].seconds > 0 for cell in cells if cell.name in entries)
    if not count:
        return [*lines, "hours: not known, as no cell like them was measured; run one, for example with --shard, and ask again"]
    if count < len(cells):
        names = [cell.name for cell, time in zip(cells, (time for stage in times for time in stage), strict=True) if time is None]
        lines.append(f"not known: {len(names)} of them, none like which was measured, such as {names[0]}; their time comes on top")
    lines.append(f"measured: {repeated} of them before, {count - repeated} estimated from other seeds or options of the same files")
    counts = [workers] if workers else [2**power for power in range((len(cells) - 1).bit_length() + 1)]
    lines += [f"{number} at a time: {_time(makespan(known, number))}" for number in counts]
    return lines


def _time(seconds: float) -> str:
    """Format a time in hours, minutes or seconds."""
    if seconds >= HOUR:
        return f"{seconds / HOUR:.1f} hours"
    return f"{seconds / MINUTE:.0f} minutes" if seconds >= 2 * MINUTE else f"{seconds:.0f} seconds"
