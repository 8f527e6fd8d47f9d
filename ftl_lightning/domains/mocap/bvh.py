"""BVH files, read and written: a position of a joint per frame replaces its offset, as in Blender."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.asf_amc import INCH, LARGEST, THORAX, Skeleton
from ftl_lightning.domains.mocap.skeleton import FPS, as_joints, standing_poses
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import read_text

Numbers = NDArray[np.float64]
FASTEST, SLOWEST = 1e-4, 1.0
"""Range of seconds between frames."""
MOST_NODES = 1000
"""Maximum number of joints and end sites; a hand with all its fingers has 20."""
MOST_PLACES = 2_500_000
"""Maximum number of positions, frames times nodes: 240 MB of rotations."""
MOST_NUMBERS = 5_000_000
"""Maximum number of numbers, frames times channels, which are parsed in a second; an hour at 30 frames a second, or more."""
MOST_FRAMES = 100_000
"""Maximum frames of a motion at :data:`~ftl_lightning.domains.mocap.skeleton.FPS`, almost an hour."""
END = "EndSite"  # Prefix of the name of an end site, before its joint's name
_POSITIONS = {f"{axis}position": number for number, axis in enumerate("XYZ")}
_ROTATIONS = {f"{axis}rotation": number for number, axis in enumerate("XYZ")}


@dataclass(frozen=True)
class Node:
    """Joint or end site."""

    name: str  # of the joint; of an end site, see END
    parent: int  # index; -1 for the root
    offset: Numbers  # (3,) from the parent, in the file's unit
    channels: tuple[str, ...]  # names of the node's numbers in a frame, in order


@dataclass(frozen=True)
class Motion:
    """Skeleton and motion of a BVH file."""

    nodes: tuple[Node, ...]  # parents first; the root is the first
    frames: Numbers  # (frame, channel), the nodes' numbers in sequence, angles in degrees
    seconds: float  # between frames

    @property
    def names(self) -> frozenset[str]:
        """Names of all nodes."""
        return frozenset(node.name for node in self.nodes)

    def places(self, wanted: Sequence[str], offsets: Mapping[str, Numbers] | None = None) -> Numbers:
        """Positions of the ``wanted`` nodes ``(frame, node, 3)``, in the file's unit and axes; ``offsets`` replace the file's."""
        count, column = len(self.frames), 0
        positions: dict[str, Numbers] = {}
        at: list[Numbers] = []
        turned: list[Numbers] = []
        for node in self.nodes:
            place = np.tile((offsets or {}).get(node.name, node.offset), (count, 1))
            turn = np.broadcast_to(np.eye(3), (count, 3, 3))
            for channel in node.channels:
                values = self.frames[:, column]
                column += 1
                if channel in _POSITIONS:
                    place[:, _POSITIONS[channel]] = values
                else:
                    turn = turn @ _turned(_ROTATIONS[channel], np.deg2rad(values))
            if node.parent >= 0:
                place = at[node.parent] + np.einsum("tij,tj->ti", turned[node.parent], place)
                turn = turned[node.parent] @ turn
            at.append(place)
            turned.append(turn)
            positions.setdefault(node.name, place)
        return np.stack([positions[name] for name in wanted], axis=1)


def _turned(axis: int, angles: Numbers) -> Numbers:
    """Rotations ``(frame, 3, 3)`` about an axis by angles ``(frame,)`` in radians."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    turns[:, first, first] = turns[:, second, second] = np.cos(angles)
    turns[:, second, first] = np.sin(angles)
    turns[:, first, second] = -turns[:, second, first]
    return turns


def read_motion(path: Path) -> Motion:
    """Read a motion; raise a ``UserError`` with the path for a file that is damaged or larger than any motion."""
    text = read_text(path, "BVH")
    try:
        hierarchy, mark, rest = text.partition("MOTION")
        _check(mark, "no line MOTION")
        nodes = tuple(_nodes(word[0] for word in re.finditer(r"\S+", hierarchy)))
        words = rest.split(maxsplit=5)
        keys = [word.lower() for word in (*words[:1], *words[2:4])]
        _check(len(words) > 4 and keys == ["frames:", "frame", "time:"], "no lines 'Frames: N' and 'Frame Time: S' after MOTION")
        count, seconds = int(words[1]), float(words[4])
        place, expected = f"{path}: Frame Time", f"seconds between frames, {FASTEST:g} to {SLOWEST:g}"
        require(FASTEST <= seconds <= SLOWEST, place, expected, short(words[4]))
        channels = sum(len(node.channels) for node in nodes)
        most = min(MOST_PLACES // len(nodes), MOST_NUMBERS // max(channels, 1))
        place, expected = f"{path}: Frames", f"1 to {most} frames of {len(nodes)} joints and end sites"
        require(1 <= count <= most, place, expected, short(words[1]))
        expected = f"motion of at most {MOST_FRAMES} frames at {FPS} a second"
        require(count * seconds * FPS <= MOST_FRAMES, str(path), expected, f"{count * seconds * FPS:.0f}: {count} of {seconds:g} s")
        numbers = words[5].strip() if len(words) > 5 else ""
        _check(2 * count * channels - 1 <= len(numbers), f"{len(numbers)} letters for {count} frames of {channels} numbers")
        foreign = re.search(r"[^-+.0-9eE\s]\S*", numbers)
        _check(not foreign, f"{foreign and foreign[0]!r} where a number was expected")
        values = np.fromstring(numbers, sep=" ")  # a list of all words takes gigabytes
        _check(len(values) == count * channels, f"{len(values)} numbers for {count} frames of {channels}")
        within = (np.abs(part) <= LARGEST for part in (values, *(node.offset for node in nodes)))
        _check(all(part.all() for part in within), f"numbers that are not finite, or beyond {LARGEST:g}")
    except ValueError as error:
        raise UserError(f"{path}: expected a BVH file, found a damaged one ({short(str(error), 100)})") from error
    return Motion(nodes, values.reshape(count, channels), seconds)


def _check(condition: object, damage: str) -> None:
    if not condition:
        raise ValueError(damage)


def _nodes(words: Iterator[str]) -> Iterable[Node]:
    """Nodes from the words of a file's hierarchy; a damaged hierarchy raises a ``ValueError``."""
    _check(next(words, "") == "HIERARCHY", "no line HIERARCHY")
    nodes: list[Node] = []
    path: list[int] = []  # from the root to the open node
    for word in words:
        _check(len(nodes) <= MOST_NODES, f"more than {MOST_NODES} joints")
        if word == "}" and path:
            path.pop()
            continue
        joint = word in ("ROOT", "JOINT", "End") and (word == "ROOT") != bool(nodes) and bool(nodes) == bool(path)
        _check(joint, f"{word!r} where a joint was expected")
        name = next(words, "")
        parent = path[-1] if path else -1
        _check([next(words, ""), next(words, "")] == ["{", "OFFSET"], f"no offset of {name!r}")
        offset = np.array([float(next(words, "")) for _ in range(3)])
        channels: tuple[str, ...] = ()
        if word != "End":
            _check(next(words, "") == "CHANNELS", f"no channels of {name!r}")
            channels = tuple(next(words, "") for _ in range(min(int(next(words, "")), 7)))
            unknown = set(channels) - {*_POSITIONS, *_ROTATIONS}
            _check(not unknown, f"channel {min(unknown, default='')!r} of {name!r}")
        path.append(len(nodes))
        nodes.append(Node(f"{END}{nodes[parent].name}" if word == "End" else name, parent, offset, channels))
    _check(nodes and not path, "brackets that do not close")
    return nodes


METRES = INCH / 0.45  # Metres per unit of the conversion, which is that of the ASF files
NODES = (
    "RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightArm", "RightForeArm", "RightHand", "LeftArm",
    "LeftForeArm", "LeftHand", "Neck1", "EndSiteHead",
)  # fmt: skip
"""Nodes at the joints, in their order."""
_AFTER_THORAX = ("Neck", "LeftShoulder", "RightShoulder")
_BELOW = "Spine1"
CONVERTED = (*NODES, *_AFTER_THORAX, _BELOW)


def read_bvh(path: Path, skeleton: Skeleton | None) -> tuple[NDArray[np.float64], int]:
    """Joint positions ``(frame, 14, 3)`` in metres, y up, and frames per second, of a file of the conversion.

    Raise a ``UserError`` with the path if the file is damaged or not of the conversion.
    """
    motion, expected = read_motion(path), "the MotionBuilder-friendly conversion of the database"
    for name in CONVERTED:
        require(name in motion.names, str(path), expected, f"a skeleton without {name!r}")
    return converted(motion, skeleton), round(1 / motion.seconds)


def converted(motion: Motion, skeleton: Skeleton | None) -> NDArray[np.float64]:
    """Joints ``(frame, 14, 3)`` in metres of B. Hahne's MotionBuilder-friendly conversion of the database (cgspeed).

    The conversion omits the thorax: neck and collars start at its base. It is restored from the subject's ASF, if available, else
    replaced by the bone below it. The first frame, a T-pose, is skipped.
    """
    offsets = {node.name: node.offset for node in motion.nodes}
    thorax = offsets[_BELOW] if skeleton is None else skeleton.bones[THORAX].reach
    put_back = {name: np.asarray(thorax, dtype=np.float64) for name in _AFTER_THORAX if not np.any(offsets[name])}
    return motion.places(NODES, put_back)[1:] * METRES


HIPS = len(skeleton.JOINTS)  # Index of the middle of the hips, after those of the joints
TIP = 0.08  # Length in metres of the head's visible bone
SHORTEST = 1e-6  # Minimum length in metres of a bone with a direction; shorter bones do not rotate


class Joint(NamedTuple):
    """Joint of a BVH file written here."""

    name: str  # in the MotionBuilder-friendly conversion
    parent: int  # index in TREE; -1 for the root
    place: int  # index of the joint's position
    tip: int | None  # index of the joint at the end of the bone; None without rotation
    free: bool = False  # whether the joint has a position per frame
    end: bool = False  # whether the bone ends in an end site


TREE = (
    Joint("Hips", -1, HIPS, skeleton.R_HIP, free=True),
    Joint("RightUpLeg", 0, skeleton.R_HIP, skeleton.R_KNEE),
    Joint("RightLeg", 1, skeleton.R_KNEE, skeleton.R_ANKLE, end=True),
    Joint("LeftUpLeg", 0, skeleton.L_HIP, skeleton.L_KNEE),
    Joint("LeftLeg", 3, skeleton.L_KNEE, skeleton.L_ANKLE, end=True),
    Joint("Spine", 0, HIPS, skeleton.NECK),
    Joint("Neck", 5, skeleton.NECK, skeleton.HEAD, free=True),
    Joint("Head", 6, skeleton.HEAD, None, free=True, end=True),
    Joint("RightArm", 5, skeleton.R_SHOULDER, skeleton.R_ELBOW, free=True),
    Joint("RightForeArm", 8, skeleton.R_ELBOW, skeleton.R_WRIST, end=True),
    Joint("LeftArm", 5, skeleton.L_SHOULDER, skeleton.L_ELBOW, free=True),
    Joint("LeftForeArm", 10, skeleton.L_ELBOW, skeleton.L_WRIST, end=True),
)
"""Joints in depth-first order."""
_NAMES = {joint.place: joint.name for joint in TREE if joint.place != HIPS}
_NAMES |= {joint.tip: f"{END}{joint.name}" for joint in TREE if joint.end and joint.tip is not None}
EXPORTED = tuple(_NAMES[number] for number in range(len(skeleton.JOINTS)))
"""Joints and end sites of the file at the body's joints, in their order."""
_PLACE, _TURN = "Xposition Yposition Zposition", "Zrotation Yrotation Xrotation"


def bvh(states: Tensor) -> str:
    """Convert a motion ``(frame, 42)`` or ``(frame, 46)`` to the text of a BVH file.

    Raises:
        UserError: for numbers that are not finite.

    In the file y is up, the person faces +z, +x is the person's left, and the unit is the metre. The root is the middle of the
    hips; without root see :func:`_grounded`. Joints rotate; joints without rigid bone to the parent (shoulders, neck, head) also
    have a position per frame, as in Blender. Bones have the lengths of the first frame and the rest directions of a standing pose.
    Rotations between frames are minimal, so that no arm spins about its axis.
    """
    require(states.isfinite().all(), "export", "motion of finite numbers", "others; draw it again with another --seed")
    places = _places(states)
    root = places[:, HIPS] if skeleton.has_root(states) else _grounded(places)
    (rest,) = _places(standing_poses(1, torch.Generator().manual_seed(0)))
    turns: list[Numbers] = []  # of each joint in the file's axes, (frame, 3, 3)
    offsets, ends, rows = [], [], []
    for joint in TREE:
        parent = HIPS if joint.parent < 0 else TREE[joint.parent].place
        above = turns[joint.parent] if joint.parent >= 0 else np.broadcast_to(np.eye(3), (len(places), 3, 3))
        moved = _seen(above, places[:, joint.place] - places[:, parent]) if joint.parent >= 0 else root
        offsets.append(_sized(rest[joint.place] - rest[parent], moved[0]) if joint.parent >= 0 else np.zeros(3))
        turn = np.broadcast_to(np.eye(3), (len(places), 3, 3))
        ends.append(np.array([0, TIP, 0]))
        if joint.tip is not None:
            bone, at_rest = _seen(above, places[:, joint.tip] - places[:, joint.place]), rest[joint.tip] - rest[joint.place]
            turn = _followed(at_rest, bone)
            ends[-1] = _sized(at_rest, bone[0])
        turns.append(above @ turn)
        rows += [moved, _angles(turn)] if joint.free else [_angles(turn)]
    lines = ["HIERARCHY", *_hierarchy(0, offsets, ends), "MOTION", f"Frames: {len(places)}", f"Frame Time: {1 / FPS:.6f}"]
    lines += [_line(row) for row in np.concatenate(rows, axis=1)]
    return "\n".join(lines) + "\n"


def _places(states: Tensor) -> Numbers:
    """Positions of the joints and the middle of the hips ``(frame, 15, 3)``, in the file's axes."""
    states = states.detach().cpu().double()
    joints = (skeleton.in_space if skeleton.has_root(states) else as_joints)(states).numpy()
    joints = np.stack((-joints[..., 0], joints[..., 2], joints[..., 1]), axis=-1)
    middle = joints[:, list(skeleton.HIPS)].mean(axis=1, keepdims=True)
    return np.concatenate((joints, middle), axis=1)


def _grounded(places: Numbers) -> Numbers:
    """Positions of the root ``(frame, 3)`` over the ground, y = 0: the lower ankle of two frames is on it and does not slide.

    States have no root. Jumps stay on the ground, and the hips do not turn.
    """
    ankles = places[:, list(skeleton.ANKLES)]
    lower = (ankles[1:, :, 1] + ankles[:-1, :, 1]).argmin(axis=1)
    steps = np.diff(ankles, axis=0)[np.arange(len(lower)), lower]
    root = -np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))
    root[:, 1] = -ankles[..., 1].min(axis=1)
    return root


def _seen(turns: Numbers, ways: Numbers) -> Numbers:
    """Vectors ``(frame, 3)`` in frames with rotations ``(frame, 3, 3)``."""
    return np.einsum("tji,tj->ti", turns, ways)


def _sized(way: Numbers, like: Numbers) -> Numbers:
    """A vector ``(3,)`` scaled to the length of ``like``; ``like`` if it has no direction."""
    length = float(np.linalg.norm(way))
    return way * (np.linalg.norm(like) / length) if length > SHORTEST else like


def _followed(rest: Numbers, bone: Numbers) -> Numbers:
    """Rotations ``(frame, 3, 3)`` from a bone at rest ``(3,)`` to its directions ``(frame, 3)``, each nearest to the last."""
    turn, before, turns = np.eye(3), rest / np.linalg.norm(rest), []
    for way in bone:
        if (length := np.linalg.norm(way)) > SHORTEST:
            turn, before = _smallest(before, way / length) @ turn, way / length
        turns.append(turn)
    return np.stack(turns)


def _smallest(start: Numbers, end: Numbers) -> Numbers:
    """Smallest rotation ``(3, 3)`` between two directions."""
    cosine = float(start @ end)
    if cosine < -1 + 1e-9:  # 180 degrees, about any orthogonal axis
        across = np.cross(start, np.eye(3)[np.abs(start).argmin()])
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    x, y, z = np.cross(start, end)
    skew = np.array(((0, -z, y), (z, 0, -x), (-y, x, 0)))
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def _angles(turns: Numbers) -> Numbers:
    """Degrees about z, then y, then x ``(frame, 3)`` of rotations ``(frame, 3, 3)``, unwrapped."""
    y = np.arcsin(np.clip(-turns[:, 2, 0], -1, 1))
    upright = np.abs(turns[:, 2, 0]) > 1 - 1e-12  # gimbal lock: all of the rotation is z
    z = np.where(upright, np.arctan2(-turns[:, 0, 1], turns[:, 1, 1]), np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))
    x = np.where(upright, 0.0, np.arctan2(turns[:, 2, 1], turns[:, 2, 2]))
    return np.unwrap(np.rad2deg(np.stack((z, y, x), axis=1)), axis=0, period=360)


def _hierarchy(number: int, offsets: list[Numbers], ends: list[Numbers]) -> list[str]:
    """Lines of a joint and its descendants."""
    joint = TREE[number]
    channels = f"6 {_PLACE} {_TURN}" if joint.free else f"3 {_TURN}"
    inside = [f"OFFSET {_line(offsets[number])}", f"CHANNELS {channels}"]
    inside += [line for child, node in enumerate(TREE) if node.parent == number for line in _hierarchy(child, offsets, ends)]
    if joint.end:
        inside += ["End Site", "{", f"\tOFFSET {_line(ends[number])}", "}"]
    return [f"{'JOINT' if number else 'ROOT'} {joint.name}", "{", *(f"\t{line}" for line in inside), "}"]


def _line(numbers: Numbers) -> str:
    return " ".join(f"{number:.6f}" for number in np.round(numbers, 6) + 0.0)
