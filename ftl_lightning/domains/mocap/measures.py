"""Measures of generated motion: kinematic rules of actions, the judge, and naturalness.

Rules need no training and are set from recordings: a second opinion beside the judge. Metrics map
``(goal, states (sample, 32, 42), initial states or None) -> (sample,)``.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.judge import shipped_judge
from ftl_lightning.domains.mocap.skeleton import (
    ANKLES,
    FPS,
    HEAD,
    HIPS,
    KNEES,
    L_ANKLE,
    POSE,
    R_ANKLE,
    SHOULDERS,
    WRISTS,
    as_joints,
)
from ftl_lightning.domains.mocap.tasks import MORE_CONCEPTS, actions

STRIDE = 0.3  # Minimum ankle distance in metres of a stride; closer ankles are a level pose
SETTLED = 10  # First frame that is judged: a third of a second after the initial pose
FULL_TURN = 360.0 * (skeleton.HORIZON - SETTLED - 2) / (skeleton.HORIZON - 1)
"""Degrees by which :func:`arm_rotation` measures an even full turn within a plan."""
TREMBLING = 900.0  # Maximum jerk of an action in metres per second cubed: the 99th percentile of recorded windows


def is_stride(poses: Tensor) -> Tensor:
    """Whether poses ``(sample, 42)`` are strides: ``(sample,)`` of bool."""
    joints = as_joints(poses)
    return torch.linalg.vector_norm(joints[:, R_ANKLE] - joints[:, L_ANKLE], dim=-1) > STRIDE


def jerk(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Mean jerk ``(sample,)``: size of the joints' third derivative in metres per second cubed."""
    third = torch.diff(as_joints(states), n=3, dim=1) * FPS**3
    return torch.linalg.vector_norm(third, dim=-1).mean(dim=(1, 2))


def skating(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Metres a frame that the lower foot slides while it stands, of states with root ``(sample, frame, 46)``: ``(sample,)``.

    The mean over steps between frames, after the first third of a second, in which the foot stands; NaN if there are none.
    """
    slid, low = (values[:, SETTLED:] for values in skeleton.sliding(states))
    return torch.linalg.vector_norm(slid, dim=-1).masked_fill(low > skeleton.CONTACT, torch.nan).nanmean(dim=1)


def _settled(states: Tensor) -> Tensor:
    """Joints ``(sample, frame, 14, 3)`` from :data:`SETTLED` on."""
    return as_joints(states)[:, SETTLED:]


def _range(values: Tensor) -> Tensor:
    """Range over frames: ``(sample, frame)`` to ``(sample,)``."""
    return values.amax(dim=1) - values.amin(dim=1)


def _height(states: Tensor, joints: tuple[int, ...]) -> Tensor:
    return _settled(states)[..., list(joints), 2]


def _hands(states: Tensor) -> Tensor:
    """Mean height of both wrists ``(sample, frame)`` in metres."""
    return _height(states, WRISTS).mean(dim=-1)


def _hands_above_head(states: Tensor) -> Tensor:
    """Greatest height of the lower wrist above the top of the head, in metres."""
    return (_height(states, WRISTS).amin(dim=-1) - _height(states, (HEAD,))[..., 0]).amax(dim=1)


def _hands_above_shoulders(states: Tensor) -> Tensor:
    """Heights of the wrists above the shoulders ``(sample, frame, side)`` in metres."""
    return _height(states, WRISTS) - _height(states, SHOULDERS)


def _uneven_hands(states: Tensor) -> Tensor:
    """Greatest difference in height of the wrists, in metres."""
    return (_height(states, WRISTS) @ states.new_tensor((1.0, -1.0))).abs().amax(dim=1)


def _feet(states: Tensor) -> Tensor:
    """Sideways distance of the ankles ``(sample, frame)`` in metres; negative for crossed feet."""
    joints = _settled(states)
    return joints[..., R_ANKLE, 0] - joints[..., L_ANKLE, 0]


def _strides(states: Tensor) -> Tensor:
    """Greatest distance of the ankles to the front, in metres."""
    joints = _settled(states)
    return (joints[..., R_ANKLE, 1] - joints[..., L_ANKLE, 1]).abs().amax(dim=1)


def _in_time(states: Tensor) -> Tensor:
    """Absolute correlation of hand height and sideways distance of the feet: in phase or in antiphase."""
    hands, feet = (values - values.mean(dim=1, keepdim=True) for values in (_hands(states), _feet(states)))
    size = torch.linalg.vector_norm(hands, dim=1) * torch.linalg.vector_norm(feet, dim=1)
    return (hands * feet).sum(dim=1).abs() / size.clamp_min(1e-6)


def _neck(states: Tensor) -> Tensor:
    """Smallest cosine of the angle between the vertical and the line from the hips to the neck: 1 for an upright trunk."""
    neck = _settled(states)[..., skeleton.NECK, :]
    return (neck[..., 2] / torch.linalg.vector_norm(neck, dim=-1).clamp_min(1e-3)).amin(dim=1)


def _legs(states: Tensor) -> Tensor:
    """Smallest height of the hips above the higher ankle, in lengths of the legs: 1 for straight legs."""
    first = as_joints(states)[:, 0]
    bones = (first[:, list(HIPS)] - first[:, list(KNEES)], first[:, list(KNEES)] - first[:, list(ANKLES)])
    length = sum(torch.linalg.vector_norm(bone, dim=-1).mean(dim=-1) for bone in bones)
    return -_height(states, ANKLES).amax(dim=(1, 2)) / torch.as_tensor(length).clamp_min(1e-3)


def _paths(states: Tensor) -> Tensor:
    """Paths of both wrists from the side, relative to the shoulders: ``(sample, frame, side, 2)`` in metres."""
    joints = _settled(states)
    return (joints[..., list(WRISTS), :] - joints[..., list(SHOULDERS), :])[..., 1:]


def arm_rotation(states: Tensor) -> Tensor:
    """Turn of the direction of each wrist's motion relative to the shoulder, from the side: degrees ``(sample, side)``.

    Opposite turns cancel. A part of a circle counts by its angle, wherever its centre is.
    """
    step = torch.diff(_paths(states), dim=1)
    angles = torch.atan2(step[..., 1], step[..., 0])
    turns = torch.remainder(torch.diff(angles, dim=1) + torch.pi, 2 * torch.pi) - torch.pi
    return torch.rad2deg(turns.sum(dim=1).abs())


def _path_width(states: Tensor) -> Tensor:
    """Smaller width of the wrists' paths in metres: the diameter of circles."""
    paths = _paths(states).transpose(1, 2)
    size = torch.linalg.svdvals(paths - paths.mean(dim=-2, keepdim=True))[..., 1]
    return (8**0.5 * size / paths.shape[-2] ** 0.5).amin(dim=-1)


def arms_out(states: Tensor) -> Tensor:
    """Mean sideways distance of the wrist from the shoulder, of the nearer arm, in metres ``(sample,)``."""
    joints = _settled(states)
    sideways = joints[..., list(WRISTS), 0] - joints[..., list(SHOULDERS), 0]
    return (sideways * states.new_tensor((1.0, -1.0))).mean(dim=1).amin(dim=-1)


def _knees(states: Tensor) -> Tensor:
    """Heights of the knees relative to the hips ``(sample, frame, side)`` in thighs; the knee that is raised more is first."""
    first = as_joints(states)[:, 0]
    thighs = torch.linalg.vector_norm(first[:, list(KNEES)] - first[:, list(HIPS)], dim=-1).clamp_min(1e-3)
    knees = (_height(states, KNEES) - _height(states, HIPS)) / thighs[:, None]
    first = knees.amax(dim=1).argmax(dim=1)
    return torch.where(first[:, None, None] == 0, knees, knees.flip(-1))


def _other_knee(states: Tensor) -> Tensor:
    """Height of the lower knee when the other is highest, see :func:`_knees`."""
    raised, other = _knees(states).unbind(dim=-1)
    return other.gather(1, raised.argmax(dim=1, keepdim=True))[:, 0]


def _bend(states: Tensor) -> Tensor:
    """Flexion of the straighter knee ``(sample, frame)`` in degrees."""
    joints = _settled(states)
    thigh = joints[..., list(KNEES), :] - joints[..., list(HIPS), :]
    shank = joints[..., list(ANKLES), :] - joints[..., list(KNEES), :]
    return torch.rad2deg(torch.arccos(torch.cosine_similarity(thigh, shank, dim=-1).clamp(-1, 1))).amin(dim=-1)


def _shoulder_yaw(states: Tensor) -> Tensor:
    """Yaw of the shoulders relative to the hips ``(sample, frame)`` in degrees."""
    joints = _settled(states)
    across = joints[..., skeleton.R_SHOULDER, :] - joints[..., skeleton.L_SHOULDER, :]
    return torch.rad2deg(torch.atan2(across[..., 1], across[..., 0]))


def _hands_to_feet(states: Tensor) -> Tensor:
    """Distance of each wrist to the nearer ankle ``(sample, frame, side)`` in metres."""
    joints = _settled(states)
    return torch.cdist(joints[..., list(WRISTS), :], joints[..., list(ANKLES), :]).amin(dim=-1)


class Condition(NamedTuple):
    """Part of a rule: a measure ``(sample, frame, 42) -> (sample,)``, and whether its threshold is a minimum or a maximum."""

    measure: Callable[[Tensor], Tensor]
    least: bool = True


_BENT = {
    "lowest neck": Condition(lambda states: _height(states, (skeleton.NECK,))[..., 0].amin(dim=1), least=False),
    "range of neck": Condition(lambda states: _range(_height(states, (skeleton.NECK,))[..., 0])),
}
CONDITIONS: Mapping[str, Mapping[str, Condition]] = {
    "jumping jacks": {
        "hands up": Condition(_hands_above_head),
        "hands down": Condition(lambda states: _hands_above_shoulders(states).amax(dim=-1).amin(dim=1), least=False),
        "range of feet": Condition(lambda states: _range(_feet(states))),
        "level feet": Condition(_strides, least=False),
        "feet in time": Condition(_in_time),
        "neck": Condition(_neck),
    },
    "arm circle": {
        "turn": Condition(lambda states: arm_rotation(states).amin(dim=-1)),
        "arms out": Condition(arms_out),
        "width of paths": Condition(_path_width),
        "neck": Condition(_neck),
    },
    "knee raise": {
        "knee up": Condition(lambda states: _knees(states)[..., 0].amax(dim=1)),
        "range of knee": Condition(lambda states: _range(_knees(states)[..., 0])),
        "other knee": Condition(_other_knee, least=False),
    },
    "squat": {
        "bend": Condition(lambda states: _bend(states).amax(dim=1)),
        "range of bend": Condition(lambda states: _range(_bend(states))),
    },
    "twist": {
        "range of shoulders": Condition(lambda states: _range(_shoulder_yaw(states))),
        "hands": Condition(lambda states: _hands_above_shoulders(states).mean(dim=(1, 2))),
        "legs": Condition(_legs),
        "neck": Condition(_neck),
    },
    "toe touch one hand": {**_BENT, "uneven hands": Condition(_uneven_hands)},
    "toe touch two hands": {
        **_BENT,
        "hands to feet": Condition(lambda states: _hands_to_feet(states).amax(dim=-1).amin(dim=1), least=False),
        "uneven hands": Condition(_uneven_hands, least=False),
    },
    "up down": {
        "range of hands": Condition(lambda states: _range(_hands(states))),
        "uneven hands": Condition(_uneven_hands, least=False),
    },
}
"""Conditions of each action's rule, by name."""
THRESHOLDS: Mapping[str, Mapping[str, float]] = json.loads((Path(__file__).parent / "rules.json").read_text(encoding="utf-8"))
"""Thresholds of :data:`CONDITIONS`, set from recordings alone by ``benchmarks/experiments/mocap_rules.py``."""


def holds(action: str, name: str, states: Tensor, thresholds: Mapping[str, float] | None = None) -> Tensor:
    """Whether a condition of an action's rule holds in windows ``(sample, frame, 42)``: ``(sample,)`` of bool.

    ``thresholds`` by condition replace those of :data:`THRESHOLDS`.
    """
    measure, least = CONDITIONS[action][name]
    values, threshold = measure(states), (thresholds or THRESHOLDS[action])[name]
    return values >= threshold if least else values <= threshold


def satisfied(action: str, states: Tensor, thresholds: Mapping[str, float] | None = None) -> Tensor:
    """Whether windows ``(sample, frame, 42)`` satisfy an action's rule without trembling: ``(sample,)`` of bool."""
    calm = jerk("", states, None) < TREMBLING  # trembling joints would pass through any pose
    return torch.stack([holds(action, name, states, thresholds) for name in CONDITIONS[action]]).all(dim=0) & calm


_RIGID = [skeleton.BONES.index(bone) for bone in skeleton.RIGID]


def recognised(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether the shipped judge recognises the goal: ``(sample,)`` of 0 and 1, see :meth:`.Judge.recognised`; NaN if it cannot."""
    if goal in MORE_CONCEPTS and not actions(goal):
        return states.new_full((len(states),), torch.nan)
    return shipped_judge().recognised(goal, states).float()


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
    """Whether the goal's rule of :data:`CONDITIONS` holds: ``(sample,)`` of 0 and 1; NaN for goals without a rule."""
    return satisfied(goal, states).float() if goal in CONDITIONS else states.new_full((len(states),), torch.nan)


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


feet_in_time = _limited("jumping jacks", lambda states: holds("jumping jacks", "feet in time", states))
amplitude_of_hands = _limited("jumping jacks", lambda states: _range(_hands(states)))
amplitude_of_feet = _limited("jumping jacks", lambda states: _range(_feet(states)))
degrees_turned = _limited("arm circle", lambda states: arm_rotation(states).mean(dim=-1))
full_turn = _limited("arm circle", lambda states: (arm_rotation(states) >= FULL_TURN).all(dim=-1) & satisfied("arm circle", states))
"""Parts of rules: vertical range of the hands and range of the feet's sideways distance in metres, mean rotation of the arms, and
whether the rule holds and both arms turn by :data:`FULL_TURN`."""
