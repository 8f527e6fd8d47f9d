"""BVH files: skeleton, rotations per frame, and forward kinematics.

A joint may also have a position per frame, which replaces its offset, as in Blender.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.files import read_text

Numbers = NDArray[np.float64]
END = "EndSite"
"""Prefix of the name of an end site, before its joint's name."""
_POSITIONS = {f"{axis}position": number for number, axis in enumerate("XYZ")}
_ROTATIONS = {f"{axis}rotation": number for number, axis in enumerate("XYZ")}


@dataclass(frozen=True)
class Node:
    """Joint or end site.

    Attributes:
        name: of the joint; of an end site, see :data:`END`.
        parent: index of the parent; -1 for the root.
        offset: ``(3,)`` from the parent, in the file's unit.
        channels: names of the node's numbers in a frame, in order.
    """

    name: str
    parent: int
    offset: Numbers
    channels: tuple[str, ...]


@dataclass(frozen=True)
class Motion:
    """Content of a file.

    Attributes:
        nodes: parents first; the root is the first.
        frames: ``(frame, channel)``, the nodes' numbers in sequence, angles in degrees.
        seconds: time between frames.
    """

    nodes: tuple[Node, ...]
    frames: Numbers
    seconds: float

    @property
    def names(self) -> frozenset[str]:
        """Names of all nodes."""
        return frozenset(node.name for node in self.nodes)

    def places(self, wanted: Sequence[str], offsets: Mapping[str, Numbers] | None = None) -> Numbers:
        """Positions of nodes ``(frame, node, 3)``, in the file's unit and axes.

        Args:
            wanted: node names.
            offsets: replacements of the file's offsets, by node name.
        """
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
    """Read a motion.

    Raises:
        UserError: with the path, for a damaged file.
    """
    text = read_text(path, "BVH")
    try:
        skeleton, mark, rest = text.partition("MOTION")
        if not mark:
            raise ValueError("no line MOTION")
        nodes = tuple(_nodes(iter(skeleton.split())))
        words = rest.split(maxsplit=5)
        if len(words) < 5 or [word.lower() for word in (words[0], words[2], words[3])] != ["frames:", "frame", "time:"]:
            raise ValueError("no lines 'Frames: N' and 'Frame Time: S' after MOTION")
        count, seconds = int(words[1]), float(words[4])
        values = np.array(words[5].split() if len(words) > 5 else [], dtype=np.float64)
        channels = sum(len(node.channels) for node in nodes)
        if count < 1 or not 0 < seconds < np.inf:
            raise ValueError(f"{count} frames of {seconds:g} s")
        if len(values) != count * channels:
            raise ValueError(f"{len(values)} numbers for {count} frames of {channels}")
        if not (np.isfinite(values).all() and all(np.isfinite(node.offset).all() for node in nodes)):
            raise ValueError("numbers that are not finite")
    except ValueError as error:
        raise UserError(f"{path}: expected a BVH file, found a damaged one ({short(str(error), 100)})") from error
    return Motion(nodes, values.reshape(count, channels), seconds)


def _nodes(words: Iterator[str]) -> Iterable[Node]:
    """Nodes from the words of a file's hierarchy.

    Raises:
        ValueError: for a damaged hierarchy.
    """
    if next(words, "") != "HIERARCHY":
        raise ValueError("no line HIERARCHY")
    nodes: list[Node] = []
    path: list[int] = []  # from the root to the open node
    for word in words:
        if word == "}" and path:
            path.pop()
            continue
        if word not in ("ROOT", "JOINT", "End") or (word == "ROOT") == bool(nodes) or bool(nodes) != bool(path):
            raise ValueError(f"{word!r} where a joint was expected")
        name = next(words, "")
        parent = path[-1] if path else -1
        if [next(words, ""), next(words, "")] != ["{", "OFFSET"]:
            raise ValueError(f"no offset of {name!r}")
        offset = np.array([float(next(words, "")) for _ in range(3)])
        channels: tuple[str, ...] = ()
        if word != "End":
            if next(words, "") != "CHANNELS":
                raise ValueError(f"no channels of {name!r}")
            channels = tuple(next(words, "") for _ in range(min(int(next(words, "")), 7)))
            if unknown := set(channels) - {*_POSITIONS, *_ROTATIONS}:
                raise ValueError(f"channel {min(unknown)!r} of {name!r}")
        path.append(len(nodes))
        nodes.append(Node(f"{END}{nodes[parent].name}" if word == "End" else name, parent, offset, channels))
    if path or not nodes:
        raise ValueError("brackets that do not close")
    return nodes
