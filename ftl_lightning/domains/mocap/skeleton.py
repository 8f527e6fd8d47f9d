"""Body: 14 joints, bones, mirror image.

Joints are those of the paper's renderer (jutanke/mocap); the last two are the ends of lower neck and head. In every frame the
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
"""Frames per second."""
HORIZON = 32
"""Frames in a plan."""

R_HIP, R_KNEE, R_ANKLE, L_HIP, L_KNEE, L_ANKLE, R_SHOULDER, R_ELBOW, R_WRIST, L_SHOULDER, L_ELBOW, L_WRIST, NECK, HEAD = range(14)
RIGHT = (R_HIP, R_KNEE, R_ANKLE, R_SHOULDER, R_ELBOW, R_WRIST)
LEFT = (L_HIP, L_KNEE, L_ANKLE, L_SHOULDER, L_ELBOW, L_WRIST)
"""Joints of the left side, in the order of the right."""
MIDDLE = (NECK, HEAD)
HIPS, SHOULDERS, WRISTS = (R_HIP, L_HIP), (R_SHOULDER, L_SHOULDER), (R_WRIST, L_WRIST)
KNEES, ANKLES, ELBOWS = (R_KNEE, L_KNEE), (R_ANKLE, L_ANKLE), (R_ELBOW, L_ELBOW)

BONES = (
    (R_HIP, R_KNEE), (R_KNEE, R_ANKLE), (R_HIP, L_HIP), (L_HIP, L_KNEE), (L_KNEE, L_ANKLE), (R_HIP, R_SHOULDER),
    (R_SHOULDER, R_ELBOW), (R_ELBOW, R_WRIST), (L_HIP, L_SHOULDER), (L_SHOULDER, L_ELBOW), (L_ELBOW, L_WRIST),
    (L_SHOULDER, NECK), (NECK, R_SHOULDER), (NECK, HEAD),
)  # fmt: skip
"""Drawn lines."""
RIGID = ((0, 1), (1, 2), (0, 3), (3, 4), (4, 5), (6, 7), (7, 8), (9, 10), (10, 11))
"""Lines of :data:`BONES` that are single bones of the skeleton, of constant length."""

MIRROR = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8, 12, 13)
"""Source of each joint in the mirror image."""


def _columns(*joints: int) -> tuple[int, ...]:
    return tuple(3 * joint + axis for joint in sorted(joints) for axis in range(3))


GROUPS = {
    "arms": _columns(*ELBOWS, *WRISTS),
    "legs": _columns(*HIPS, *KNEES, *ANKLES),
    "trunk": _columns(*SHOULDERS, *MIDDLE),
}
"""Columns of each part of the body; each column belongs to a single part."""


def as_joints(states: Tensor) -> Tensor:
    """States ``(..., 42)`` as joints ``(..., 14, 3)``."""
    return states.unflatten(-1, (len(JOINTS), 3))


def mirrored(states: Tensor) -> Tensor:
    """Motion ``(..., 42)`` with left and right exchanged."""
    joints = as_joints(states)[..., list(MIRROR), :]
    return (joints * joints.new_tensor((-1.0, 1.0, 1.0))).flatten(-2)


def bone_lengths(states: Tensor) -> Tensor:
    """Lengths ``(..., bone)`` in metres of :data:`BONES` in states ``(..., 42)``."""
    joints = as_joints(states)
    ends = torch.tensor(BONES).T
    return torch.linalg.vector_norm(joints[..., ends[0], :] - joints[..., ends[1], :], dim=-1)
