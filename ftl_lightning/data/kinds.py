"""Kinds of columns: conversion of angles, rotations and categories to continuous numbers and back.

A file names the kind of each column in ``state_kinds``. A kind applies to a run of adjacent columns:

==============  =========  ==========================================================  ==================
kind            columns    learned as                                                  samples
==============  =========  ==========================================================  ==================
``linear``      1          itself                                                      any number
``angle``       1          cosine and sine                                             within a turn
``quaternion``  4          two rows of the rotation matrix (6-D, Zhou et al., 2019)     norm 1
``rotation``    9, or 6    the first two rows (or columns) of the matrix                orthonormal
``pose``        16, or 12  position, and the first two rows of the rotation             orthonormal, 0 0 0 1
``binary``      1          itself                                                      one of two values
``category``    2 or more  themselves, one-hot                                         one-hot
==============  =========  ==========================================================  ==================

:func:`resolved` adds what samples need to come back as the data were: ``'angle -180 360 wraps'`` (lowest value, turn, and whether
paths wrap), ``'quaternion 0 1'`` (component and its sign at the first time), ``'binary 0 1'`` (values), ``'category 3'`` (columns),
``'pose 16 0'`` (columns of a homogeneous matrix, and whether it is transposed).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ftl_lightning.services.errors import UserError, require, short, shown

LINEAR, ANGLE, QUATERNION, ROTATION, POSE, BINARY, CATEGORY = KINDS = (
    *("linear", "angle", "quaternion", "rotation", "pose", "binary", "category"),
)
RADIANS, DEGREES = 2 * math.pi, 360.0
"""A whole turn of angles without a unit is one of these."""
TURNS = {
    **dict.fromkeys(("rad", "rads", "radian", "radians"), RADIANS),
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "º"), DEGREES),
    **dict.fromkeys(("mrad", "mrads", "milliradian", "milliradians"), 1000 * RADIANS),
    **dict.fromkeys(("turn", "turns", "rev", "revs", "revolution", "revolutions", "rotation", "rotations", "cycle", "cycles"), 1.0),
    **dict.fromkeys(("grad", "grads", "gradian", "gradians", "gon", "gons"), 400.0),
    **dict.fromkeys(("arcmin", "arcmins", "arcminute", "arcminutes"), 60 * DEGREES),
    **dict.fromkeys(("arcsec", "arcsecs", "arcsecond", "arcseconds"), 3600 * DEGREES),
}
"""A whole turn by unit."""
SHORT_TURNS = ("rad", "deg", "mrad", "turns", "grad")
"""Units of angles, for messages."""
MOST_PROPOSED = 300
"""Maximum number of columns for which kinds are proposed; more are taken as linear."""
UNIT_NORM, STILL = 2e-2, 1e-3
"""Maximum error of the norm of a quaternion or a row of a rotation matrix and of their products, as after rounding to two decimals;
maximum change of a column that does not move.
"""
WRAPPED, TURN = 0.8, (0.9, 1.001)
"""Share of a turn that a step covers where an angle wraps; range of an angle's values, in turns, for it to be proposed."""
RARE = 10.0
"""Minimum number of steps for each wrap of an angle, and ratio of a wrap to twice the median step."""
PAIRS = ((0.0, 1.0), (-1.0, 1.0))
"""Values of columns that are proposed as binary."""
MOST_INVALID, MOST_UNNAMED = 0.5, 0.25
"""Maximum share of invalid rotations in columns that are rotations by all others and by their names, or quaternions without names.
"""


class Paths(NamedTuple):
    """Demonstrations in sequence, without padding.

    Attributes:
        states: ``(time, state)`` of all.
        lengths: ``(demo,)`` int64.
    """

    states: Tensor
    lengths: Tensor

    @property
    def firsts(self) -> Tensor:
        """Index of the first state of each demonstration ``(demo,)``."""
        return self.lengths.cumsum(dim=0) - self.lengths

    @property
    def within(self) -> Tensor:
        """Whether steps ``(time - 1,)`` stay within a demonstration."""
        inside = torch.ones(max(len(self.states) - 1, 0), dtype=torch.bool)
        inside[self.firsts[1:] - 1] = False
        return inside


@dataclass(frozen=True)
class Group:
    """Adjacent columns that are converted together.

    Attributes:
        kind: one of :data:`KINDS`.
        first, count: first column and number of columns.
        numbers: parameters of the kind, see this module; for an angle lowest value, turn, and 1 if paths wrap.
    """

    kind: str
    first: int
    count: int
    numbers: tuple[float, ...] = ()

    @property
    def columns(self) -> slice:
        """Columns of the group in a state."""
        return slice(self.first, self.first + self.count)

    @property
    def width(self) -> int:
        """Number of continuous columns."""
        return {ANGLE: 2, QUATERNION: 6, ROTATION: 6, POSE: 9}.get(self.kind, self.count)

    @property
    def texts(self) -> tuple[str, ...]:
        """Entries of ``state_kinds``."""
        return (" ".join([self.kind, *(f"{number:.17g}" for number in self.numbers)]),) * self.count

    def encode(self, states: Tensor) -> Tensor:
        """Convert columns ``(..., count)`` to continuous columns ``(..., width)``."""
        if self.kind == ANGLE:
            low, turn, _ = self.numbers
            angle = (states - low) * (2 * math.pi / turn)
            return torch.cat((angle.cos(), angle.sin()), dim=-1)
        if self.kind == QUATERNION:
            return _rows(states)
        if self.kind == POSE:
            matrices = _homogeneous(states, self.numbers)
            return torch.cat((matrices[..., 3], matrices[..., :2, :3].flatten(-2)), dim=-1)
        return states[..., : self.width]

    def decode(self, encoded: Tensor) -> Tensor:
        """Invert :meth:`encode` for paths ``(..., time, width)``, after projection to the nearest possible values."""
        if self.kind == ANGLE:
            return self._angle(encoded)
        if self.kind == QUATERNION:
            component, sign = self.numbers
            return _signed(_quaternion(_matrix(encoded)), int(component), sign)
        if self.kind == ROTATION:
            return _matrix(encoded).flatten(-2)[..., : self.count]
        if self.kind == POSE:
            matrices = torch.cat((_matrix(encoded[..., 3:]), encoded[..., :3, None]), dim=-1)
            last = encoded.new_tensor((0.0, 0, 0, 1)).expand(*encoded.shape[:-1], 1, 4)
            whole = torch.cat((matrices, last), dim=-2)
            return (whole.mT if self.numbers[1] else whole).flatten(-2)[..., : self.count]
        if self.kind == BINARY:
            low, high = self.numbers
            return torch.where(encoded > (low + high) / 2, encoded.new_tensor(high), encoded.new_tensor(low))
        if self.kind == CATEGORY:
            return torch.nn.functional.one_hot(encoded.argmax(dim=-1), self.count).to(encoded)
        return encoded

    def _angle(self, encoded: Tensor) -> Tensor:
        low, turn, wraps = self.numbers
        angle = torch.atan2(encoded[..., 1:], encoded[..., :1]).remainder(2 * math.pi)
        if not wraps and angle.shape[-2] > 1:
            steps = (angle.diff(dim=-2) + math.pi).remainder(2 * math.pi) - math.pi
            angle = torch.cat((angle[..., :1, :], steps), dim=-2).cumsum(dim=-2)
        return low + angle * (turn / (2 * math.pi))


class Columns:
    """Conversion of states to continuous columns and back.

    Args:
        kinds: resolved entries of ``state_kinds``; empty if all columns are linear.
    """

    def __init__(self, kinds: Sequence[str]) -> None:
        self.groups = tuple(_groups(kinds))

    def __bool__(self) -> bool:
        """Whether any column is not linear."""
        return any(group.kind != LINEAR for group in self.groups)

    @property
    def width(self) -> int:
        """Number of continuous columns."""
        return sum(group.width for group in self.groups)

    def encode(self, states: Tensor) -> Tensor:
        """Convert states ``(..., state)`` to continuous columns ``(..., width)``."""
        return torch.cat([group.encode(states[..., group.columns]) for group in self.groups], dim=-1) if self else states

    def decode(self, encoded: Tensor) -> Tensor:
        """Invert :meth:`encode` for paths ``(..., time, width)``; values are projected to the nearest possible ones."""
        parts = encoded.split([group.width for group in self.groups], dim=-1) if self else ()
        return torch.cat([group.decode(part) for group, part in zip(self.groups, parts, strict=True)], dim=-1) if self else encoded

    def names(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names of the continuous columns."""
        if not self:
            return tuple(names)
        made: list[str] = []
        for group in self.groups:
            part = names[group.columns]
            if group.kind == ANGLE:
                made += [f"cosine of {part[0]}", f"sine of {part[0]}"]
            elif group.kind == QUATERNION:
                made += [f"rotation of {part[0]} {number}" for number in range(6)]
            elif group.kind == POSE:
                made += [f"position of {part[0]} {number}" for number in range(3)]
                made += [f"rotation of {part[0]} {number}" for number in range(6)]
            else:
                made += part[: group.width]
        return tuple(made)

    def notes(self, names: Sequence[str]) -> Iterator[str]:
        """A line for each group that is not linear."""
        for group in self.groups:
            if group.kind != LINEAR:
                part = short(", ".join(names[group.columns]), 60)
                turn = f" with a turn of {group.numbers[1]:.6g}" if group.kind == ANGLE else ""
                yield f"{'column' if group.count == 1 else 'columns'} {part}: {group.kind}{turn}"


def declared(names: Sequence[str], of_file: Sequence[str], given: Mapping[str, str], place: str) -> tuple[str, ...]:
    """Kind of each column as declared, empty where it is not.

    Args:
        names: names of the columns.
        of_file: ``state_kinds`` of the file; may be empty.
        given: kinds by the name of a column, or of several separated by commas; they replace those of the file.
        place: option in messages.

    Raises:
        UserError: for an unknown name or kind.
    """
    kinds = list(of_file or ("",) * len(names))
    for key, kind in given.items():
        for name in (part.strip() for part in str(key).split(",")):
            require(name in names, place, f"names among {short(', '.join(names), 120)}", repr(short(name)))
            kinds[names.index(name)] = kind
    for kind in kinds:
        require((kind.split() or [LINEAR])[0] in KINDS, place, f"one of {', '.join(KINDS)}", repr(short(kind)))
    return tuple(kinds)


def resolved(paths: Paths, names: Sequence[str], units: Sequence[str], kinds: Sequence[str], place: str) -> tuple[str, ...]:
    """Complete declared kinds by what the data show, and propose kinds for the others of at most :data:`MOST_PROPOSED` columns.

    Args:
        paths: states of all demonstrations.
        names, units: of each column.
        kinds: declared kinds, empty where none is.
        place: file or option in messages.

    Returns:
        Resolved kind of each column; empty if all columns are linear and none is declared.

    Raises:
        UserError: naming the column, demonstration and time of a value that contradicts a declared kind, or the kind of nearly all
            other values.
    """
    every = paths.states.double()
    groups: list[Group] = []
    column, few = 0, len(names) <= MOST_PROPOSED
    while column < len(names):
        group = _declared_group(paths, every, names, units, kinds, column, place) if kinds[column].strip() else None
        group = group or (_proposed(paths, every, names, units, kinds, column, place) if few else Group(LINEAR, column, 1))
        groups.append(group)
        column += group.count
    if all(group.kind == LINEAR for group in groups) and not any(kind.strip() for kind in kinds):
        return ()
    return tuple(text for group in groups for text in group.texts)


def _groups(kinds: Sequence[str]) -> Iterator[Group]:
    column = 0
    while column < len(kinds):
        group = _resolved(kinds, column)
        whole = group is not None and kinds[column : column + group.count] == group.texts
        require(whole, f"key 'state_kinds': entry {column}", "a resolved kind of each column of its group", shown(kinds[column]))
        assert group is not None
        yield group
        column += group.count


def _resolved(kinds: Sequence[str], first: int) -> Group | None:
    """Group of a resolved kind; ``None`` for a kind without its numbers, or with others."""
    kind, *rest = kinds[first].split() or [""]
    try:
        numbers = tuple(map(float, rest))
    except ValueError:
        return None
    fits = {
        LINEAR: not numbers,
        ANGLE: len(numbers) == 3 and numbers[1] > 0,
        QUATERNION: len(numbers) == 2 and numbers[0] in range(4) and abs(numbers[1]) == 1,
        ROTATION: numbers in ((6.0,), (9.0,)),
        POSE: numbers in ((12.0, 0.0), (16.0, 0.0), (16.0, 1.0)),
        BINARY: len(numbers) == 2 and numbers[0] < numbers[1],
        CATEGORY: len(numbers) == 1 and numbers[0] in range(2, len(kinds) + 1),
    }
    if not fits.get(kind) or not all(map(math.isfinite, numbers)):
        return None
    count = 4 if kind == QUATERNION else int(numbers[0]) if kind in (CATEGORY, ROTATION, POSE) else 1
    return Group(kind, first, count, numbers)


def check_values(paths: Paths, names: Sequence[str], kinds: Sequence[str]) -> None:
    """Refuse values that contradict the resolved kinds of a model; ``UserError`` with the column, demonstration and time."""
    for group in Columns(kinds).groups:
        if group.kind in _VALID:
            _require_valid(group, paths, f"column {short(names[group.first], 40)!r}", ", as the model's")


def _require_valid(group: Group, paths: Paths, place: str, more: str = "", advice: str = "") -> None:
    """Refuse a value that is none of the group's kind; ``UserError`` with the first demonstration and time."""
    values = paths.states[:, group.columns].double()
    invalid = ~_VALID[group.kind](values, group.numbers)
    if bool(invalid.any()):
        index = int(invalid.int().argmax())
        number = int((paths.firsts <= index).sum())  # from 1
        time = index - int(paths.firsts[number - 1])
        row = f"({short(', '.join(f'{value:.4g}' for value in values[index].tolist()), 60)})"
        expected = _EXPECTED[group.kind].format(*(f"{value:g}" for value in group.numbers)) + more
        raise UserError(f"{place}: expected {expected}, found {row} in demonstration {number} at time {time}{advice}")


def _declared_group(
    paths: Paths, every: Tensor, names: Sequence[str], units: Sequence[str], kinds: Sequence[str], first: int, place: str
) -> Group:
    kind = kinds[first].split()[0]
    words = [text.split()[0] if text.split() else "" for text in kinds]
    run = next((at for at in range(first, len(kinds)) if words[at] != kind), len(kinds)) - first
    what = f"{place}: column {short(names[first], 40)!r}"
    if kind == ANGLE:
        unit = (kinds[first].split()[1:] or [units[first]])[0]
        known = _resolved(kinds, first)
        require(known or not unit or turn_of(unit), what, f"a unit of angles ({', '.join(SHORT_TURNS)})", repr(short(unit, 30)))
        return known or Group(kind, first, 1, _turn(paths, first, turn_of(unit)))
    if kind == QUATERNION:
        require(run % 4 == 0, what, "4 columns of a quaternion", f"{run} in a row")
        group = Group(kind, first, 4, _sign(paths, first))
        _require_valid(group, paths, what)
        return group
    if kind == ROTATION:
        require(run >= 6, what, "9 columns of a rotation matrix, or its first two rows (6)", f"{run} in a row")
        sizes = [Group(kind, first, size, (float(size),)) for size in (9, 6) if run >= size]
        group = next((group for group in sizes if _share(group, every) > 0.5), sizes[-1])
        _require_valid(group, paths, what)
        return group
    if kind == POSE:
        require(run >= 12, what, "16 columns of a homogeneous matrix, or its first three rows (12)", f"{run} in a row")
        group = max(_poses(first, run), key=lambda group: _share(group, every))
        _require_valid(group, paths, what)
        return group
    if kind == BINARY:
        values = every[:, first].unique().tolist()
        values = [0.0, 1.0] if values in ([0.0], [1.0]) else values
        if len(values) == 3:
            rare = min(values, key=lambda value: int((every[:, first] == value).sum()))
            _require_valid(Group(kind, first, 1, tuple(value for value in values if value != rare)), paths, what)
        require(len(values) == 2, what, "two values", f"{len(values)}")
        return Group(kind, first, 1, tuple(values))
    if kind == CATEGORY:
        size = _one_hot(every, first, run, declared=True)
        if not size and _share(whole := Group(kind, first, run, (run,)), every) > 0.5:
            _require_valid(whole, paths, what)
        require(size, what, "columns of 0 and 1 of which one is 1 at each time (one-hot)", "others")
        return Group(kind, first, size, (size,))
    return Group(LINEAR, first, 1)


def _proposed(
    paths: Paths, every: Tensor, names: Sequence[str], units: Sequence[str], kinds: Sequence[str], first: int, place: str
) -> Group:
    """Group from ``first`` on that the data show, among columns without a declared kind; linear if they show none."""
    free = next((at for at in range(first, len(kinds)) if kinds[at].strip()), len(kinds)) - first
    rest = every[:, first : first + free]
    if free >= 2 and (size := _one_hot(every, first, free)):
        return Group(CATEGORY, first, size, (size,))
    rotations = [*_poses(first, free), *([Group(ROTATION, first, 9, (9,))] if free >= 9 else [])]
    for group in [*rotations, *([Group(QUATERNION, first, 4, _sign(paths, first))] if free >= 4 else [])]:
        without_unit = group.kind == POSE or not any(units[group.columns])  # a pose has positions
        if without_unit and _shows(group, paths, names):
            place = f"{place}: column {short(names[first], 40)!r}"
            _require_valid(group, paths, place, advice="; mend it, or declare the columns linear (data.kinds, state_kinds)")
            return group
    if free and tuple(rest[:, 0].unique()[:3].tolist()) in PAIRS:
        return Group(BINARY, first, 1, tuple(rest[:, 0].unique().tolist()))
    for turn in (turn_of(units[first]),) if units[first] else (RADIANS, DEGREES):
        if turn and wraps(paths, first, turn):
            return Group(ANGLE, first, 1, _turn(paths, first, turn))
    return Group(LINEAR, first, 1)


def turn_of(unit: str) -> float:
    """A whole turn in a unit of angles; 0 for another unit."""
    return TURNS.get(unit.strip().lower(), 0.0)


def _poses(first: int, free: int) -> Iterator[Group]:
    """Poses that fit into ``free`` columns: homogeneous matrices of four rows, also transposed, or of three rows."""
    yield from (Group(POSE, first, 16, (16.0, transposed)) for transposed in (0.0, 1.0) if free >= 16)
    if free >= 12:
        yield Group(POSE, first, 12, (12.0, 0.0))


def _share(group: Group, every: Tensor) -> float:
    """Share of valid rows of a group among states ``(time, state)``."""
    return float(_VALID[group.kind](every[:, group.columns].double(), group.numbers).double().mean())


def _homogeneous(values: Tensor, numbers: Sequence[float]) -> Tensor:
    """First three rows ``(..., 3, 4)`` of homogeneous matrices from columns ``(..., 16 or 12)``."""
    whole = values.unflatten(-1, (-1, 4))
    return (whole.mT if numbers[1] else whole)[..., :3, :]


def _shows(group: Group, paths: Paths, names: Sequence[str]) -> bool:
    """Whether columns are rotations, but for a share of invalid ones of at most :data:`MOST_INVALID`."""
    values = paths.states[:, group.columns].double()
    valid = _VALID[group.kind](values, group.numbers)
    every = values[valid]
    most = MOST_UNNAMED if group.kind == QUATERNION and not _named(names[group.columns]) else MOST_INVALID
    if len(every) < (1 - most) * len(values):
        return False
    if group.kind == QUATERNION:
        lengths = torch.zeros_like(paths.lengths)
        lengths.index_add_(0, torch.arange(len(lengths)).repeat_interleave(paths.lengths), valid.long())
        return _is_quaternion(Paths(every, lengths[lengths > 0]), names[group.columns])
    return _moves(_homogeneous(every, group.numbers)[..., :3].flatten(-2) if group.kind == POSE else every)


def wraps(paths: Paths, column: int, turn: float) -> bool:
    """Whether angles in a column fill a turn, and jump from end to end in rare steps."""
    values = paths.states[:, column]
    if not TURN[0] <= float(values.max() - values.min()) / turn <= TURN[1]:
        return False
    sizes = values.diff().abs()[paths.within]
    moving, jumps = sizes[sizes > 0], int((sizes > WRAPPED * turn).sum())
    return 0 < jumps * RARE < len(moving) and float(sizes.max()) > 2 * RARE * float(moving.median())


def _turn(paths: Paths, column: int, turn: float) -> tuple[float, float, float]:
    """Lowest value, whole turn (by the range of values unless given), and 1 if paths wrap."""
    values = paths.states[:, column].double()
    turn = turn or (DEGREES if float(values.abs().max()) > 2 * RADIANS else RADIANS)
    wraps = bool((values.diff().abs() > turn / 2)[paths.within].any())
    for low in (-turn / 2, 0.0, float(values.min())):
        if low <= float(values.min()) and float(values.max()) <= low + turn:
            return low, turn, 1.0
    return float(values.min() if wraps else values[paths.firsts].min()), turn, float(wraps)


def _sign(paths: Paths, first: int) -> tuple[float, float]:
    """Component with the largest mean size at the first time, and its more frequent sign."""
    starts = paths.states[paths.firsts, first : first + 4].double()
    component = int(starts.abs().mean(dim=0).argmax())
    return float(component), 1.0 if float(starts[:, component].sign().sum()) >= 0 else -1.0


def _unit(values: Tensor) -> Tensor:
    """Whether each of the rows ``(time, n)`` has norm 1."""
    return (values.square().sum(dim=-1) - 1).abs() <= 2 * UNIT_NORM


def _orthonormal(values: Tensor) -> Tensor:
    """Whether each of the rows ``(time, 9 or 6)`` is of orthonormal vectors of three numbers, of a matrix with determinant 1."""
    rows = values.unflatten(-1, (-1, 3))
    products = rows @ rows.mT - torch.eye(rows.shape[-2], dtype=rows.dtype)
    valid = (products.abs() <= 2 * UNIT_NORM).flatten(-2).all(dim=-1)
    return valid if rows.shape[-2] < 3 else valid & (torch.linalg.det(rows) > 0)


def _pose(values: Tensor, numbers: Sequence[float]) -> Tensor:
    """Whether each of the rows ``(time, 16 or 12)`` is a homogeneous matrix of a rotation and a position."""
    valid = _orthonormal(_homogeneous(values, numbers)[..., :3].flatten(-2))
    if len(values[0]) == 12:
        return valid
    last = values[:, 3::4] if numbers[1] else values[:, 12:]
    return valid & ((last - values.new_tensor((0.0, 0, 0, 1))).abs() <= STILL).all(dim=-1)


def _one_of_each(values: Tensor, numbers: Sequence[float]) -> Tensor:
    """Whether each of the rows ``(time, n)`` is one-hot."""
    return ((values == 0) | (values == 1)).all(dim=-1) & (values.sum(dim=-1) == 1)


_VALID: Mapping[str, Callable[[Tensor, Sequence[float]], Tensor]] = {
    QUATERNION: lambda values, numbers: _unit(values),
    ROTATION: lambda values, numbers: _orthonormal(values),
    POSE: _pose,
    CATEGORY: _one_of_each,
    BINARY: lambda values, numbers: torch.isin(values[:, 0], values.new_tensor(numbers)),
}
"""Whether each of the rows ``(time, column)`` is of a kind with the numbers of its group, ``(time,)``."""
_EXPECTED = {
    QUATERNION: "quaternions of norm 1",
    ROTATION: "orthonormal rows with determinant 1",
    POSE: "homogeneous matrices of rotations, with the last row 0 0 0 1",
    CATEGORY: "one-hot columns",
    BINARY: "{} or {}",
}


def _moves(values: Tensor, least: int = 1) -> bool:
    """Whether at least some columns ``(time, n)`` vary."""
    return int((values.amax(dim=0) - values.amin(dim=0) > STILL).sum()) >= least


def _named(names: Sequence[str]) -> bool:
    """Whether names of four columns are those of a quaternion."""
    letters = sorted(name.lower().strip("_. ")[-1:] for name in names)
    return letters == ["w", "x", "y", "z"] and all("q" in name.lower() or "rot" in name.lower() for name in names)


def _is_quaternion(paths: Paths, names: Sequence[str]) -> bool:
    """Whether columns ``(time, 4)`` of norm 1 are quaternions: by names, changes of sign, or no part of constant norm."""
    every = paths.states
    if not _moves(every, 2):
        return False
    if bool(((every[1:] * every[:-1]).sum(dim=-1) < -0.5)[paths.within].any()):
        return True
    if _named(names):
        return True
    squares = every.square()
    subsets = [[column] for column in range(4)] + [[0, column] for column in range(1, 4)]
    varied = all(float(squares[:, subset].sum(dim=1).std()) > STILL for subset in subsets)
    return varied and _moves(every, 4) and bool((every < -STILL).any()) and bool((every > STILL).any())


def _one_hot(every: Tensor, first: int, most: int, declared: bool = False) -> int:
    """Number of adjacent columns from ``first`` on, at most ``most``, that are one-hot; 0 without any.

    A proposed group varies, and begins with a column that is used; a declared group includes columns that are never used.
    """
    columns = every[:, first : first + most]
    zero_or_one = ((columns == 0) | (columns == 1)).all(dim=0).tolist()
    width = next((at for at, binary in enumerate(zero_or_one) if not binary), len(zero_or_one))
    sums = columns[:, :width].cumsum(dim=1)
    sizes = [size for size in range(2, width + 1) if bool((sums[:, size - 1] == 1).all())]
    if declared or not sizes:
        return max(sizes, default=0)
    used = columns[:, : sizes[0]].any(dim=0)
    return sizes[0] if bool(used[0]) and int(used.sum()) > 1 else 0


def _rows(quaternions: Tensor) -> Tensor:
    """First two rows ``(..., 6)`` of the rotation matrices of quaternions ``(..., 4)``, scalar first."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    first = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
    second = (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
    return torch.stack((*first, *second), dim=-1)


def _matrix(rows: Tensor) -> Tensor:
    """Rotation matrices ``(..., 3, 3)`` from two rows ``(..., 6)`` by the Gram-Schmidt process."""
    first = torch.nn.functional.normalize(rows[..., :3], dim=-1)
    rest = rows[..., 3:6]
    second = torch.nn.functional.normalize(rest - (first * rest).sum(dim=-1, keepdim=True) * first, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-2)


def _quaternion(matrices: Tensor) -> Tensor:
    """Quaternions ``(..., 4)``, scalar first, of rotation matrices ``(..., 3, 3)``, by the largest component."""
    m = matrices.flatten(-2).unbind(-1)
    diagonal = (1 + m[0] + m[4] + m[8], 1 + m[0] - m[4] - m[8], 1 - m[0] + m[4] - m[8], 1 - m[0] - m[4] + m[8])
    a, b, c = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    d, e, f = m[3] + m[1], m[2] + m[6], m[7] + m[5]
    candidates = torch.stack(
        [
            torch.stack(row, dim=-1)
            for row in ((diagonal[0], a, b, c), (a, diagonal[1], d, e), (b, d, diagonal[2], f), (c, e, f, diagonal[3]))
        ],
        dim=-2,
    )
    largest = torch.stack(diagonal, dim=-1).argmax(dim=-1)
    chosen = candidates.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    return torch.nn.functional.normalize(chosen, dim=-1)


def _signed(quaternions: Tensor, component: int, sign: float) -> Tensor:
    """Quaternions ``(..., time, 4)`` whose component has the sign at the first time, and that change sign nowhere after."""
    start = torch.where(quaternions[..., :1, component] * sign < 0, -1.0, 1.0)
    steps = (quaternions[..., 1:, :] * quaternions[..., :-1, :]).sum(dim=-1)
    signs = torch.cat((start, torch.where(steps < 0, -1.0, 1.0)), dim=-1).cumprod(dim=-1)
    return quaternions * signs[..., None].to(quaternions)
