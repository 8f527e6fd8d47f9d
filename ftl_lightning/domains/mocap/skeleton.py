"""Body: the 14 joints of the paper's renderer (jutanke/mocap), the last two the ends of lower neck and head.

In every frame the middle of the hips is the origin, z is up, +y is where the hips face and +x the person's right. States with root
also have its path, see :data:`ROOT`.
"""

import itertools
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import Feature
from ftl_lightning.services.tensor_file import load_tensors, save_tensors

JOINTS = (
    "RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "Neck",
    "HeadTop",
)  # fmt: skip
COLUMNS = tuple(f"{joint}.{axis}" for joint in JOINTS for axis in "xyz")  # Columns of a state, in metres
ROOT = ("Root.right", "Root.forward", "Root.height", "Root.turn")
"""Columns of the root: since the frame before, displacement of the middle of the hips in metres to the right and forwards of that
frame, and turn to the left in radians; height in metres above the level at which ankles rest on the ground."""
NAME, ROOTED_NAME = "mocap", "mocap_root"
POSE = "pose"  # Observed feature: the joints at the start of a plan, which are the plan's first state
OBSERVED = {POSE: Feature((len(COLUMNS),), state=tuple(range(len(COLUMNS))))}
FPS = 30  # Frames per second
HORIZON = 32  # Frames in a plan

R_HIP, R_KNEE, R_ANKLE, L_HIP, L_KNEE, L_ANKLE, R_SHOULDER, R_ELBOW, R_WRIST, L_SHOULDER, L_ELBOW, L_WRIST, NECK, HEAD = range(14)
RIGHT = (R_HIP, R_KNEE, R_ANKLE, R_SHOULDER, R_ELBOW, R_WRIST)
LEFT = (L_HIP, L_KNEE, L_ANKLE, L_SHOULDER, L_ELBOW, L_WRIST)  # Joints of the left side, in the order of the right
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

MIRROR = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8, 12, 13)  # Source of each joint in the mirror image


def _columns(*joints: int) -> tuple[int, ...]:
    return tuple(3 * joint + axis for joint in sorted(joints) for axis in range(3))


GROUPS = {"arms": _columns(*ELBOWS, *WRISTS), "legs": _columns(*HIPS, *KNEES, *ANKLES), "trunk": _columns(*SHOULDERS, *MIDDLE)}
"""Columns of each part of the body; each column belongs to a single part."""


def as_joints(states: Tensor) -> Tensor:
    """States ``(..., 42)``, or with root ``(..., 46)``, as joints ``(..., 14, 3)`` around the root."""
    return states[..., : len(COLUMNS)].unflatten(-1, (len(JOINTS), 3))


def with_joints(states: Tensor, joints: Tensor) -> Tensor:
    """States with other joints ``(..., 14, 3)``; the root, if there is any, is kept."""
    return torch.cat((joints.flatten(-2), states[..., len(COLUMNS) :]), dim=-1)


def has_root(states: Tensor) -> bool:
    """Whether states have the columns of the root."""
    return states.shape[-1] > len(COLUMNS)


def at_rest_with_root(poses: Tensor) -> Tensor:
    """Poses ``(..., 42)`` as states ``(..., 46)`` of people who stand on the lower foot and do not move."""
    height = -as_joints(poses)[..., list(ANKLES), 2].amin(dim=-1, keepdim=True)
    still = torch.zeros_like(height)
    return torch.cat((poses, still, still, height, still), dim=-1)


def in_space(states: Tensor) -> Tensor:
    """Joints ``(..., frame, 14, 3)`` in metres of states with root ``(..., frame, 46)``: the first frame is above the origin and
    faces +y, the ground is z = 0.
    """
    right, forward, height, turn = (column[..., None] for column in states[..., len(COLUMNS) :].unbind(dim=-1))
    steps, yaw = torch.cat((right, forward), dim=-1)[..., 1:, :], _summed(turn[..., 1:, :])
    root = torch.cat((_summed(_rotated(steps, yaw[..., :-1, :])), height), dim=-1)
    joints = as_joints(states)
    return torch.cat((_rotated(joints[..., :2], yaw[..., None]), joints[..., 2:]), dim=-1) + root[..., None, :]


CONTACT = 0.03  # Maximum height in metres of a standing foot's ankle above the level at which ankles rest


def sliding(states: Tensor) -> tuple[Tensor, Tensor]:
    """Motion of the lower ankle over the ground between frames, of states with root ``(sample, frame, 46)``.

    Returns:
        Displacement to the right and forwards of the earlier frame, in metres ``(sample, frame - 1, 2)``, and the ankle's mean
        height ``(sample, frame - 1)``.
    """
    ankles, yaw = in_space(states)[..., list(ANKLES), :], _summed(states[:, 1:, -1:])
    low, lower = ((ankles[:, 1:, :, 2] + ankles[:, :-1, :, 2]) / 2).min(dim=-1)
    moved = torch.diff(ankles[..., :2], dim=1).gather(2, lower[..., None, None].expand(-1, -1, -1, 2))[:, :, 0]
    return _rotated(moved, -yaw[:, :-1]), low


def _summed(steps: Tensor) -> Tensor:
    """Sums ``(..., frame + 1, n)`` of steps ``(..., frame, n)`` from 0; not ``cumsum``, which is not deterministic on GPUs."""
    zero = torch.zeros_like(steps[..., 0, :])
    return torch.stack(list(itertools.accumulate(steps.unbind(dim=-2), initial=zero)), dim=-2)


def _rotated(points: Tensor, yaw: Tensor) -> Tensor:
    """Points ``(..., 2)`` rotated to the left by angles ``(..., 1)`` in radians."""
    x, y = points[..., :1], points[..., 1:]
    return torch.cat((yaw.cos() * x - yaw.sin() * y, yaw.sin() * x + yaw.cos() * y), dim=-1)


def mirrored(states: Tensor) -> Tensor:
    """Motion ``(..., 42)`` or ``(..., 46)`` with left and right exchanged."""
    joints = as_joints(states)[..., list(MIRROR), :]
    root = states[..., len(COLUMNS) :]
    other = root * root.new_tensor((-1.0, 1.0, 1.0, -1.0)[: root.shape[-1]])
    return torch.cat(((joints * joints.new_tensor((-1.0, 1.0, 1.0))).flatten(-2), other), dim=-1)


def bone_lengths(states: Tensor) -> Tensor:
    """Lengths ``(..., bone)`` in metres of :data:`BONES` in states ``(..., 42)``."""
    joints = as_joints(states)
    ends = torch.tensor(BONES).T
    return torch.linalg.vector_norm(joints[..., ends[0], :] - joints[..., ends[1], :], dim=-1)


class Poses(NamedTuple):
    """Poses and removed root motion."""

    positions: NDArray[np.float64]  # (frame, 14, 3) in metres, z up, the middle of the hips at the origin, hips facing +y
    root: NDArray[np.float64]  # (frame, 4): middle of the hips in metres, and yaw in radians

    @property
    def states(self) -> NDArray[np.float32]:
        """States ``(frame, 42)``."""
        return self.positions.astype(np.float32).reshape(-1, len(COLUMNS))

    @property
    def rooted(self) -> NDArray[np.float32]:
        """States with root ``(frame, 46)``."""
        return np.concatenate((self.states, root_columns(self.positions, self.root)), axis=1)


def z_up(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert points ``(..., 3)`` from y up to z up."""
    return np.stack((joints[..., 0], -joints[..., 2], joints[..., 1]), axis=-1)


def normalised(joints: NDArray[np.float64]) -> Poses:
    """Remove root and yaw in every frame of joints ``(frame, 14, 3)``, z up: the direction from left to right hip is +x.

    The yaw of vertical hips means little and may spin; pitch and roll stay.
    """
    middle = (joints[:, R_HIP] + joints[:, L_HIP]) / 2
    across = joints[:, R_HIP] - joints[:, L_HIP]
    yaw = np.arctan2(across[:, 1], across[:, 0])
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y, z = np.moveaxis(joints - middle[:, None], -1, 0)
    turned = np.stack((cosine * x + sine * y, cosine * y - sine * x, z), axis=-1)
    return Poses(turned, np.concatenate((middle, yaw[:, None]), axis=1))


GROUND = 5
"""Percentile of the height of the lower ankle in a trial that is the ground."""


def root_columns(positions: NDArray[np.floating], root: NDArray[np.floating]) -> NDArray[np.float32]:
    """Columns :data:`ROOT` ``(frame, 4)`` of a trial, see :class:`Poses`; the first frame moves as the second."""
    yaw = np.unwrap(root[:, 3].astype(np.float64))
    step, turn = np.diff(root[:, :2].astype(np.float64), axis=0), np.diff(yaw)
    cosine, sine = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    moved = np.stack((cosine * step[:, 0] + sine * step[:, 1], cosine * step[:, 1] - sine * step[:, 0], turn), axis=1)
    moved = np.concatenate((moved[:1], moved)) if len(moved) else np.zeros((len(root), 3))
    ankles = root[:, 2] + positions[:, list(ANKLES), 2].min(axis=1)
    height = root[:, 2] - np.percentile(ankles, GROUND)
    return np.stack((moved[:, 0], moved[:, 1], height, moved[:, 2]), axis=1).astype(np.float32)


_RIGHT_LEG = ((0.09, 0.0, 0.0), (0.09, 0.02, -0.40), (0.09, -0.03, -0.83))  # hip, knee and ankle in metres, of a medium adult
_RIGHT_ARM = ((0.18, 0.01, 0.51), (0.21, -0.04, 0.22), (0.22, 0.03, 0.05))  # shoulder, elbow and wrist
_MIDDLE = ((0.0, 0.02, 0.55), (0.0, 0.07, 0.73))
STRIDE = 0.4  # Maximum angle in radians of a leg forwards or back
SWING = 0.8  # Swing of the arm relative to the leg of the same side, in the opposite direction
BEND = 0.15  # Radians by which thighs point further forwards, and shanks further back

BEGINNINGS = "distribution of poses"
_FILE = Path(__file__).parent / "beginnings.safetensors"


def standing_poses(count: int, draw: torch.Generator) -> Tensor:
    """Standing poses ``(count, 42)`` of people of different sizes, with arms down."""
    right = torch.tensor((*_RIGHT_LEG, *_RIGHT_ARM))
    left = right * torch.tensor((-1.0, 1.0, 1.0))
    body = torch.cat((right[:3], left[:3], right[3:], left[3:], torch.tensor(_MIDDLE)))
    size = 1 + 0.05 * (2 * torch.rand(count, 1, 1, generator=draw) - 1)
    return (body * size).reshape(count, len(COLUMNS))


def walking_poses(count: int, draw: torch.Generator) -> Tensor:
    """Walking poses ``(count, 42)`` of the same people, with strides from zero to the maximum."""
    joints = as_joints(standing_poses(count, draw)).clone()
    stride = STRIDE * (2 * torch.rand(count, generator=draw) - 1)
    for hip, shoulder, angle in ((R_HIP, R_SHOULDER, stride), (L_HIP, L_SHOULDER, -stride)):  # joints of a limb are consecutive
        _turned(joints, (hip, hip + 1, hip + 2), angle + BEND)
        _turned(joints, (hip + 1, hip + 2), -torch.full_like(angle, 2 * BEND))
        _turned(joints, (shoulder, shoulder + 1, shoulder + 2), -SWING * angle)
    return joints.flatten(1)


def _turned(joints: Tensor, limb: tuple[int, ...], angle: Tensor) -> None:
    """Rotate a limb about its first joint forwards by angles ``(pose,)`` in radians, in place."""
    first, *others = limb
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    hanging = joints[:, others] - joints[:, first : first + 1]
    y, z = hanging[..., 1], hanging[..., 2]
    turned = torch.stack((hanging[..., 0], y * cos - z * sin, y * sin + z * cos), dim=-1)
    joints[:, others] = joints[:, first : first + 1] + turned


def fit_poses(poses: Tensor, directions: int, path: Path) -> None:
    """Write the Gaussian of :func:`drawn_poses`: mean and principal directions of poses ``(pose, 42)`` in metres."""
    mean = poses.double().mean(dim=0)
    _, size, axes = torch.linalg.svd(poses.double() - mean, full_matrices=False)
    scaled = axes[:directions] * size[:directions, None] / (len(poses) - 1) ** 0.5
    save_tensors(path, BEGINNINGS, {"mean": mean.float(), "directions": scaled.float()}, {"poses": len(poses)})


def mean_pose() -> Tensor:
    """Mean ``(42,)`` of :func:`drawn_poses`, in metres."""
    return _distribution()[0]


def drawn_poses(count: int, draw: torch.Generator) -> Tensor:
    """Samples ``(count, 42)`` of the shipped Gaussian, in metres, on the generator's device."""
    mean, directions = (value.to(draw.device) for value in _distribution())
    return mean + torch.randn((count, len(directions)), generator=draw, device=draw.device) @ directions


@cache
def _distribution() -> tuple[Tensor, Tensor]:
    tensors, _ = load_tensors(_FILE, BEGINNINGS)
    return tensors["mean"], tensors["directions"]
