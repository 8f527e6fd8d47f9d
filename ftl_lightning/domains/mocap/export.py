"""Export of motion to BVH files, readable by Blender and other animation software.

In the file y is up, the person faces +z, +x is the person's left, and the unit is the metre. The root is the middle of the hips.
Joints rotate; joints without rigid bone to the parent (shoulders, neck, head) also have a position per frame, which replaces their
offset, as in Blender. Ankles and wrists are end sites.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.bvh_file import END
from ftl_lightning.domains.mocap.skeleton import FPS, as_joints
from ftl_lightning.domains.mocap.standing import standing_poses
from ftl_lightning.services.errors import UserError

Numbers = NDArray[np.float64]
HIPS = len(skeleton.JOINTS)
"""Index of the middle of the hips, after those of the joints."""
TIP = 0.08
"""Length in metres of the head's visible bone."""
SHORTEST = 1e-6
"""Minimum length in metres of a bone with a direction; shorter bones do not rotate."""


class Joint(NamedTuple):
    """Joint of the file.

    Attributes:
        name: name in the MotionBuilder-friendly conversion.
        parent: index of the parent in :data:`TREE`; -1 for the root.
        place: index of the joint's position.
        tip: index of the joint at the end of the bone; ``None`` without rotation.
        free: whether the joint has a position per frame.
        end: whether the bone ends in an end site.
    """

    name: str
    parent: int
    place: int
    tip: int | None
    free: bool = False
    end: bool = False


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
_NAMES = {joint.place: joint.name for joint in TREE if joint.place != HIPS} | {
    joint.tip: f"{END}{joint.name}" for joint in TREE if joint.end and joint.tip is not None
}
NODES = tuple(_NAMES[number] for number in range(len(skeleton.JOINTS)))
"""Joints and end sites of the file at the body's joints, in their order."""
_PLACE, _TURN = "Xposition Yposition Zposition", "Zrotation Yrotation Xrotation"


def bvh(states: Tensor) -> str:
    """Convert a motion to the text of a BVH file.

    Bones have the lengths of the first frame and the rest directions of a standing pose. Rotations between frames are minimal, so
    that no arm spins about its axis, not even overhead.

    Args:
        states: ``(frame, 42)`` in metres.

    Raises:
        UserError: for numbers that are not finite.
    """
    if not states.isfinite().all():
        raise UserError("export: expected motion of finite numbers, found others; draw it anew with another --seed")
    places = _places(states)
    (rest,) = _places(standing_poses(1, torch.Generator().manual_seed(0)))
    turns: list[Numbers] = []  # of each joint in the file's axes, (frame, 3, 3)
    offsets, ends, rows = [], [], []
    for joint in TREE:
        parent = HIPS if joint.parent < 0 else TREE[joint.parent].place
        above = turns[joint.parent] if joint.parent >= 0 else np.broadcast_to(np.eye(3), (len(places), 3, 3))
        moved = _seen(above, places[:, joint.place] - places[:, parent]) if joint.parent >= 0 else places[:, HIPS]
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
    joints = as_joints(states.detach().cpu()).double().numpy()
    joints = np.stack((-joints[..., 0], joints[..., 2], joints[..., 1]), axis=-1)
    middle = joints[:, list(skeleton.HIPS)].mean(axis=1, keepdims=True)
    return np.concatenate((joints, middle), axis=1)


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
    for child, node in enumerate(TREE):
        if node.parent == number:
            inside += _hierarchy(child, offsets, ends)
    if joint.end:
        inside += ["End Site", "{", f"\tOFFSET {_line(ends[number])}", "}"]
    return [f"{'JOINT' if number else 'ROOT'} {joint.name}", "{", *(f"\t{line}" for line in inside), "}"]


def _line(numbers: Numbers) -> str:
    return " ".join(f"{number:.6f}" for number in np.round(numbers, 6) + 0.0)
