"""What a grid will cost, from cells that ended before."""

import heapq
from collections.abc import Callable, Mapping, Sequence
from statistics import mean

from ftl_lightning.ablation.plan import Cell
from ftl_lightning.ablation.record import Entry, without_seed

MINUTE, HOUR = 60.0, 3600.0


def seconds_of(cell: Cell, entries: Mapping[str, Entry]) -> float | None:
    """How long a cell takes: the mean of what was measured of it, or else of the nearest others.

    These are, in order: the same cell with other seeds; cells of the same configuration files, whose options differ.

    Returns:
        Seconds; ``None`` where neither was measured.
    """
    measured = {name: entry for name, entry in entries.items() if entry.seconds}
    if cell.name in measured:
        return measured[cell.name].seconds
    nearest: tuple[Callable[[str, Entry], bool], ...] = (
        lambda name, entry: without_seed(name) == without_seed(cell.name),
        lambda name, entry: entry.configs == cell.configs and name.startswith(f"{cell.verb} "),
    )
    for alike in nearest:
        if found := [entry.seconds for name, entry in measured.items() if alike(name, entry)]:
            return mean(found)
    return None


def makespan(seconds: Sequence[Sequence[float]], workers: int) -> float:
    """Seconds from start to end of stages, one after another, when each next cell goes to the first worker that is free.

    Args:
        seconds: of the cells of each stage, in order.
        workers: cells that run side by side.
    """
    total = 0.0
    for stage in seconds:
        free = [0.0] * workers
        for one in stage:
            heapq.heapreplace(free, free[0] + one)
        total += max(free)
    return total


def estimate(plan: Sequence[Sequence[Cell]], entries: Mapping[str, Entry], total: int, workers: int = 0) -> list[str]:
    """Lines that say how many cells are to be run, and for how many hours, as far as that was measured.

    Args:
        plan: the cells of each stage that are to be run.
        entries: of the record.
        total: cells of the whole plan.
        workers: cells that run side by side; 0 for 1, 2, 4, 8 and so on, up to the number of cells.
    """
    cells = [cell for stage in plan for cell in stage]
    lines = [f"{total} cells: {total - len(cells)} need not be run, {len(cells)} to run"]
    if not cells:
        return lines
    found = [[seconds_of(cell, entries) for cell in stage] for stage in plan]
    known = [[one for one in stage if one is not None] for stage in found]
    count = sum(map(len, known))
    itself = sum(entries[cell.name].seconds > 0 for cell in cells if cell.name in entries)
    if not count:
        return [*lines, "hours: not known, as no cell like them was measured; run one, for example with --shard, and ask again"]
    if count < len(cells):
        names = [cell.name for cell, one in zip(cells, (one for stage in found for one in stage), strict=True) if one is None]
        lines.append(f"not known: {len(names)} of them, none like which was measured, such as {names[0]}; their time comes on top")
    lines.append(f"measured: {itself} of them before, {count - itself} estimated from other seeds or options of the same files")
    counts = [workers] if workers else [2**power for power in range((len(cells) - 1).bit_length() + 1)]
    lines += [f"{number} at a time: {_told(makespan(known, number))}" for number in counts]
    return lines


def _told(seconds: float) -> str:
    """A time in the unit that it has a few of."""
    if seconds >= HOUR:
        return f"{seconds / HOUR:.1f} hours"
    return f"{seconds / MINUTE:.0f} minutes" if seconds >= 2 * MINUTE else f"{seconds:.0f} seconds"
