"""Faults of a few demonstrations that show without a model: what is missing, jumps, stands still, is there twice, or is far off.

Thresholds were chosen on demonstrations of navigation, object rearrangement and driving, on pen strokes, noise and random walks: in
99 of 100 sets of three to ten good demonstrations no fault is found (97 in driving).
"""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.finding import Finding
from ftl_lightning.errors import short

POINTS = 32
"""Even times of a demonstration at which it is compared with others."""
UNUSUAL = 3.0
"""Times as long, or as short, as all others."""
DISCRETE = 5
"""Values of a column that takes no more of them: it may jump."""
JUMP, JUMP_ALONE = 3.0, 10.0
"""A jump is so many times the largest other step in two columns or more, or in one; four times as many where steps are few."""
WRAPPED = 0.8
"""Share of its range that a column goes through in a step where an angle begins anew."""
STILL = 1e-3
"""Of the usual step: less is none."""
FEW = 3
"""Steps: fewer without a movement are no fault, and behaviour that has no more may stand still."""
LONG = 0.4
"""Share of a demonstration that it stands still at a time."""
SAME, ALIKE = 1e-6, 0.02
"""Of the usual distance of two demonstrations."""
ENOUGH = 20
"""Numbers of a demonstration from which on two that are nearly alike are no coincidence; steps that tell what is usual."""
UNITS = 10.0
"""Times the others' values."""
APART = {3: 25.0, 4: 12.0}
"""Times the usual distance of the others from which on a demonstration is far off, by the number of demonstrations."""
APART_PLACES, APART_SHAPES = 12.0, 4.0
"""The same for five and more: of states as they are, and of their shapes, whatever their place and size."""
CLOSEST = {3: 0.5}
"""Of the others' spread: to be nearer to one another than this makes no other far off; 0.1 for more demonstrations."""
BEYOND = 1.5
"""Times the largest distance of two others that its least has to be, from five demonstrations on."""


def mended(states: Tensor, lengths: Tensor) -> tuple[Tensor, tuple[Finding, ...]]:
    """States with numbers in place of those that are missing or not finite, and findings that tell of them.

    Args:
        states: ``(demo, time, state)`` of any floating type.
        lengths: ``(demo,)``, of each.

    Returns:
        Finite states, where a column goes on straight between the last and the next finite value; 0 where it has none.
    """
    missing = ~states.isfinite()
    if not missing.any():
        return states, ()
    found, whole = [], states.clone()
    for row in missing.flatten(1).any(dim=1).nonzero()[:, 0].tolist():
        length = int(lengths[row])
        times = missing[row].any(dim=1).nonzero()[:, 0]
        within = times[times < length]
        if len(within):
            columns = int(missing[row].any(dim=0).sum())
            told = f"{len(within)} of {length} time steps are not finite (the first is {int(within[0])}), in {columns} columns"
            found.append(Finding(f"{told}; nothing can be learned from them", "error", (row,)))
        else:
            found.append(Finding("its padding is not finite; pad with the last state", "error", (row,)))
        for column in missing[row].any(dim=0).nonzero()[:, 0].tolist():
            whole[row, :, column] = _interpolated(states[row, :, column])
    return whole, tuple(found)


def _interpolated(values: Tensor) -> Tensor:
    """A column ``(time,)`` with straight lines where it is not finite."""
    good = values.isfinite().nonzero()[:, 0]
    if not len(good):
        return torch.zeros_like(values)
    times = torch.arange(len(values))
    after = torch.searchsorted(good, times).clamp(max=len(good) - 1)
    before = (torch.searchsorted(good, times, right=True) - 1).clamp(min=0)
    first, last = good[before], good[after]
    share = ((times - first) / (last - first).clamp(min=1)).clamp(0, 1).to(values.dtype)
    return values[first] + share * (values[last] - values[first])


def check(demonstrations: Demonstrations) -> tuple[Finding, ...]:
    """What is to be said of demonstrations of one concept, errors and warnings first.

    What has one fault is left out where others are looked for, which are found by comparing demonstrations.

    Args:
        demonstrations: taken to be of one concept, whatever their texts.
    """
    found = [*_few(demonstrations), *_constant(demonstrations)]
    left = list(range(len(demonstrations)))
    for look in (_lengths, _stills, _units, _duplicates, _jumps, _outliers):
        own = [finding.among(left) for finding in look(demonstrations.rows(left))]
        found += own
        faulty = {row for finding in own for row in (finding.rows[1:] if look is _duplicates else finding.rows)}
        left = [row for row in left if row not in faulty] or left
    return tuple(sorted(found, key=lambda finding: finding.severity == "note"))


def check_each(demonstrations: Demonstrations) -> dict[str, tuple[Finding, ...]]:
    """:func:`check` of every concept by its text, with rows of the whole."""
    found = {}
    for text in dict.fromkeys(demonstrations.concepts):
        rows = [row for row, own in enumerate(demonstrations.concepts) if own == text]
        found[text] = tuple(finding.among(rows) for finding in check(demonstrations.rows(rows)))
    return found


def distances(demonstrations: Demonstrations) -> Tensor:
    """Between demonstrations ``(demo, demo)``: root mean square over even times and columns, which are scaled by their spread."""
    points = _points(_paths(demonstrations))
    return _apart(points / _spread(points))


def _paths(demonstrations: Demonstrations) -> list[Tensor]:
    """States ``(time, state)`` of each without its padding."""
    lengths = demonstrations.lengths.tolist()
    return [states[:length].double() for states, length in zip(demonstrations.states, lengths, strict=True)]


def _points(paths: list[Tensor]) -> Tensor:
    """Paths ``(time, state)`` at even times ``(demo, point, state)``, whatever their lengths."""
    found = []
    for path in paths:
        times = torch.linspace(0, len(path) - 1, POINTS if max(map(len, paths)) > 1 else 1, dtype=torch.double)
        before = times.floor().long().clamp(max=len(path) - 1)
        after = (before + 1).clamp(max=len(path) - 1)
        found.append(path[before] + (times - before)[:, None] * (path[after] - path[before]))
    return torch.stack(found)


def _spread(points: Tensor) -> Tensor:
    """Standard deviation of each column over ``(demo, point, state)``; 1 of those that are constant but for rounding."""
    flat = points.flatten(0, 1)
    spread = flat.std(dim=0, correction=0)
    return torch.where(spread > SAME * flat.abs().amax(dim=0), spread, 1)


def _apart(points: Tensor) -> Tensor:
    flat = points.flatten(1)
    return torch.cdist(flat, flat, compute_mode="donot_use_mm_for_euclid_dist") / flat.shape[1] ** 0.5


def _pairs(distances: Tensor) -> Tensor:
    """Distances ``(demo, demo)`` of two different demonstrations, each pair once."""
    row, column = torch.triu_indices(len(distances), len(distances), offset=1)
    return distances[row, column]


def _others(count: int, row: int) -> list[int]:
    return [other for other in range(count) if other != row]


def _few(demonstrations: Demonstrations) -> Iterator[Finding]:
    if len(demonstrations) < 3:
        yield Finding("three to five demonstrations are usual; with fewer nothing tells which of them is odd", "note")


def _lengths(demonstrations: Demonstrations) -> Iterator[Finding]:
    lengths = demonstrations.lengths.tolist()
    for row, length in enumerate(lengths if len(lengths) > 2 else ()):
        others = [lengths[other] for other in _others(len(lengths), row)]
        if UNUSUAL * length < min(others) or length > UNUSUAL * max(others):
            yield Finding(f"has {length} steps, the others {min(others)} to {max(others)}", rows=(row,))


def _constant(demonstrations: Demonstrations) -> Iterator[Finding]:
    every = torch.cat(_paths(demonstrations))
    varies = every.amax(dim=0) - every.amin(dim=0) > SAME * every.abs().amax(dim=0)
    if len(every) > 1 and varies.any() and not varies.all():
        names = [name for name, own in zip(demonstrations.state_names, varies.tolist(), strict=True) if not own]
        yield Finding(f"{len(names)} of {len(varies)} columns never change ({short(', '.join(names), 50)})", "note")


def _duplicates(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Demonstrations that are there twice, with what is observed."""
    paths, apart = _paths(demonstrations), distances(demonstrations)
    usual = float(_pairs(apart).median()) if len(paths) > 2 else 1.0
    for values in demonstrations.observed.values():
        seen = values.double().flatten(1)
        differ = (seen[:, None] - seen).abs() > ALIKE * seen.std(dim=0, correction=0)
        apart = apart.masked_fill(differ.any(dim=2), torch.inf)
    size = min(len(path) for path in paths) * paths[0].shape[1]
    limit = max(ALIKE * usual if size >= ENOUGH else 0.0, SAME)
    left = list(range(len(paths)))
    while left:
        first, *rest = left
        copies = [row for row in rest if apart[first, row] <= limit]
        if copies:
            exact = all(torch.equal(paths[first], paths[row]) for row in copies)
            yield Finding("are the same" if exact else "are nearly the same; they tell no more than one", rows=(first, *copies))
        left = [row for row in rest if row not in copies]


def _steps(paths: list[Tensor]) -> list[Tensor]:
    """Steps ``(time - 1, state)`` of each in columns that are scaled by their spread."""
    spread = _spread(torch.cat(paths)[None])
    return [path.diff(dim=0) / spread for path in paths]


def _stills(demonstrations: Demonstrations) -> Iterator[Finding]:
    paths = _paths(demonstrations)
    moved = [steps.square().mean(dim=1).sqrt() for steps in _steps(paths)]
    every = torch.cat(moved)
    if max(map(len, moved)) < FEW:
        return
    usual = float(every[every > 0].median()) if (every > 0).any() else 0.0
    if not usual:
        yield Finding("nothing moves in any of them")
        return
    runs = [_longest(own <= STILL * usual) for own in moved]
    shares = [run / max(len(own), 1) for own, (run, _) in zip(moved, runs, strict=True)]
    for row, (own, (run, start)) in enumerate(zip(moved, runs, strict=True)):
        others = [shares[other] for other in _others(len(paths), row)]
        if run < FEW or shares[row] < LONG:
            continue
        if run == len(own):
            yield Finding(f"nothing moves in its {len(own) + 1} steps", rows=(row,))
        elif not others or shares[row] > 2 * sorted(others)[len(others) // 2]:
            where = f"from step {start} on" if start + run == len(own) else f"from step {start} to {start + run}"
            hint = "; if it is padding, give its length" if start + run == len(own) else ""
            yield Finding(f"stands still {where}, {run} of {len(own)} steps{hint}", rows=(row,))


def _longest(still: Tensor) -> tuple[int, int]:
    """The longest run of true values ``(time,)`` and where it starts."""
    best, run = (0, 0), 0
    for time, own in enumerate(still.tolist()):
        run = run + 1 if own else 0
        best = max(best, (run, time - run + 1), key=lambda one: one[0])
    return best


def _jumps(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Steps that are many times as large as all others, in columns with more than a few values."""
    paths = _paths(demonstrations)
    states, steps = torch.cat(paths), [path.diff(dim=0).abs() for path in paths]
    continuous = [column for column in range(states.shape[1]) if len(states[:, column].unique()) > DISCRETE]
    for row, own in enumerate(steps if continuous else ()):
        rest = torch.cat([steps[other] for other in _others(len(steps), row)] or [own[:0]])
        many = 1 if len(steps) > 1 and len(own) >= ENOUGH else 4  # the fewer there are, the more a movement may stand out
        worst = (0.0, 0, 0)
        for time in own[:, continuous].argmax(dim=0).unique().tolist() if len(own) else ():
            others = torch.cat((own[: max(time - 1, 0)], own[time + 2 :], rest))[:, continuous]  # a blip is two jumps
            if len(others) < ENOUGH:
                continue
            largest = others.amax(dim=0)
            ratios = torch.where(largest > 0, own[time, continuous] / largest.clamp(min=1e-30), 0)
            order = ratios.argsort(descending=True)
            if ratios[order[0]] > many * JUMP_ALONE or (len(order) > 1 and ratios[order[1]] > many * JUMP):
                worst = max(worst, (float(ratios[order[0]]), time, continuous[int(order[0])]))
        if worst[0]:
            ratio, time, column = worst
            name = short(demonstrations.state_names[column], 30)
            yield Finding(f"jumps after step {time}: {ratio:.0f} times the largest other step of column {name!r}", rows=(row,))
    wrapped = [column for column in continuous if _wraps(states[:, column], [own[:, column] for own in steps])]
    if wrapped:
        names = short(", ".join(demonstrations.state_names[column] for column in wrapped), 60)
        yield Finding(f"columns that jump from end to end: {names}; if they are angles, give sine and cosine", "note")


def _wraps(states: Tensor, steps: list[Tensor]) -> bool:
    """Whether a column ``(time,)`` goes through its range in one step in several demonstrations, and otherwise in small ones."""
    every = torch.cat(steps)
    moving = every[every > 0]
    if len(moving) < ENOUGH:
        return False
    large = [own > WRAPPED * (states.max() - states.min()) for own in steps]
    often, several = sum(int(own.sum()) for own in large), sum(bool(own.any()) for own in large)
    return several > 1 and often * JUMP_ALONE < len(moving) and bool(every.max() > 2 * JUMP_ALONE * moving.median())


def _units(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Values that are many times those of each other, or a small part of them."""
    paths = _paths(demonstrations)
    sizes = torch.stack([path.abs().amax(dim=0) for path in paths])
    varies = torch.cat(paths).std(dim=0, correction=0) > SAME * sizes.amax(dim=0)
    for row in range(len(paths) if len(paths) > 2 and varies.any() else 0):
        others = sizes[_others(len(paths), row)][:, varies].clamp(min=1e-30)
        ratios = (sizes[row, varies].clamp(min=1e-30) / others).median(dim=1).values
        if ratios.min() > UNITS or ratios.max() < 1 / UNITS:
            ratio = float(ratios.median())
            told = f"{ratio:.0f} times the others'" if ratio > 1 else f"1/{1 / ratio:.0f} of the others'"
            yield Finding(f"its values are about {told}; other units?", rows=(row,))


def _shapes(points: Tensor) -> Tensor:
    """Points ``(demo, point, state)`` around their mean, with a root mean square of 1, in columns of spread 1."""
    centred = points / _spread(points)
    centred = centred - centred.mean(dim=1, keepdim=True)
    size = centred.square().mean(dim=(1, 2), keepdim=True).sqrt()
    return centred / size.clamp(min=SAME)


_View = tuple[Callable[[Tensor], Tensor], float, str]
"""How points are seen, from how far on one is far off, and words for it."""


def _outliers(demonstrations: Demonstrations) -> Iterator[Finding]:
    """Demonstrations far from all others, compared with the distances among those."""
    count, points = len(demonstrations), _points(_paths(demonstrations))
    if count < 3:
        return
    views: list[_View] = [(lambda own: own / _spread(own), APART_PLACES, "is far from the others")]
    if points.shape[1] > 1:
        views.append((_shapes, APART_SHAPES, "moves otherwise than the others"))
    told: set[int] = set()
    for view, limit, words in views:
        seen = view(points)
        for row in range(count):
            times, beyond = _far(seen, row)
            if row not in told and times > APART.get(count, limit) and (count < 5 or beyond > BEYOND):
                told.add(row)
                yield Finding(f"{words}: {times:.0f} times the usual distance among them; another concept?", rows=(row,))


def _far(points: Tensor, row: int) -> tuple[float, float]:
    """How far one is from the others: its median distance by theirs, and its least by their largest.

    Columns are scaled by their spread over the others, lest the one that is far off hides how far.
    """
    others = _others(len(points), row)
    scale = torch.maximum(
        points[others].flatten(0, 1).std(dim=0, correction=0), 0.1 * points.flatten(0, 1).std(dim=0, correction=0)
    )
    apart = _apart(points / torch.where(scale > SAME, scale, 1))
    own, among = apart[row, others], _pairs(apart[others][:, others])
    closest = CLOSEST.get(len(points), 0.1)
    return float(own.median() / among.median().clamp(min=closest)), float(own.min() / among.max().clamp(min=closest))
