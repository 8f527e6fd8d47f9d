"""Acclaim skeletons (ASF) and motion (AMC): a bone of length l and direction d rotates by ``R = parent R * C * M * C^-1``, with
axis C and degrees of freedom M, and ends at ``l * R d`` from the end of its parent (M. Lander, Working with motion capture file
formats, 1998). Rotations named XYZ apply x first: ``Rz Ry Rx``.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.files import most_bytes, read_text

LARGEST = 1e6
"""Maximum magnitude of a number in a file: a length, or an angle in degrees."""

INCH = 0.0254  # Metres. Lengths in the database are inches after division by length in the skeleton's units.
ROOT = "root"
JOINT_BONES = (
    "rhipjoint", "rfemur", "rtibia", "lhipjoint", "lfemur", "ltibia", "rclavicle", "rhumerus", "rradius", "lclavicle", "lhumerus",
    "lradius", "lowerneck", "head",
)  # fmt: skip
"""Bones whose ends are the joints, in their order."""
THORAX = "thorax"
_NUMBERS = {"direction": 3, "length": 1, "axis": 3}  # Count of numbers per key of a bone
_CHANNELS: tuple[str, ...] = ("TX", "TY", "TZ", "RX", "RY", "RZ")


@dataclass(frozen=True)
class Bone:
    """A bone in the rest pose."""

    parent: str  # name of a bone, or "root"
    reach: NDArray[np.float64]  # (3,) from start to end, in the file's units
    axis: Rotation  # of the bone's axes relative to the world
    dof: tuple[str, ...]  # degrees of freedom in the order of the motion's numbers, such as ("rx", "rz")


@dataclass(frozen=True)
class Skeleton:
    """Body of a subject."""

    metres: float  # per unit of the file
    order: tuple[str, ...]  # of the root's numbers, such as ("TX", "TY", "TZ", "RX", "RY", "RZ")
    position: NDArray[np.float64]  # (3,) of the root in the rest pose, in the file's units
    orientation: Rotation  # of the root in the rest pose
    bones: dict[str, Bone]  # by name, parents first

    def joints(self, motion: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Joint positions ``(frame, 14, 3)`` in metres, y up, of a motion of :func:`read_amc`; other bones are at rest."""
        channels = [name.lower() for name in self.order]
        moved = np.stack([motion[ROOT][:, channels.index(name)] for name in ("tx", "ty", "tz")], axis=1)
        turned = _turns(motion[ROOT], channels, "".join(name[1] for name in channels if name[0] == "r"))
        ends = {ROOT: self.position + moved}
        turns = {ROOT: turned * self.orientation}
        for name, bone in self.bones.items():
            turn = turns[bone.parent]
            if bone.dof and name in motion:
                turn = turn * bone.axis * _turns(motion[name], bone.dof) * bone.axis.inv()
            turns[name] = turn
            ends[name] = ends[bone.parent] + turn.apply(bone.reach)
        return np.stack([ends[name] for name in JOINT_BONES], axis=1) * self.metres


def _turns(values: NDArray[np.float64], channels: Sequence[str], order: str = "xyz") -> Rotation:
    """Rotations ``(frame,)`` about the axes of ``order``, in this order, from degrees ``(frame, channel)``."""
    zero = np.zeros(len(values))
    angles = [values[:, list(channels).index(f"r{axis}")] if f"r{axis}" in channels else zero for axis in order]
    return Rotation.from_euler(order, np.stack(angles, axis=1), degrees=True)


def read_asf(path: Path) -> Skeleton:
    """Read a skeleton; raise a ``UserError`` with file and line if the file is malformed or not from the database."""
    lines = _Lines(path)
    length, degrees, section, order = 1.0, True, "", _CHANNELS
    position, angles, root_order = np.zeros(3), np.zeros(3), "XYZ"
    bones: dict[str, Bone] = {}
    parents: dict[str, str] = {}
    bone: dict[str, list[str]] = {}
    for words in lines:
        key = words[0].lower()
        if key.startswith(":"):
            section = key
        elif section == ":units" and key == "length":
            length = lines.number(words, 1)
        elif section == ":units" and key == "angle":
            degrees = lines.word(words, 1).lower().startswith("deg")
        elif section == ":root" and key == "order":
            order = tuple(word.upper() for word in words[1:])
            lines.check(sorted(order) == sorted(_CHANNELS), "TX TY TZ RX RY RZ in some order", words)
        elif section == ":root" and key == "axis":
            root_order = lines.word(words, 1)
        elif section == ":root" and key == "position":
            position = lines.numbers(words[1:], 3)
        elif section == ":root" and key == "orientation":
            angles = lines.numbers(words[1:], 3)
        elif section == ":bonedata":
            if key == "end":
                bones |= _bone(lines, bone, degrees)
            elif key in _NUMBERS:
                lines.numbers(words[1 : 1 + _NUMBERS[key]], _NUMBERS[key])
            bone = {} if key in ("begin", "end") else bone | {key: words[1:]}
        elif section == ":hierarchy" and key not in ("begin", "end"):
            parents |= dict.fromkeys(words[1:], words[0])
    require(length > 0, f"{path}: key 'length'", "a positive number", f"{length:g}")
    for name in JOINT_BONES:
        require(name in bones, str(path), "a skeleton of the CMU database", f"a skeleton without the bone {name!r}")
    orientation = _rest(lines, angles, root_order, degrees)
    return Skeleton(INCH / length, order, position, orientation, _ordered(path, bones, parents))


def _bone(lines: "_Lines", fields: dict[str, list[str]], degrees: bool) -> dict[str, Bone]:
    for key in ("name", "direction", "length", "axis"):
        lines.check(key in fields, f"a bone with name, direction, length and axis (no {key!r} here)", ["end"])
    direction = lines.numbers(fields["direction"], 3)
    norm = float(np.linalg.norm(direction))
    turn = _rest(lines, lines.numbers(fields["axis"][:3], 3), lines.word(fields["axis"], 3), degrees)
    dof = tuple(word.lower() for word in fields.get("dof", ()))
    unknown = sorted(set(dof) - {"rx", "ry", "rz"})
    lines.check(not unknown, "degrees of freedom rx, ry or rz", unknown)
    reach = direction * (lines.number(fields["length"], 0) / norm if norm > 0 else 0.0)
    return {lines.word(fields["name"], 0): Bone(ROOT, reach, turn, dof)}


def _rest(lines: "_Lines", angles: NDArray[np.float64], order: str, degrees: bool) -> Rotation:
    lines.check(sorted(order.lower()) == ["x", "y", "z"], "an order of axes such as XYZ", [order])
    by_axis = dict(zip("xyz", angles, strict=True))
    return Rotation.from_euler(order.lower(), [by_axis[letter] for letter in order.lower()], degrees=degrees)


def _ordered(path: Path, bones: dict[str, Bone], parents: dict[str, str]) -> dict[str, Bone]:
    """Bones with their parents, parents first."""
    ordered: dict[str, Bone] = {}
    while len(ordered) < len(bones):
        ready = [name for name in bones if name not in ordered and (parents.get(name) == ROOT or parents.get(name) in ordered)]
        lost = next(name for name in bones if name not in ordered)
        require(ready, f"{path}: section ':hierarchy'", f"the parents of {lost!r}, up to the root", "no such bones")
        ordered |= {name: replace(bones[name], parent=parents[name]) for name in ready}
    return ordered


def read_amc(path: Path, skeleton: Skeleton) -> dict[str, NDArray[np.float64]]:
    """Read a motion: of the root ``(frame, 6)`` and of each bone ``(frame, dof)``, in degrees.

    Raise a ``UserError`` with file and line if the file is malformed, of another skeleton, or without frames.
    """
    lines = _Lines(path)
    expected = {ROOT: len(skeleton.order)} | {name: len(bone.dof) for name, bone in skeleton.bones.items()}
    values: dict[str, list[list[float]]] = {}
    frames, scale = 0, 1.0
    for words in lines:
        name = words[0]
        if name.startswith(":"):
            scale = math.degrees(1.0) if name.upper() == ":RADIANS" else scale
            continue
        if len(words) == 1 and name.isdigit():
            _complete(lines, values, frames)
            frames += 1
            continue
        lines.check(name in expected, "a bone of the skeleton", [name], "; is it of another subject?")
        count = expected[name]
        lines.check(len(words) - 1 == count, f"{count} numbers for {name!r}", words, "; is it of another subject?")
        rows = values.setdefault(name, [])
        lines.check(len(rows) == frames - 1, "a frame's number before its bones, and each bone once", words)
        rows.append(lines.floats(words[1:], count))
    _complete(lines, values, frames)
    require(frames, str(path), "frames of motion", "none")
    require(ROOT in values, str(path), "the root's motion", "none")
    motion = {name: np.array(rows) for name, rows in values.items()}
    if scale != 1.0:
        rotations = [place for place, channel in enumerate(skeleton.order) if channel.startswith("R")]
        for name, array in motion.items():
            array[:, rotations if name == ROOT else slice(None)] *= scale
    return motion


def _complete(lines: "_Lines", values: dict[str, list[list[float]]], frames: int) -> None:
    for name, rows in values.items():
        lines.check(len(rows) == frames, f"{name!r} in every frame", [f"frame {frames} without it"])


class _Lines:
    """Words per line of a text file, without comments and empty lines."""

    def __init__(self, path: Path) -> None:
        self.path, self.line = path, 0
        self.lines = read_text(path, "recording", most_bytes(), encoding="latin-1").splitlines()

    def __iter__(self) -> Iterator[list[str]]:
        for number, text in enumerate(self.lines, start=1):
            self.line = number
            if words := text.split("#")[0].split():
                yield words

    def check(self, condition: bool, expected: str, words: Sequence[str], hint: str = "") -> None:
        """Check the line read last."""
        if not condition:
            raise UserError(f"{self.path}: line {self.line}: expected {expected}, found {' '.join(words)[:60]!r}{hint}")

    def word(self, words: Sequence[str], place: int) -> str:
        """Word at a position."""
        self.check(len(words) > place, "more words", words)
        return words[place]

    def number(self, words: Sequence[str], place: int) -> float:
        """Word at a position as a number."""
        return float(self.numbers([self.word(words, place)], 1)[0])

    def numbers(self, words: Sequence[str], count: int) -> NDArray[np.float64]:
        """Words as ``count`` finite numbers."""
        return np.array(self.floats(words, count))

    def floats(self, words: Sequence[str], count: int) -> list[float]:
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        self.check(len(values) == count and all(abs(value) <= LARGEST for value in values), expected, words)
        return values
