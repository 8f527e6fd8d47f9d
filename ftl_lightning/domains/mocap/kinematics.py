"""Rules that say what the body does: how high, how far, how often, in time with what. Trembling shows nothing.

They look at joints alone, know nothing of recordings, and are calibrated on them (docs/experiments-mocap.md): a second opinion
beside the judge that has learned what actions look like.
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
"""Metres between the ankles from which a pose is a stride; below it, a person stands level."""
SETTLED = 12
"""Frames after which a plan no longer comes from where it started; what goes together, and what arms draw, is judged from here."""
OVERHEAD = -0.12
"""Metres above the top of the head that both wrists reach at once in jumping jacks; with bent arms they stay a little below."""
OPENED, OPEN = 0.2, 0.4
"""Metres sideways by which the feet open and close in jumping jacks, and how far they are apart at most, at least."""
HANGING = 0.15
"""Metres that the hands are below the shoulders at one time in jumping jacks."""
IN_TIME = 0.6
"""Correlation of hands' height and feet's opening from which they go together, or one against the other."""
TURN = 240.0
"""Degrees that the arms turn at least in an arm circle, as a mean; each, two thirds of it."""
WIDTH, ROUND = 0.12, 0.2
"""Metres that the wrists' path is wide at least, and its width compared to its length: it is no line."""
RAISED, LOWERED = 0.15, 0.3
"""Metres below the hips: a raised knee is higher than the first, and lower than the second at another time, as the other one is."""
BENT, STRETCHED = 70.0, 30.0
"""Degrees: in a squat both knees are bent by more than the first at once, and at another time by less, by the second at least."""
TREMBLING = 900.0
"""Jerk in metres a second cubed that no action has: that of 99 windows of 100 of recordings is less."""
UPRIGHT, ON_FEET = 0.35, 0.5
"""Metres from the hips up to the neck, and down to each ankle, at least, of somebody who stands or hops."""


def strides(poses: Tensor) -> Tensor:
    """Whether poses ``(sample, 42)`` are strides: ``(sample,)`` of bool."""
    joints = as_joints(poses)
    return torch.linalg.vector_norm(joints[:, R_ANKLE] - joints[:, L_ANKLE], dim=-1) > STRIDE


def _hands(states: Tensor) -> Tensor:
    """Mean height of both wrists ``(sample, frame)`` in metres."""
    return as_joints(states)[..., list(WRISTS), 2].mean(dim=-1)


def _feet(states: Tensor) -> Tensor:
    """How far the ankles are apart sideways ``(sample, frame)`` in metres; negative where they are crossed."""
    joints = as_joints(states)
    return joints[..., R_ANKLE, 0] - joints[..., L_ANKLE, 0]


def _range(values: Tensor) -> Tensor:
    return values.amax(dim=1) - values.amin(dim=1)


def upright(states: Tensor) -> Tensor:
    """Whether somebody stands or hops upright on both feet all the time: ``(sample,)`` of bool."""
    height = as_joints(states)[..., 2]
    return (height[..., NECK] > UPRIGHT).all(dim=1) & (height[..., list(ANKLES)] < -ON_FEET).all(dim=-1).all(dim=1)


def jerk(states: Tensor) -> Tensor:
    """How much motion trembles: ``(sample,)``, mean size of the joints' third derivative, metres a second cubed."""
    third = torch.diff(as_joints(states), n=3, dim=1) * FPS**3
    return torch.linalg.vector_norm(third, dim=-1).mean(dim=(1, 2))


def calm(states: Tensor) -> Tensor:
    """Whether motion trembles no more than people's: ``(sample,)`` of bool. Joints that jump about pass through anything."""
    return jerk(states) < TREMBLING


def hands_amplitude(states: Tensor) -> Tensor:
    """How far the hands go up and down: metres ``(sample,)``, of windows ``(sample, frame, 42)``."""
    return _range(_hands(states))


def feet_amplitude(states: Tensor) -> Tensor:
    """How far the feet open and close sideways: metres ``(sample,)``."""
    return _range(_feet(states))


def feet_in_time(states: Tensor) -> Tensor:
    """Whether feet open and close in time with the hands: ``(sample,)`` of bool.

    People open their feet while the hands rise; some, while they sink. TaskResult from :data:`SETTLED` on.
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
    """Both wrists' paths seen from the side, from their shoulders and about their own middle: ``(sample, frame, 2, 2)``.

    The middle is that of the frames from :data:`SETTLED` on.
    """
    joints = as_joints(states)
    paths = (joints[..., list(WRISTS), :] - joints[..., list(SHOULDERS), :])[..., 1:]
    settled = paths[:, SETTLED:]
    return paths - (settled.amax(dim=1, keepdim=True) + settled.amin(dim=1, keepdim=True)) / 2


def degrees_turned(states: Tensor) -> Tensor:
    """How far the arms turn about the middle of the wrists' paths, seen from the side: degrees ``(sample,)``, mean of both arms."""
    return _turned(states).mean(dim=-1)


def _turned(states: Tensor) -> Tensor:
    """Of each arm ``(sample, side)``; to and fro cancel."""
    paths = _paths(states)
    angles = torch.atan2(paths[..., 1], paths[..., 0])
    steps = torch.remainder(torch.diff(angles, dim=1) + torch.pi, 2 * torch.pi) - torch.pi
    return torch.rad2deg(steps.sum(dim=1).abs())


def arm_circle(states: Tensor) -> Tensor:
    """The arms of somebody upright turn by :data:`TURN` on paths that are round: ``(sample,)`` of bool."""
    size = torch.linalg.svdvals(_centred(_paths(states)[:, SETTLED:].transpose(1, 2)))  # (sample, side, 2)
    frames = states.shape[1] - SETTLED
    width = 8**0.5 * size / frames**0.5  # of a circle, its diameter
    wide = (width[..., 1] >= WIDTH) & (size[..., 1] >= ROUND * size[..., 0])
    turned = _turned(states)
    return calm(states) & upright(states) & (wide & (turned >= TURN * 2 / 3)).all(dim=-1) & (turned.mean(dim=-1) >= TURN)


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(dim=-2, keepdim=True)


def knee_raise(states: Tensor) -> Tensor:
    """A knee is raised, and hangs at another time: ``(sample,)`` of bool."""
    below = as_joints(states)[..., list(HIPS), 2] - as_joints(states)[..., list(KNEES), 2]
    raised = (below < RAISED) & (below.flip(-1) > LOWERED)
    return (raised.any(dim=1) & (below.amax(dim=1) > LOWERED)).any(dim=-1) & calm(states)


def squat(states: Tensor) -> Tensor:
    """Both knees are bent at once, and stretched at another time: ``(sample,)`` of bool."""
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
"""Whether windows ``(sample, frame, 42)`` show an action, by its goal: ``(sample,)`` of bool."""
