"""Poses of standing or walking people with arms down, without recordings: rule-based, or from a distribution.

Rule-based poses are the initial states of a shipped model without recordings. The distribution is a Gaussian fitted to such poses
of training recordings (``benchmarks/experiments/mocap_beginnings.py``); learning starts from its samples.
"""

from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.skeleton import COLUMNS, as_joints
from ftl_lightning.services.tensor_file import load_tensors, save_tensors

_RIGHT_SIDE = (
    (0.09, 0.0, 0.0),
    (0.09, 0.02, -0.40),
    (0.09, -0.03, -0.83),
    (0.18, 0.01, 0.51),
    (0.21, -0.04, 0.22),
    (0.22, 0.03, 0.05),
)
"""Hip, knee, ankle, shoulder, elbow, wrist in metres, of an adult of medium size."""
_MIDDLE = ((0.0, 0.02, 0.55), (0.0, 0.07, 0.73))
STRIDE = 0.4
"""Maximum angle in radians of a leg forwards or back."""
SWING = 0.8
"""Swing of the arm relative to the leg of the same side, in the opposite direction."""
BEND = 0.15
"""Radians by which thighs point further forwards, and shanks further back."""

BEGINNINGS = "distribution of poses"
_FILE = Path(__file__).parent / "beginnings.safetensors"


def standing_poses(count: int, draw: torch.Generator) -> Tensor:
    """Standing poses ``(count, 42)`` of people of different sizes, with arms down."""
    right = torch.tensor(_RIGHT_SIDE)
    left = right * torch.tensor((-1.0, 1.0, 1.0))
    body = torch.cat((right[:3], left[:3], right[3:], left[3:], torch.tensor(_MIDDLE)))
    size = 1 + 0.05 * (2 * torch.rand(count, 1, 1, generator=draw) - 1)
    return (body * size).reshape(count, len(COLUMNS))


def walking_poses(count: int, draw: torch.Generator) -> Tensor:
    """Walking poses ``(count, 42)`` of the same people, with strides from zero to the maximum."""
    joints = as_joints(standing_poses(count, draw)).clone()
    stride = STRIDE * (2 * torch.rand(count, generator=draw) - 1)
    sides = ((skeleton.R_HIP, skeleton.R_SHOULDER, stride), (skeleton.L_HIP, skeleton.L_SHOULDER, -stride))
    for hip, shoulder, angle in sides:  # joints of a limb are consecutive
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
    """Write the Gaussian of :func:`drawn_poses`, with few principal directions.

    Args:
        poses: ``(pose, 42)`` in metres.
        directions: number of directions of greatest variance.
        path: the file.
    """
    mean = poses.double().mean(dim=0)
    _, size, axes = torch.linalg.svd(poses.double() - mean, full_matrices=False)
    scaled = axes[:directions] * size[:directions, None] / (len(poses) - 1) ** 0.5
    save_tensors(path, BEGINNINGS, {"mean": mean.float(), "directions": scaled.float()}, {"poses": len(poses)})


def drawn_poses(count: int, draw: torch.Generator) -> Tensor:
    """Samples ``(count, 42)`` of the shipped Gaussian, in metres, on the generator's device."""
    mean, directions = _distribution()
    return mean.to(draw.device) + torch.randn((count, len(directions)), generator=draw, device=draw.device) @ directions.to(
        draw.device
    )


@cache
def _distribution() -> tuple[Tensor, Tensor]:
    tensors, _ = load_tensors(_FILE, BEGINNINGS)
    return tensors["mean"], tensors["directions"]
