"""Kinematic rules of actions: height, distance, number and synchrony of movements. Trembling motion fails.

Rules use joints only, without training, calibrated on recordings (docs/experiments-mocap.md): a second opinion beside the trained
judge.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ftl_lightning.domains.mocap.skeleton import (
    ANKLES,
    FPS,
    HEAD,
    HIPS,
    KNEES,
    L_ANKLE,
    NECK,
    R_ANKLE,
    SHOULDERS,
    WRISTS,
    as_joints,
)

STRIDE = 0.3
"""Minimum ankle distance in metres of a stride; closer ankles are a level pose."""
SETTLED = 12
"""First frame that is independent of the initial pose; synchrony and arm paths are judged from here."""
OVERHEAD = -0.12
"""Jumping jacks: minimum height in metres of both wrists at once above the top of the head; bent arms stay a little below it."""
OPENED, OPEN = 0.2, 0.4
"""Jumping jacks: minimum range and minimum peak of the sideways distance of the feet, in metres."""
HANGING = 0.15
"""Jumping jacks: minimum depth in metres of the hands below the shoulders at some time."""
IN_TIME = 0.6
"""Minimum absolute correlation of hand height and foot distance that counts as synchronous, in phase or in antiphase."""
TURN = 240.0
"""Minimum rotation of the arms in degrees in an arm circle, as a mean; two thirds for each arm."""
WIDTH, ROUND = 0.12, 0.2
"""Minimum width of the wrists' path, in metres and relative to its length, of a round path."""
RAISED, LOWERED = 0.15, 0.3
"""Knee raise, in metres below the hips: maximum of a raised knee; minimum of this knee at another time, and of the other knee."""
BENT, STRETCHED = 70.0, 30.0
"""Squat, in degrees: minimum flexion of both knees at once, and minimum range of this flexion."""
TREMBLING = 900.0
"""Maximum jerk of an action in metres per second cubed: the 99th percentile of recorded windows."""
UPRIGHT, ON_FEET = 0.35, 0.5
"""Minimum distances in metres from the hips up to the neck, and down to each ankle, of an upright pose."""


def strides(poses: Tensor) -> Tensor:
    """Whether poses ``(sample, 42)`` are strides: ``(sample,)`` of bool."""
    joints = as_joints(poses)
    return torch.linalg.vector_norm(joints[:, R_ANKLE] - joints[:, L_ANKLE], dim=-1) > STRIDE


def _hands(states: Tensor) -> Tensor:
    """Mean height of both wrists ``(sample, frame)`` in metres."""
    return as_joints(states)[..., list(WRISTS), 2].mean(dim=-1)


def _feet(states: Tensor) -> Tensor:
    """Sideways distance of the ankles ``(sample, frame)`` in metres; negative for crossed feet."""
    joints = as_joints(states)
    return joints[..., R_ANKLE, 0] - joints[..., L_ANKLE, 0]


def _range(values: Tensor) -> Tensor:
    return values.amax(dim=1) - values.amin(dim=1)


def upright(states: Tensor) -> Tensor:
    """Whether all poses stand or hop upright on both feet: ``(sample,)`` of bool."""
    height = as_joints(states)[..., 2]
    return (height[..., NECK] > UPRIGHT).all(dim=1) & (height[..., list(ANKLES)] < -ON_FEET).all(dim=-1).all(dim=1)


def jerk(states: Tensor) -> Tensor:
    """Mean jerk ``(sample,)``: size of the joints' third derivative in metres per second cubed."""
    third = torch.diff(as_joints(states), n=3, dim=1) * FPS**3
    return torch.linalg.vector_norm(third, dim=-1).mean(dim=(1, 2))


def calm(states: Tensor) -> Tensor:
    """Whether jerk is below that of recordings: ``(sample,)`` of bool. Jumping joints would pass through any pose."""
    return jerk(states) < TREMBLING


def hands_amplitude(states: Tensor) -> Tensor:
    """Vertical range of the hands in metres ``(sample,)``, of windows ``(sample, frame, 42)``."""
    return _range(_hands(states))


def feet_amplitude(states: Tensor) -> Tensor:
    """Range of the sideways distance of the feet in metres ``(sample,)``."""
    return _range(_feet(states))


def feet_in_time(states: Tensor) -> Tensor:
    """Whether feet open and close in time with the hands: ``(sample,)`` of bool.

    Most people open their feet as the hands rise; some, as they sink. Judged from :data:`SETTLED` on.
    """
    settled = states[:, SETTLED:]
    hands, feet = (values - values.mean(dim=1, keepdim=True) for values in (_hands(settled), _feet(settled)))
    size = torch.linalg.vector_norm(hands, dim=1) * torch.linalg.vector_norm(feet, dim=1)
    together = (hands * feet).sum(dim=1) / size.clamp_min(1e-6)
    wide = (feet_amplitude(settled) >= OPENED) & (_feet(settled).amax(dim=1) >= OPEN)
    return (together.abs() >= IN_TIME) & wide


def hands_overhead(states: Tensor) -> Tensor:
    """Whether both hands are overhead at one time, and below the shoulders at another: ``(sample,)`` of bool."""
    joints = as_joints(states)
    wrists = joints[..., list(WRISTS), 2]
    up = wrists.amin(dim=-1) - joints[..., HEAD, 2] > OVERHEAD
    down = (wrists < joints[..., list(SHOULDERS), 2] - HANGING).all(dim=-1)
    return up.any(dim=1) & down.any(dim=1)


def jumping_jacks(states: Tensor) -> Tensor:
    """Hands overhead and down, feet open and closed in time with them, upright: ``(sample,)`` of bool."""
    return hands_overhead(states) & feet_in_time(states) & upright(states) & calm(states)


def _paths(states: Tensor) -> Tensor:
    """Paths of both wrists from the side, relative to the shoulders, centred: ``(sample, frame, 2, 2)``.

    The centre is that of the frames from :data:`SETTLED` on.
    """
    joints = as_joints(states)
    paths = (joints[..., list(WRISTS), :] - joints[..., list(SHOULDERS), :])[..., 1:]
    settled = paths[:, SETTLED:]
    return paths - (settled.amax(dim=1, keepdim=True) + settled.amin(dim=1, keepdim=True)) / 2


def degrees_turned(states: Tensor) -> Tensor:
    """Rotation of the arms about the centre of the wrists' paths, from the side: degrees ``(sample,)``, mean of both arms."""
    return _turned(states).mean(dim=-1)


def _turned(states: Tensor) -> Tensor:
    """Rotation of each arm in degrees ``(sample, side)``; opposite rotations cancel."""
    paths = _paths(states)
    angles = torch.atan2(paths[..., 1], paths[..., 0])
    steps = torch.remainder(torch.diff(angles, dim=1) + torch.pi, 2 * torch.pi) - torch.pi
    return torch.rad2deg(steps.sum(dim=1).abs())


def arm_circle(states: Tensor) -> Tensor:
    """Whether upright arms rotate by :data:`TURN` on round paths: ``(sample,)`` of bool."""
    size = torch.linalg.svdvals(_centred(_paths(states)[:, SETTLED:].transpose(1, 2)))  # (sample, side, 2)
    frames = states.shape[1] - SETTLED
    width = 8**0.5 * size / frames**0.5  # diameter of a circle
    wide = (width[..., 1] >= WIDTH) & (size[..., 1] >= ROUND * size[..., 0])
    turned = _turned(states)
    return calm(states) & upright(states) & (wide & (turned >= TURN * 2 / 3)).all(dim=-1) & (turned.mean(dim=-1) >= TURN)


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(dim=-2, keepdim=True)


def knee_raise(states: Tensor) -> Tensor:
    """Whether a knee is raised, and down at another time: ``(sample,)`` of bool."""
    below = as_joints(states)[..., list(HIPS), 2] - as_joints(states)[..., list(KNEES), 2]
    raised = (below < RAISED) & (below.flip(-1) > LOWERED)
    return (raised.any(dim=1) & (below.amax(dim=1) > LOWERED)).any(dim=-1) & calm(states)


def squat(states: Tensor) -> Tensor:
    """Whether both knees are bent at once, and stretched at another time: ``(sample,)`` of bool."""
    joints = as_joints(states)
    thigh = joints[..., list(KNEES), :] - joints[..., list(HIPS), :]
    shank = joints[..., list(ANKLES), :] - joints[..., list(KNEES), :]
    bend = torch.rad2deg(torch.arccos(torch.cosine_similarity(thigh, shank, dim=-1).clamp(-1, 1)))
    both = bend.amin(dim=-1)
    return (both.amax(dim=1) > BENT) & (_range(both) > STRETCHED) & calm(states)


RULES: Mapping[str, Callable[[Tensor], Tensor]] = {
    "jumping jacks": jumping_jacks,
    "arm circle": arm_circle,
    "knee raise": knee_raise,
    "squat": squat,
}
"""Rules of actions by goal, from windows ``(sample, frame, 42)`` to ``(sample,)`` of bool."""
