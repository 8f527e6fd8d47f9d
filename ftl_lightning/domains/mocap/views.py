"""How a model may see motion: as it stands in files, or with bones that keep their lengths; begun from other poses."""

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.mocap.skeleton import L_HIP, R_HIP, RIGID, as_joints
from ftl_lightning.domains.mocap.source import OBSERVED, POSE
from ftl_lightning.domains.mocap.standing import drawn_poses
from ftl_lightning.processes import drawn

SHORTEST = 1e-3
"""Metres: a generated bone shorter than this has no direction and is not changed."""


def with_rigid_bones(states: Tensor, observed: Observed) -> Tensor:
    """Motion whose rigid bones are as long as those of the pose it starts from.

    The middle of the hips is the origin, and outwards each joint is moved along its bone; all joints behind it move as much.
    Directions of bones stay.

    Args:
        states: ``(sample, horizon, 42)`` in metres.
        observed: with :data:`POSE`, ``(sample, 42)``.

    Returns:
        ``(sample, horizon, 42)``; of recordings, themselves.
    """
    joints, start = as_joints(states), as_joints(observed[POSE])
    moved = list(joints.unbind(dim=-2))
    for inner, outer in sorted(RIGID, key=lambda bone: bone != (R_HIP, L_HIP)):
        length = torch.linalg.vector_norm(start[:, outer] - start[:, inner], dim=-1)[:, None, None]
        bone = joints[..., outer, :] - joints[..., inner, :]
        found = torch.linalg.vector_norm(bone, dim=-1, keepdim=True)
        bone = torch.where(found > SHORTEST, bone * (length / found.clamp_min(SHORTEST)), bone)
        if (inner, outer) == (R_HIP, L_HIP):
            moved[inner] = -bone / 2
        moved[outer] = moved[inner] + bone
    return torch.stack(moved, dim=-2).flatten(-2)


def smoothed(states: Tensor, observed: Observed) -> Tensor:
    """Motion as a running mean over three frames of such a mean, with rigid bones; first and last frame stay.

    Errors of a network are independent between frames, motion is not: the weighted mean of five frames keeps a quarter of their
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
"""Of the windows that begin elsewhere."""
BLENDED = (8, 12)
"""Frames at least and at most until such a window is as recorded."""


def begun_elsewhere(states: Tensor, observed: Observed, draw: torch.Generator | None) -> tuple[Tensor, Observed]:
    """Half of the windows from a pose in which somebody stands or walks with arms down, and from there into what was recorded.

    Demonstrations begin at rest; without this, nothing shows how to leave a stride. The first frames are a weighted mean of the
    pose and of the recorded frame, whose weight grows as half a cosine, with the bones of the one who moves.

    Args:
        states: ``(sample, frame, 42)`` in metres.
        observed: with :data:`POSE`, ``(sample, 42)``.
        draw: of poses and lengths; ``None`` changes nothing.
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
    """How each pose differs from the one before; the first, from the present."""
    return torch.diff(states, dim=1, prepend=observed[POSE][:, None])


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """The inverse, with rigid bones."""
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
"""Seen as ``rigid``, what is learned from is as it stands in files, and what is generated has rigid bones; ``smooth`` is the same
with a running mean of what is generated. In ``steps`` the same for methods that go from one pose to the next."""
