"""How a model may see motion: as it stands in files, or with bones that keep their lengths."""

import itertools

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import Observed
from ftl_lightning.domains.domain import View
from ftl_lightning.domains.mocap.skeleton import L_HIP, R_HIP, RIGID, as_joints
from ftl_lightning.domains.mocap.source import OBSERVED, POSE

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


def _encode_steps(states: Tensor, observed: Observed) -> Tensor:
    """How each pose differs from the one before; the first, from the present."""
    return torch.diff(states, dim=1, prepend=observed[POSE][:, None])


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """The inverse, with rigid bones."""
    # Not cumsum, which has no deterministic form on GPUs.
    states = itertools.accumulate(steps.unbind(dim=1), initial=observed[POSE])
    return with_rigid_bones(torch.stack(list(states)[1:], dim=1), observed)


VIEWS = {
    "rigid": View(
        OBSERVED,
        observe=lambda observed: observed,
        encode=lambda states, observed: states,
        decode=with_rigid_bones,
        same_columns=True,
    ),
    "steps": View(OBSERVED, observe=lambda observed: observed, encode=_encode_steps, decode=_decode_steps),
}
"""Seen as ``rigid``, what is learned from is as it stands in files, and what is generated has rigid bones. In ``steps`` the same
for methods that go from one pose to the next."""
