"""The body: 14 joints, its bones, its mirror image.

Joints are those of the paper's renderer (jutanke/mocap), the last two the lower neck's end and the head's. In every frame the
middle of the hips is the origin, z is up, +y is where the hips face and +x the person's right.
"""

import torch
from torch import Tensor

JOINTS = (
    "RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "Neck",
    "HeadTop",
)  # fmt: skip
COLUMNS = tuple(f"{joint}.{axis}" for joint in JOINTS for axis in "xyz")
"""Columns of a state, in metres."""
FPS = 30
"""Frames a second."""
HORIZON = 32
"""Frames in a plan."""

R_HIP, R_KNEE, R_ANKLE, L_HIP, L_KNEE, L_ANKLE, R_SHOULDER, R_ELBOW, R_WRIST, L_SHOULDER, L_ELBOW, L_WRIST, NECK, HEAD = range(14)
RIGHT = (R_HIP, R_KNEE, R_ANKLE, R_SHOULDER, R_ELBOW, R_WRIST)
LEFT = (L_HIP, L_KNEE, L_ANKLE, L_SHOULDER, L_ELBOW, L_WRIST)
"""The same joints of the other side, in the same order."""
MIDDLE = (NECK, HEAD)
HIPS, SHOULDERS, WRISTS = (R_HIP, L_HIP), (R_SHOULDER, L_SHOULDER), (R_WRIST, L_WRIST)
KNEES, ANKLES, ELBOWS = (R_KNEE, L_KNEE), (R_ANKLE, L_ANKLE), (R_ELBOW, L_ELBOW)

BONES = (
    (R_HIP, R_KNEE), (R_KNEE, R_ANKLE), (R_HIP, L_HIP), (L_HIP, L_KNEE), (L_KNEE, L_ANKLE), (R_HIP, R_SHOULDER),
    (R_SHOULDER, R_ELBOW), (R_ELBOW, R_WRIST), (L_HIP, L_SHOULDER), (L_SHOULDER, L_ELBOW), (L_ELBOW, L_WRIST),
    (L_SHOULDER, NECK), (NECK, R_SHOULDER), (NECK, HEAD),
)  # fmt: skip
"""Lines to draw."""
RIGID = ((0, 1), (1, 2), (0, 3), (3, 4), (4, 5), (6, 7), (7, 8), (9, 10), (10, 11))
"""Those of :data:`BONES` between whose ends the skeleton has one bone: their lengths never change."""

MIRROR = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8, 12, 13)
"""Where each joint of the mirror image comes from."""


def _columns(*joints: int) -> tuple[int, ...]:
    return tuple(3 * joint + axis for joint in sorted(joints) for axis in range(3))


GROUPS = {
    "arms": _columns(*ELBOWS, *WRISTS),
    "legs": _columns(*HIPS, *KNEES, *ANKLES),
    "trunk": _columns(*SHOULDERS, *MIDDLE),
}
"""Columns of each part of the body; every column is in one."""


def as_joints(states: Tensor) -> Tensor:
    """States ``(..., 42)`` as joints ``(..., 14, 3)``."""
    return states.unflatten(-1, (len(JOINTS), 3))


def mirrored(states: Tensor) -> Tensor:
    """The same motion ``(..., 42)`` with left and right exchanged."""
    joints = as_joints(states)[..., list(MIRROR), :]
    return (joints * joints.new_tensor((-1.0, 1.0, 1.0))).flatten(-2)


def bone_lengths(states: Tensor) -> Tensor:
    """Lengths ``(..., bone)`` in metres of :data:`BONES` in states ``(..., 42)``."""
    joints = as_joints(states)
    ends = torch.tensor(BONES).T
    return torch.linalg.vector_norm(joints[..., ends[0], :] - joints[..., ends[1], :], dim=-1)
