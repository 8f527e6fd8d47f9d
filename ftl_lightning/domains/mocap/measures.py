"""Measures of generated motion: kinematic rules of actions, the judge, and naturalness.

Rules need no training and are calibrated on recordings: a second opinion beside the judge. Metrics map
``(goal, states (sample, 32, 42), initial states or None) -> (sample,)``.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.judge import shipped_judge
from ftl_lightning.domains.mocap.skeleton import ANKLES, FPS, HIPS, KNEES, L_ANKLE, POSE, R_ANKLE, SHOULDERS, WRISTS, as_joints

STRIDE = 0.3  # Minimum ankle distance in metres of a stride; closer ankles are a level pose
SETTLED = 12  # First frame that is independent of the initial pose; synchrony and arm paths are judged from here
OVERHEAD = -0.12
"""Jumping jacks: minimum height in metres of both wrists at once above the top of the head; bent arms stay a little below it."""
OPENED, OPEN = 0.2, 0.4  # Jumping jacks: minimum range and minimum peak of the sideways distance of the feet, in metres
HANGING = 0.15  # Jumping jacks: minimum depth in metres of the hands below the shoulders at some time
IN_TIME = 0.6  # Minimum absolute correlation of hand height and foot distance that counts as synchronous, in phase or in antiphase
TURN = 240.0  # Minimum rotation of the arms in degrees in an arm circle, as a mean; two thirds for each arm
WIDTH, ROUND = 0.12, 0.2  # Minimum width of the wrists' path, in metres and relative to its length, of a round path
RAISED, LOWERED = 0.15, 0.3
"""Knee raise, in metres below the hips: maximum of a raised knee; minimum of this knee at another time, and of the other knee."""
BENT, STRETCHED = 70.0, 30.0  # Squat, in degrees: minimum flexion of both knees at once, and minimum range of this flexion
TREMBLING = 900.0  # Maximum jerk of an action in metres per second cubed: the 99th percentile of recorded windows
UPRIGHT, ON_FEET = 0.35, 0.5  # Minimum distances in metres from the hips up to the neck, and down to each ankle, of an upright pose


def is_stride(poses: Tensor) -> Tensor:
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
    return (height[..., skeleton.NECK] > UPRIGHT).all(dim=1) & (height[..., list(ANKLES)] < -ON_FEET).all(dim=-1).all(dim=1)


def jerk(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Mean jerk ``(sample,)``: size of the joints' third derivative in metres per second cubed."""
    third = torch.diff(as_joints(states), n=3, dim=1) * FPS**3
    return torch.linalg.vector_norm(third, dim=-1).mean(dim=(1, 2))


def calm(states: Tensor) -> Tensor:
    """Whether jerk is below that of recordings: ``(sample,)`` of bool. Jumping joints would pass through any pose."""
    return jerk("", states, None) < TREMBLING


def synchronous(states: Tensor) -> Tensor:
    """Whether feet open and close in time with the hands, in phase or in antiphase: ``(sample,)`` of bool."""
    settled = states[:, SETTLED:]
    hands, feet = (values - values.mean(dim=1, keepdim=True) for values in (_hands(settled), _feet(settled)))
    size = torch.linalg.vector_norm(hands, dim=1) * torch.linalg.vector_norm(feet, dim=1)
    together = (hands * feet).sum(dim=1) / size.clamp_min(1e-6)
    wide = (_range(_feet(settled)) >= OPENED) & (_feet(settled).amax(dim=1) >= OPEN)
    return (together.abs() >= IN_TIME) & wide


def jumping_jacks(states: Tensor) -> Tensor:
    """Hands overhead and down, feet open and closed in time with them, upright: ``(sample,)`` of bool."""
    joints = as_joints(states)
    wrists = joints[..., list(WRISTS), 2]
    up = wrists.amin(dim=-1) - joints[..., skeleton.HEAD, 2] > OVERHEAD
    down = (wrists < joints[..., list(SHOULDERS), 2] - HANGING).all(dim=-1)
    return up.any(dim=1) & down.any(dim=1) & synchronous(states) & upright(states) & calm(states)


def _paths(states: Tensor) -> Tensor:
    """Paths of both wrists from the side, relative to the shoulders ``(sample, frame, 2, 2)``, centred from :data:`SETTLED` on."""
    joints = as_joints(states)
    paths = (joints[..., list(WRISTS), :] - joints[..., list(SHOULDERS), :])[..., 1:]
    settled = paths[:, SETTLED:]
    return paths - (settled.amax(dim=1, keepdim=True) + settled.amin(dim=1, keepdim=True)) / 2


def arm_rotation(states: Tensor) -> Tensor:
    """Rotation of each arm about the centre of its wrist's path, from the side: degrees ``(sample, side)``; opposites cancel."""
    paths = _paths(states)
    angles = torch.atan2(paths[..., 1], paths[..., 0])
    steps = torch.remainder(torch.diff(angles, dim=1) + torch.pi, 2 * torch.pi) - torch.pi
    return torch.rad2deg(steps.sum(dim=1).abs())


def arm_circle(states: Tensor) -> Tensor:
    """Whether upright arms rotate by :data:`TURN` on round paths: ``(sample,)`` of bool."""
    paths = _paths(states)[:, SETTLED:].transpose(1, 2)
    size = torch.linalg.svdvals(paths - paths.mean(dim=-2, keepdim=True))  # (sample, side, 2)
    width = 8**0.5 * size / (states.shape[1] - SETTLED) ** 0.5  # diameter of a circle
    wide = (width[..., 1] >= WIDTH) & (size[..., 1] >= ROUND * size[..., 0])
    turned = arm_rotation(states)
    return calm(states) & upright(states) & (wide & (turned >= TURN * 2 / 3)).all(dim=-1) & (turned.mean(dim=-1) >= TURN)


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

_RIGID = [skeleton.BONES.index(bone) for bone in skeleton.RIGID]


def recognised(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether the shipped judge recognises the goal: ``(sample,)`` of bool, see :meth:`.Judge.recognised`."""
    return shipped_judge().recognised(goal, states)


def _first(states: Tensor, starts: InitialStates | None) -> Tensor:
    """Initial poses ``(sample, 42)``: the given ones, else the first frames."""
    return states[:, 0] if starts is None else starts.observed[POSE]


def bone_error(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Mean relative difference of rigid bone lengths from those of the initial pose: ``(sample,)``; 0 for recordings."""
    usual = skeleton.bone_lengths(_first(states, starts))[:, None, _RIGID]
    return ((skeleton.bone_lengths(states)[..., _RIGID] - usual).abs() / usual.clamp_min(1e-3)).mean(dim=(1, 2))


def rise(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether both wrists rise from below their shoulders to above them, whatever the initial pose: ``(sample,)`` of bool."""
    joints = as_joints(states)
    above = joints[..., list(WRISTS), 2] - joints[..., list(SHOULDERS), 2]
    low, high = (above < 0).all(dim=-1), (above > 0).all(dim=-1)
    return (low.int().cummax(dim=1).values.bool() & high).any(dim=1)


def rule(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether the goal's rule of :data:`RULES` holds: ``(sample,)`` of 0 and 1; NaN for goals without a rule."""
    return RULES[goal](states).float() if goal in RULES else states.new_full((len(states),), torch.nan)


def level(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """:func:`rule` for level initial poses; NaN for strides."""
    return rule(goal, states, starts).masked_fill(is_stride(_first(states, starts)), torch.nan)


def strides(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """:func:`rule` for strides as initial poses; NaN for level poses."""
    return rule(goal, states, starts).masked_fill(~is_stride(_first(states, starts)), torch.nan)


def _limited(limit: str, measure: Callable[[Tensor], Tensor]) -> Callable[[str, Tensor, InitialStates | None], Tensor]:
    """Restrict a measure to a goal; NaN for others."""

    def measured(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        return measure(states).float() if goal == limit else states.new_full((len(states),), torch.nan)

    return measured


feet_in_time = _limited("jumping jacks", synchronous)
amplitude_of_hands = _limited("jumping jacks", lambda states: _range(_hands(states)))
amplitude_of_feet = _limited("jumping jacks", lambda states: _range(_feet(states)))
degrees_turned = _limited("arm circle", lambda states: arm_rotation(states).mean(dim=-1))
"""Parts of rules: vertical range of the hands and range of the feet's sideways distance in metres, mean rotation of the arms."""
