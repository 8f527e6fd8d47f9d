"""Views of motion for models: states as in files, or with rigid bones; initial poses augmented."""

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.mocap.skeleton import L_HIP, R_HIP, RIGID, as_joints
from ftl_lightning.domains.mocap.source import OBSERVED, POSE
from ftl_lightning.domains.mocap.standing import drawn_poses
from ftl_lightning.services.randomness import drawn

SHORTEST = 1e-3
"""Minimum length in metres of a generated bone with a direction; shorter bones are not changed."""


def with_rigid_bones(states: Tensor, observed: Observed) -> Tensor:
    """Scale rigid bones to their lengths in the initial pose.

    From the origin, the middle of the hips, outwards, each joint moves along its bone with all its descendants. Directions of bones
    are constant.

    Args:
        states: ``(sample, horizon, 42)`` in metres.
        observed: with :data:`POSE`, ``(sample, 42)``.

    Returns:
        ``(sample, horizon, 42)``; recordings are unchanged.
    """
    joints, start = as_joints(states), as_joints(observed[POSE])
    moved = list(joints.unbind(dim=-2))
    for inner, outer in sorted(RIGID, key=lambda bone: bone != (R_HIP, L_HIP)):
        length = torch.linalg.vector_norm(start[:, outer] - start[:, inner], dim=-1)[:, None, None]
        bone = joints[..., outer, :] - joints[..., inner, :]
        norm = torch.linalg.vector_norm(bone, dim=-1, keepdim=True)
        bone = torch.where(norm > SHORTEST, bone * (length / norm.clamp_min(SHORTEST)), bone)
        if (inner, outer) == (R_HIP, L_HIP):
            moved[inner] = -bone / 2
        moved[outer] = moved[inner] + bone
    return torch.stack(moved, dim=-2).flatten(-2)


def smoothed(states: Tensor, observed: Observed) -> Tensor:
    """Apply a running mean of three frames twice, then rigid bones; first and last frame are constant.

    Network errors are independent between frames, motion is not: the weighted mean of five frames keeps a quarter of their
    variance.

    Args:
        states: ``(sample, horizon, 42)`` in metres.
        observed: with :data:`POSE`, ``(sample, 42)``.

    Returns:
        ``(sample, horizon, 42)``.
    """
    for _ in range(2):
        inside = (states[:, :-2] + states[:, 1:-1] + states[:, 2:]) / 3
        states = torch.cat((states[:, :1], inside, states[:, -1:]), dim=1)
    return with_rigid_bones(states, observed)


SHARE = 0.5
"""Share of windows with another initial pose."""
BLENDED = (8, 12)
"""Minimum and maximum frames of the transition to the recorded window."""


def begun_elsewhere(states: Tensor, observed: Observed, draw: torch.Generator | None) -> tuple[Tensor, Observed]:
    """Start half of the windows in a pose of standing or walking with arms down, with a transition to the recording.

    Demonstrations start at rest; without this augmentation, no window leaves a stride. Frames of the transition are weighted
    means of pose and recording with cosine weights, and with the bone lengths of the recording.

    Args:
        states: ``(sample, frame, 42)`` in metres.
        observed: with :data:`POSE`, ``(sample, 42)``.
        draw: generator of poses and lengths; ``None`` for no change.
    """
    if draw is None:
        return states, observed
    count, device = len(states), states.device
    poses = with_rigid_bones(drawn(count, lambda n: drawn_poses(n, draw)).to(states)[:, None], observed)
    low, high = BLENDED
    length = drawn(count, lambda n: torch.randint(low, high + 1, (n, 1, 1), generator=draw, device=draw.device)).to(device)
    share = torch.arange(states.shape[1], device=device)[None, :, None] / length
    elsewhere = (drawn(count, lambda n: torch.rand((n, 1, 1), generator=draw, device=draw.device)) < SHARE).to(device)
    weight = elsewhere * (1 + torch.cos(torch.pi * share.clamp(max=1))) / 2
    begun = with_rigid_bones(weight * poses + (1 - weight) * states, observed)
    begun = torch.where(weight > 0, begun, states)
    return begun, {**observed, POSE: begun[:, 0]}


def _encode_steps(states: Tensor, observed: Observed) -> Tensor:
    """Differences of consecutive poses; the first relative to the initial pose."""
    return torch.diff(states, dim=1, prepend=observed[POSE][:, None])


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """Invert :func:`_encode_steps`, with rigid bones."""
    # Not cumsum, which has no deterministic form on GPUs.
    states = itertools.accumulate(steps.unbind(dim=1), initial=observed[POSE])
    return with_rigid_bones(torch.stack(list(states)[1:], dim=1), observed)


_RIGID = View(
    OBSERVED,
    observe=lambda observed: observed,
    encode=lambda states, observed: states,
    decode=with_rigid_bones,
    perturb=begun_elsewhere,
    same_columns=True,
)
VIEWS = {
    "rigid": _RIGID,
    "smooth": replace(_RIGID, decode=smoothed),
    "steps": View(OBSERVED, observe=lambda observed: observed, encode=_encode_steps, decode=_decode_steps),
}
"""``rigid`` has training states as in files, and generated states with rigid bones; ``smooth`` adds a running mean of generated
states. ``steps`` has differences of poses, for autoregressive methods."""
