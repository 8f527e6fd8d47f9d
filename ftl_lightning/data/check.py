"""Check a few demonstrations for faults that show without a model: missing values, jumps, standstills, copies, outliers.

Thresholds were chosen on demonstrations of navigation, object rearrangement and driving, on pen strokes, noise and random walks: 99
of 100 sets of three to ten good demonstrations pass (97 in driving).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, in_sequence, paths_of, read_contents
from ftl_lightning.data.features import BLOCK
from ftl_lightning.data.kinds import LINEAR, Columns, resolved
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.text import counted

T = TypeVar("T")
MOST_NAMED = 6  # demonstrations to list individually
POINTS = 32  # number of even times at which demonstrations are compared
UNUSUAL = 3.0  # ratio to all other lengths that makes a length unusual
DISCRETE = 5  # maximum number of distinct values of a discrete column, which may jump
JUMP, JUMP_ALONE = 3.0, 10.0  # ratio of a jump to the largest other step, in several columns or a single; times 4 for few steps
WRAPPED = 0.8  # share of a column's range that a step covers where an angle wraps
STILL = 1e-3  # maximum step that counts as standing still, as a share of the usual step
FEW = 3  # minimum steps of a still stretch, and of the longest demonstration, for a fault
LONG = 0.4  # minimum share of a demonstration in a still stretch
SAME, ALIKE = 1e-6, 0.02  # distances of equal and nearly equal demonstrations, as shares of the usual distance
ENOUGH = 20  # minimum numbers of a demonstration for a near-copy to be no coincidence; minimum steps to compare with
UNITS = 10.0  # ratio of values that suggests other units
APART = {3: 25.0, 4: 12.0}  # ratio to the usual distance that makes an outlier, by the number of demonstrations
APART_PLACES, APART_SHAPES = 12.0, 4.0  # ratios for five and more: of states, and of their shapes regardless of place and size
CLOSEST = {3: 0.5}  # minimum usual distance, as a share of the others' spread, by the number of demonstrations; otherwise 0.1
SELDOM, PARTLY = 0.1, 0.5  # maximum shares of times at which others, and a demonstration, use a column that makes it no outlier
MOST_COMPARED = 50  # demonstrations, evenly taken, whose distances among them are usual for an outlier
MOST_CHECKED, MOST_LINES = 1000, 2  # demonstrations that are checked before pretraining, and lines of findings
MOST_WIDTH = 1000  # columns that are checked
LEAST_AXIS = 5  # more entries of an axis than this make it a possible time
SMOOTH_AXIS, EXCHANGED = 0.6, 3.0  # maximum roughness of an exchanged time axis, and minimum ratio of the other's to it
ROUGH_TIME = 0.9  # minimum roughness along what is no time
SMOOTH_ALONE = 0.45  # maximum roughness of a time axis that is exchanged with an axis of one entry
LEAST_SHIFTED, RECURS = (
    4,
    0.3,
)  # minimum number of states of a wave, and maximum share of them that does not follow from those before
ALIKE_CHANNELS, OTHERWISE = 0.75, 0.2  # minimum correlation of the series of a channel, and its difference from that of others
BEYOND = 1.5  # minimum ratio of an outlier's least distance to the others' largest, for five and more


@dataclass(frozen=True)
class Finding:
    """Finding of a check.

    Attributes:
        text: a sentence without a full stop, which follows the demonstrations' numbers if there are any.
        severity: ``'note'`` for information, ``'warning'`` for a likely fault, ``'error'`` for data that nothing can be learned
            from.
        rows: demonstrations, from 0; empty for all. Texts count from 1.
    """

    text: str
    severity: Literal["note", "warning", "error"] = "warning"
    rows: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{numbered(self.rows)}: {self.text}" if self.rows else self.text

    def among(self, rows: Sequence[int]) -> Self:
        """Map rows of a selection to all demonstrations; ``rows`` is the selection."""
        return replace(self, rows=tuple(rows[row] for row in self.rows))

    def within(self, rows: Sequence[int]) -> Self:
        """Invert :meth:`among`."""
        return replace(self, rows=tuple(rows.index(row) for row in self.rows))


def numbered(rows: Sequence[int]) -> str:
    """Demonstrations by their numbers from 1: ``'demonstration 3'``, ``'demonstrations 1, 2 and 5'``."""
    if len(rows) == 1:
        return f"demonstration {rows[0] + 1}"
    if len(rows) > MOST_NAMED:
        return f"{len(rows)} demonstrations ({', '.join(str(row + 1) for row in rows[:3])}, ...)"
    return f"demonstrations {', '.join(str(row + 1) for row in rows[:-1])} and {rows[-1] + 1}"


def mended(states: Tensor, lengths: Tensor) -> tuple[Tensor, tuple[Finding, ...]]:
    """Replace missing and non-finite numbers in states ``(demo, time, state)`` of any floating type with lengths ``(demo,)``.

    Returns:
        States, linearly interpolated between finite values of a column (0 without any), and findings about them.
    """
    missing = ~states.isfinite()
    findings, whole = [], states.clone()
    for row in missing.flatten(1).any(dim=1).nonzero()[:, 0].tolist():
        length = int(lengths[row])
        columns = missing[row].any(dim=0).nonzero()[:, 0].tolist()
        times = missing[row, :length].any(dim=1).nonzero()[:, 0]
        message = "its padding is not finite; pad with the last state"
        if len(times):
            message = f"{len(times)} of {length} time steps are not finite (the first is {int(times[0])})"
            message += f", in {counted(len(columns), 'column')}; nothing can be learned from them"
        findings.append(Finding(message, "error", (row,)))
        for column in columns:
            values = whole[row, :, column].numpy()
            finite = np.isfinite(values).nonzero()[0]
            values[:] = np.interp(np.arange(len(values)), finite, values[finite]) if len(finite) else 0
    return whole, tuple(findings)


def read_mended(path: str) -> tuple[Demonstrations, tuple[Finding, ...]]:
    """Read a file or data set with non-finite states mended, and findings about them; missing texts become the file's name.

    Raises:
        UserError: naming the file, for every other mistake in it.
    """
    contents = read_contents(path)
    findings: tuple[Finding, ...] = ()
    states, lengths = contents["states"], contents["lengths"]
    if states.dim() == 3 and states.is_floating_point() and lengths.shape == states.shape[:1]:
        contents["states"], findings = mended(states, lengths)
    with about(path):
        return Demonstrations(**contents).named(Path(path).stem), findings


def check(demonstrations: Demonstrations) -> tuple[Finding, ...]:
    """Check demonstrations as examples of a single concept, ignoring their texts; notes are last.

    A demonstration with a finding is excluded from later checks. At most :data:`MOST_CHECKED` demonstrations are checked. Axes are
    checked by :func:`axes`, for all concepts together.
    """
    if (count := len(demonstrations)) > MOST_CHECKED:
        part = Finding(f"the first {MOST_CHECKED} of {count} demonstrations are checked", "note")
        return (*check(demonstrations.rows(list(range(MOST_CHECKED)))), part)
    few = Finding("three to five demonstrations are usual; fewer do not show which of them is an outlier", "note")
    demonstrations, kinds = _continuous(demonstrations)
    findings = [*([few] if len(demonstrations) < 3 else []), *kinds]
    if (width := demonstrations.states.shape[2]) > MOST_WIDTH:
        findings.append(Finding(f"the first {MOST_WIDTH} of {width} columns are checked", "note"))
        names, units = demonstrations.state_names[:MOST_WIDTH], ("",) * MOST_WIDTH
        states = demonstrations.states[..., :MOST_WIDTH]
        demonstrations = replace(demonstrations, states=states, state_names=names, state_units=units, state_kinds=())
    findings += _constant(demonstrations)
    remaining = list(range(len(demonstrations)))
    for look in (_lengths, _stills, _units, _duplicates, _jumps, _outliers):
        reported = [finding.among(remaining) for finding in look(demonstrations.rows(remaining))]
        findings += reported
        faulty = {row for finding in reported for row in (finding.rows[1:] if look is _duplicates else finding.rows)}
        remaining = [row for row in remaining if row not in faulty] or remaining
    return tuple(sorted(findings, key=lambda finding: finding.severity == "note"))


def check_each(demonstrations: Demonstrations) -> list[str]:
    """Faults that :func:`check` finds in each concept, in at most :data:`MOST_LINES` lines.

    Of many demonstrations only the first are checked, :data:`MOST_CHECKED` in all.

    Args:
        demonstrations: of any number of concepts.
    """
    found = [str(finding) for finding in axes(demonstrations)]
    rows_of = demonstrations.rows_of
    each = max(MOST_CHECKED // len(rows_of), 3)
    for name, rows in list(rows_of.items())[:MOST_CHECKED] if not found else ():
        some = demonstrations.rows(rows[:each])
        found += [f"{short(name, 40)}: {finding}" for finding in check(some) if finding.severity != "note"]
    more = len(found) - MOST_LINES
    return found if more <= 0 else [*found[: MOST_LINES - 1], f"{more + 1} more; list them: python -m ftl_lightning check"]


def with_kinds(demonstrations: Demonstrations) -> tuple[Demonstrations, list[str]]:
    """Demonstrations with proposed kinds unless kinds are known, and notes on proposals. All concepts show what a column is."""
    names, kinds = demonstrations.state_names, demonstrations.state_kinds
    try:
        known = bool(kinds) and bool(Columns(kinds).groups)
    except UserError:
        known = False  # kinds of a file are not resolved
    if known:
        return demonstrations, []
    kinds = resolved(in_sequence(demonstrations), names, demonstrations.state_units, kinds or ("",) * len(names), "states")
    return replace(demonstrations, state_kinds=kinds or (LINEAR,) * len(names)), list(Columns(kinds).notes(names))


def axes(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Find a likely exchange of axes: states are much smoother along demonstrations or columns than along time, or the columns of a
    demonstration are as alike as demonstrations of a concept.
    """
    shape, states = tuple(demonstrations.states.shape), demonstrations.states.double()
    demo, time, column = (_roughness(states, axis) for axis in range(3))
    smooth = ((0, demo, (1, 0, 2)), (2, column, (0, 2, 1)))
    numbered = demonstrations.state_names == tuple(map(str, range(shape[2])))
    found, along = None, 0
    if shape[1] == 1:
        likely = [(order, axis) for axis, rough, order in smooth if shape[axis] > LEAST_AXIS and rough < SMOOTH_ALONE]
        found, along = likely[0] if likely and numbered else (None, 0)
    elif ROUGH_TIME < time < torch.inf:
        likely = [(order, axis) for axis, rough, order in smooth if shape[axis] > LEAST_AXIS and rough < SMOOTH_AXIS]
        rough = dict(enumerate((demo, time, column)))
        likely = [(order, axis) for order, axis in likely if time > EXCHANGED * rough[axis]]
        found, along = likely[0] if likely and not _recurs(states[:20, :50]) else (None, 0)
    elif numbered and len(set(demonstrations.concepts)) == 1 and column > ROUGH_TIME and _channels_first(states):
        found = (2, 1, 0)
    if found is not None:
        reason = f"smooth along axis {along}, not along time" if found != (2, 1, 0) else "alike along axis 2, as demonstrations are"
        suggested = f"(demo, time, column) of shape {tuple(shape[axis] for axis in found)}: transpose{found}"
        yield Finding(f"axes are likely exchanged: states {shape} are {reason}; {suggested}")


def _roughness(states: Tensor, axis: int) -> float:
    """Median over rows of the root mean square step along an axis, relative to the standard deviation along it."""
    if states.shape[axis] < 2:
        return torch.inf
    steps = states.diff(dim=axis).square().mean(dim=axis).sqrt()
    spread = states.std(dim=axis, correction=0)
    varies = spread > SAME * states.abs().amax(dim=axis)
    return float((steps[varies] / spread[varies]).median()) if bool(varies.any()) else torch.inf


def _recurs(states: Tensor) -> bool:
    """Whether each state ``(demo, time, column)`` follows from those before, as in a wave: moved along the columns, or by a linear
    recurrence.
    """
    centred = states - states.mean(dim=1, keepdim=True)
    time, width = states.shape[1:]
    spread = centred.square().mean(dim=(1, 2)).clamp(min=SAME)
    later, earlier, errors = states[:, 1:], states[:, :-1], [torch.full_like(spread, torch.inf)]
    for shift in range(1, width // 2 + 1) if time >= LEAST_SHIFTED else ():
        for first, second in ((later[..., shift:], earlier[..., :-shift]), (later[..., :-shift], earlier[..., shift:])):
            errors.append((first - second).square().mean(dim=(1, 2)) / spread)
    if (order := min(time // 4, 6)) >= 2:
        before = torch.stack([centred[:, order - lag : time - lag].flatten(1) for lag in range(1, order + 1)], dim=2)
        after = centred[:, order:].flatten(1)[..., None]
        rest = after - before @ (torch.linalg.pinv(before) @ after)
        errors.append(rest.square().mean(dim=(1, 2)) / spread)
    return float(torch.stack(errors).amin(dim=0).median()) < RECURS


def _channels_first(states: Tensor) -> bool:
    """Whether series ``(channel, time, demo)`` of a channel are alike and those of different channels are not, without trends."""
    channels, time, count = states.shape
    if time < 2 * LEAST_AXIS or count < 3:
        return False
    trend = torch.stack((torch.ones(time), torch.arange(time) - (time - 1) / 2)).double()
    basis = torch.linalg.qr(trend.T).Q
    series = states.movedim(1, 2)
    series = series - series @ basis @ basis.T
    norms = series.norm(dim=2, keepdim=True)
    series = series / norms.clamp(min=SAME)
    if bool((norms <= SAME).any()):
        return False
    within = (series.sum(dim=1).square().sum(dim=1) - count) / (count * (count - 1))  # mean correlation of pairs, (channel,)
    pairs = torch.einsum("atd,btd->abd", series.mT, series.mT).abs()
    between = float((pairs.sum(dim=(0, 1)) - channels).mean()) / max(channels * (channels - 1), 1)
    alike = float(within.mean())
    return alike > ALIKE_CHANNELS and between < alike - OTHERWISE


def _continuous(demonstrations: Demonstrations) -> tuple[Demonstrations, list[Finding]]:
    """Demonstrations with continuous columns of their kinds, which are proposed unless known, and findings about proposals."""
    names, findings = demonstrations.state_names, list[Finding]()
    try:
        demonstrations, notes = with_kinds(demonstrations)
        findings = [Finding(text, "note") for text in notes]
    except UserError as error:
        demonstrations = replace(demonstrations, state_kinds=())
        findings = [Finding(str(error).removeprefix("states: "), "error")]
    columns, double = Columns(demonstrations.state_kinds), demonstrations.states.dtype == torch.float64
    if not columns and not double:
        return demonstrations, findings
    states = columns.encode(demonstrations.states)
    if double:  # offsets hide movement
        states = states - torch.cat([path[:1] for path in paths_of(replace(demonstrations, states=states))]).mean(dim=0)
    names = columns.names(names)
    units = ("",) * len(names)
    return replace(demonstrations, states=states.float(), state_names=names, state_units=units, state_kinds=()), findings


def distances(demonstrations: Demonstrations) -> Tensor:
    """Distances ``(demo, demo)``: root mean square over even times and columns scaled by their spread."""
    points = _points(_paths(demonstrations))
    return _apart(points / _spread(points))


def _paths(demonstrations: Demonstrations) -> list[Tensor]:
    """States ``(time, state)`` of each demonstration in float64, without padding."""
    return [path.double() for path in paths_of(demonstrations)]


def _points(paths: list[Tensor]) -> Tensor:
    """Resample paths ``(time, state)`` of any lengths at even times, ``(demo, point, state)``."""
    points, count = [], POINTS if max(map(len, paths)) > 1 else 1
    for path in paths:
        times = torch.linspace(0, len(path) - 1, count, dtype=torch.double)
        before = times.floor().long().clamp(max=len(path) - 1)
        after = (before + 1).clamp(max=len(path) - 1)
        points.append(path[before] + (times - before)[:, None] * (path[after] - path[before]))
    return torch.stack(points)


def _spread(points: Tensor) -> Tensor:
    """Standard deviation of each column of ``(demo, point, state)``; 1 for columns that are constant up to rounding."""
    flat = points.flatten(0, 1)
    spread = flat.std(dim=0, correction=0)
    return torch.where(spread > SAME * flat.abs().amax(dim=0), spread, 1)


def _apart(points: Tensor) -> Tensor:
    flat = points.flatten(1)
    return torch.cdist(flat, flat, compute_mode="donot_use_mm_for_euclid_dist") / flat.shape[1] ** 0.5


def _pairs(distances: Tensor) -> Tensor:
    """Distances of all pairs of different demonstrations, from ``(demo, demo)``."""
    row, column = torch.triu_indices(len(distances), len(distances), offset=1)
    return distances[row, column]


def _others(values: Sequence[T], row: int) -> list[T]:
    return [*values[:row], *values[row + 1 :]]


def _lengths(demonstrations: Demonstrations) -> Iterator[Finding]:
    lengths = demonstrations.lengths.tolist()
    for row, length in enumerate(lengths if len(lengths) > 2 else ()):
        others = _others(lengths, row)
        if UNUSUAL * length < min(others) or length > UNUSUAL * max(others):
            yield Finding(f"has {length} steps, the others {min(others)} to {max(others)}", rows=(row,))


def _constant(demonstrations: Demonstrations) -> Iterator[Finding]:
    states = torch.cat(_paths(demonstrations))
    varies = states.amax(dim=0) - states.amin(dim=0) > SAME * states.abs().amax(dim=0)
    if len(states) > 1 and varies.any() and not varies.all():
        names = [name for name, changes in zip(demonstrations.state_names, varies.tolist(), strict=True) if not changes]
        change = "changes" if len(names) == 1 else "change"
        yield Finding(f"{len(names)} of {len(varies)} columns never {change} ({short(', '.join(names), 50)})", "note")


def _duplicates(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Find copies by states and observed features."""
    paths, gaps = _paths(demonstrations), distances(demonstrations)
    usual = float(_pairs(gaps).median()) if len(paths) > 2 else 1.0
    observed = [values.flatten(1) for values in demonstrations.observed.values()]  # in double precision, images take 8 times more
    tolerances = [
        torch.cat([ALIKE * part.double().std(dim=0, correction=0) for part in values.split(BLOCK, dim=1)]) for values in observed
    ]

    def differ(first: int, row: int) -> Iterator[bool]:
        for values, most in zip(observed, tolerances, strict=True):
            yield bool(((values[first].double() - values[row].double()).abs() > most).any())

    size = min(len(path) for path in paths) * paths[0].shape[1]
    limit = max(ALIKE * usual if size >= ENOUGH else 0.0, SAME)
    remaining = list(range(len(paths)))
    while remaining:
        first, *rest = remaining
        near = gaps[first].tolist()
        copies = [row for row in rest if near[row] <= limit and not any(differ(first, row))]
        if copies:
            exact = all(torch.equal(paths[first], paths[row]) for row in copies)
            yield Finding("are the same" if exact else "are nearly the same; they count once", rows=(first, *copies))
        known = {*copies}
        remaining = [row for row in rest if row not in known]


def _stills(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Find demonstrations that stand still much longer than the others; columns are scaled by their spread."""
    paths = _paths(demonstrations)
    spread = _spread(torch.cat(paths)[None])
    moved = [(path.diff(dim=0) / spread).square().mean(dim=1).sqrt() for path in paths]
    if max(map(len, moved)) < FEW:
        return
    sizes_moved = torch.cat(moved)
    moving = sizes_moved[sizes_moved > 0]
    usual = float(moving.median()) if len(moving) else 0.0
    if not usual:
        yield Finding("nothing moves in any of them")
        return
    runs = [_longest(sizes <= STILL * usual) for sizes in moved]
    shares = [run / max(len(sizes), 1) for sizes, (run, _) in zip(moved, runs, strict=True)]
    for row, (sizes, (run, start)) in enumerate(zip(moved, runs, strict=True)):
        others = _others(shares, row)
        if run < FEW or shares[row] < LONG:
            continue
        if run == len(sizes):
            yield Finding(f"nothing moves in its {len(sizes) + 1} steps", rows=(row,))
        elif not others or shares[row] > 2 * sorted(others)[len(others) // 2]:
            to_end = start + run == len(sizes)
            where, hint = ("on", "; if it is padding, give its length") if to_end else (f"to {start + run}", "")
            yield Finding(f"stands still from step {start} {where}, {run} of {len(sizes)} steps{hint}", rows=(row,))


def _longest(still: Tensor) -> tuple[int, int]:
    """Length and start of the longest run of true values ``(time,)``."""
    best, run = (0, 0), 0
    for time, value in enumerate(still.tolist()):
        run = run + 1 if value else 0
        best = max(best, (run, time - run + 1), key=lambda pair: pair[0])
    return best


def _jumps(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Find steps much larger than all others, in columns with more than a few values."""
    paths = _paths(demonstrations)
    states, steps = torch.cat(paths), [path.diff(dim=0).abs() for path in paths]
    continuous = [column for column in range(states.shape[1]) if len(states[:, column].unique()) > DISCRETE]
    none = torch.zeros((1, len(continuous)), dtype=torch.double)
    tops = torch.stack([torch.cat((sizes[:, continuous], none)).amax(dim=0) for sizes in steps])  # steps are at least 0
    count, two = sum(map(len, steps)), tops.topk(min(2, len(tops)), dim=0).values
    for row, sizes in enumerate(steps if continuous else ()):
        rest = torch.where(tops[row] < two[0], two[0], two[-1] if len(tops) > 1 else none[0])  # the largest of the others
        many = 1 if len(steps) > 1 and len(sizes) >= ENOUGH else 4  # among few steps a movement may stand out more
        worst = (0.0, 0, 0)
        for time in sizes[:, continuous].argmax(dim=0).unique().tolist() if len(sizes) else ():
            others = torch.cat((sizes[: max(time - 1, 0)], sizes[time + 2 :]))[:, continuous]  # a blip is two jumps
            if len(others) + count - len(sizes) < ENOUGH:
                continue
            largest = torch.cat((others, rest[None])).amax(dim=0)
            ratios = torch.where(largest > 0, sizes[time, continuous] / largest.clamp(min=1e-30), 0)
            order = ratios.argsort(descending=True)
            if ratios[order[0]] > many * JUMP_ALONE or (len(order) > 1 and ratios[order[1]] > many * JUMP):
                worst = max(worst, (float(ratios[order[0]]), time, continuous[int(order[0])]))
        if worst[0]:
            ratio, time, column = worst
            name = short(demonstrations.state_names[column], 30)
            yield Finding(f"jumps after step {time}: {ratio:.0f} times the largest other step of column {name!r}", rows=(row,))
    wrapped = [column for column in continuous if _wraps(states[:, column], [sizes[:, column] for sizes in steps])]
    if wrapped:
        names = short(", ".join(demonstrations.state_names[column] for column in wrapped), 60)
        yield Finding(f"columns that jump from end to end: {names}; if they are angles, give sine and cosine", "note")


def _wraps(states: Tensor, steps: list[Tensor]) -> bool:
    """Whether a column ``(time,)`` crosses its range in a step in several demonstrations, and otherwise moves in small steps."""
    sizes = torch.cat(steps)
    moving = sizes[sizes > 0]
    if len(moving) < ENOUGH:
        return False
    jumps = [int((part > WRAPPED * (states.max() - states.min())).sum()) for part in steps]
    rare = sum(jumps) * JUMP_ALONE < len(moving)
    return len(jumps) - jumps.count(0) > 1 and rare and bool(sizes.max() > 2 * JUMP_ALONE * moving.median())


def _units(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Find demonstrations whose values are much larger or smaller than those of the other demonstrations."""
    paths = _paths(demonstrations)
    sizes = torch.stack([path.abs().amax(dim=0) for path in paths])
    varies = torch.cat(paths).std(dim=0, correction=0) > SAME * sizes.amax(dim=0)
    for row in range(len(paths) if len(paths) > 2 and varies.any() else 0):
        others = sizes[_others(range(len(paths)), row)][:, varies].clamp(min=1e-30)
        ratios = (sizes[row, varies].clamp(min=1e-30) / others).median(dim=1).values
        if ratios.min() > UNITS or ratios.max() < 1 / UNITS:
            ratio = float(ratios.median())
            relation = f"{ratio:.0f} times the other values" if ratio > 1 else f"1/{1 / ratio:.0f} of the other values"
            yield Finding(f"its values are about {relation}; other units?", rows=(row,))


def _shapes(points: Tensor) -> Tensor:
    """Points ``(demo, point, state)`` centred, with a root mean square of 1, in columns of spread 1."""
    centred = points / _spread(points)
    centred = centred - centred.mean(dim=1, keepdim=True)
    return centred / centred.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=SAME)


def _outliers(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Find demonstrations far from all others, relative to distances among the others."""
    count, points = len(demonstrations), _points(_paths(demonstrations))
    if count < 3:
        return
    away = (points != points.flatten(0, 1).median(dim=0).values).double().mean(dim=1)  # share of times, (demo, state)
    others = (away.sum(dim=0) - away) / (count - 1)
    rare = (others < SELDOM) & (away < PARTLY)
    views = [(points / _spread(points), APART_PLACES, "is far from the others")]
    if points.shape[1] > 1:
        views.append((_shapes(points), APART_SHAPES, "moves otherwise than the others"))
    reported: set[int] = set()
    for view, limit, words in views:
        ratios, beyond = _far(view, rare)
        for row, (ratio, apart) in enumerate(zip(ratios.tolist(), beyond.tolist(), strict=True)):
            if row not in reported and ratio > APART.get(count, limit) and (count < 5 or apart > BEYOND):
                reported.add(row)
                yield Finding(f"{words}: {ratio:.0f} times the usual distance among them; another concept?", rows=(row,))


def _spreads_of_others(points: Tensor) -> Tensor:
    """Standard deviations of all other demonstrations ``(demo, state)``, of points ``(demo, point, state)``.

    At least 0.1 of that of all.
    """
    centred = points - points.mean(dim=(0, 1))
    first, second, count = centred.sum(dim=1), centred.square().sum(dim=1), (len(points) - 1) * points.shape[1]
    means, squares = (first.sum(dim=0) - first) / count, (second.sum(dim=0) - second) / count
    return torch.maximum((squares - means.square()).clamp(min=0).sqrt(), 0.1 * centred.square().mean(dim=(0, 1)).sqrt())


def _far(points: Tensor, rare: Tensor) -> tuple[Tensor, Tensor]:
    """Distances of each demonstration from the others relative to distances among them, of points ``(demo, point, state)``.

    Columns are scaled by the spread of the others, so that an outlier does not inflate it; ``rare (demo, state)`` do not count.

    Returns:
        Ratios of medians, and of the minimum to the maximum, each ``(demo,)``.
    """
    count, size, scales = len(points), points[0].numel(), _spreads_of_others(points)
    weights = torch.where(scales > SAME, scales, 1).pow(-2) * ~rare
    others = torch.arange(count - 1).repeat(count, 1)
    others += others >= torch.arange(count)[:, None]  # (demo, other)
    some = others[:, :: -(-(count - 1) // MOST_COMPARED)]
    left, right = (some[:, index] for index in torch.triu_indices(some.shape[1], some.shape[1], offset=1))
    gaps, among = torch.zeros(others.shape, dtype=torch.double), torch.zeros(left.shape, dtype=torch.double)
    for column, weight in enumerate(weights.T[..., None]):
        values = points[..., column].contiguous()
        squares = torch.cdist(values, values, compute_mode="donot_use_mm_for_euclid_dist").square()
        gaps += weight * squares.gather(1, others)
        among += weight * squares[left, right]
    gaps, among, closest = (gaps / size).sqrt(), (among / size).sqrt(), CLOSEST.get(count, 0.1)
    usual, largest = among.median(dim=1).values.clamp(min=closest), among.amax(dim=1).clamp(min=closest)
    return gaps.median(dim=1).values / usual, gaps.amin(dim=1) / largest
