"""Motion features of the judge, of windows ``(sample, frame, 42)`` and the visible joints (:data:`LOWER`, :data:`UPPER` or all).

Joints are relative to their parents, in units of body size, with velocities, which distinguish frozen or trembling motion.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.skeleton import FPS, HEAD, NECK, as_joints

RH, RK, RA, LH, LK, LA, RS, RE, RW, LS, LE, LW = range(12)
"""Joints of the right and the left side: hip, knee, ankle, shoulder, elbow, wrist."""
JOINTS = len(skeleton.JOINTS)
LOWER, UPPER = (RH, RK, RA, LH, LK, LA), (RS, RE, RW, LS, LE, LW, NECK, HEAD)  # Joints of the legs, and of arms and trunk
PARENT = {RK: RH, RA: RK, LK: LH, LA: LK, HEAD: NECK, RS: NECK, LS: NECK, RE: RS, LE: LS, RW: RE, LW: LE}
"""Parent of each joint, from the hips outwards; parent of hips and neck is the origin, the middle of the hips."""
_FREQUENCIES = 6
_SIDEWAYS = (-1.0, 1.0, 1.0)


def bones(joints: Tensor) -> Tensor:
    """Joints ``(..., 14, 3)`` relative to their parents."""
    origin = torch.zeros_like(joints[..., 0, :])
    base = [joints[..., PARENT[joint], :] if joint in PARENT else origin for joint in range(JOINTS)]
    return joints - torch.stack(base, dim=-2)


def places(relative: Tensor) -> Tensor:
    """Invert :func:`bones`."""
    joints = dict(enumerate(relative.unbind(dim=-2)))
    for joint, parent in PARENT.items():
        joints[joint] = joints[joint] + joints[parent]
    return torch.stack([joints[joint] for joint in range(JOINTS)], dim=-2)


def sizes(relative: Tensor) -> Tensor:
    """Size of each bone's body half ``(sample, 1, 14, 1)``: the sum of its bone lengths, from bones ``(sample, frame, 14, 3)``."""
    length = torch.linalg.vector_norm(relative, dim=-1).mean(dim=1, keepdim=True)
    half = [length[..., list(part)].sum(dim=-1) for part in (LOWER, UPPER)]
    return torch.stack([half[joint in UPPER] for joint in range(JOINTS)], dim=-1)[..., None].clamp_min(1e-3)


def _in_sizes(states: Tensor) -> Tensor:
    relative = bones(as_joints(states))
    return relative / sizes(relative)


def signals(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Time series for a network ``(sample, 9 * joints, frame)``: bones, positions, and velocities per third of a second."""
    relative = _in_sizes(states)
    where = places(relative)
    velocity = torch.diff(where, dim=1) * (FPS / 3)
    velocity = torch.cat([velocity[:, :1], velocity], dim=1)
    return torch.cat([values[:, :, list(joints)] for values in (relative, where, velocity)], dim=2).flatten(2).transpose(1, 2)


def _log(values: Tensor, floor: float) -> Tensor:
    return torch.log(floor + values)


def _of_joints(where: Tensor) -> Tensor:
    """Position and motion features ``(sample, joint, feature)`` of joints ``(sample, frame, joint, 3)``."""
    velocity = torch.diff(where, dim=1) * FPS
    speed = torch.linalg.vector_norm(velocity, dim=-1)
    change = torch.linalg.vector_norm(torch.diff(velocity, dim=1), dim=-1)
    high, low = where.amax(dim=1), where.amin(dim=1)
    waves = torch.fft.rfft(where - where.mean(dim=1, keepdim=True), dim=1).abs()[:, 1 : 1 + _FREQUENCIES] / where.shape[1]
    speeds = torch.stack([speed.mean(dim=1), speed.std(dim=1), speed.amax(dim=1), speed.amin(dim=1)], dim=-1)
    features = [where.mean(dim=1), _log(where.std(dim=1), 0.01), _log(high - low, 0.03), high, low, _log(speeds, 0.02)]
    features += [_log(change.mean(dim=1), 0.1)[..., None], _log(velocity.abs().mean(dim=1), 0.003)]
    return torch.cat([*features, _log(waves, 0.003).permute(0, 2, 3, 1).flatten(2)], dim=-1)


def _of_course(values: Tensor) -> Tensor:
    """Mean, spread, extremes and rate of change ``(sample, 5)`` of a time series ``(sample, frame)``."""
    change = torch.diff(values, dim=1).abs().mean(dim=1) * FPS
    spread = _log(values.std(dim=1), 0.02)
    return torch.stack([values.mean(dim=1), spread, values.amax(dim=1), values.amin(dim=1), _log(change, 0.1)], dim=1)


def _sides(right: Tensor, left: Tensor) -> list[Tensor]:
    """Mean and difference of both sides, which are invariant to mirroring."""
    return [(right + left) / 2, (right - left).abs()]


def _angle(first: Tensor, second: Tensor) -> Tensor:
    """Angle between vectors ``(..., 3)`` in radians."""
    across = torch.linalg.vector_norm(torch.linalg.cross(first, second.expand_as(first)), dim=-1)
    return torch.atan2(across, (first * second).sum(dim=-1))


def _spread(values: Tensor) -> Tensor:
    return _log(torch.stack([values.std(dim=1), values.amax(dim=1) - values.amin(dim=1)], dim=1), 0.03)


def _together(first: Tensor, second: Tensor) -> Tensor:
    """Correlation ``(sample, 1)`` of time series ``(sample, frame)``, -1..1, near 0 without variation."""
    first, second = (values - values.mean(dim=1, keepdim=True) for values in (first, second))
    lengths = torch.linalg.vector_norm(first, dim=1) * torch.linalg.vector_norm(second, dim=1)
    return ((first * second).sum(dim=1) / (lengths + 0.05))[:, None]


def _alike(where: Tensor, right: int, left: int) -> list[Tensor]:
    """Correlations of a right and a left joint: sideways, forwards, upwards, in speed."""
    speed = torch.linalg.vector_norm(torch.diff(where, dim=1), dim=-1)
    forwards, upwards = (_together(where[:, :, right, axis], where[:, :, left, axis]) for axis in (1, 2))
    sideways = _together(-where[:, :, right, 0], where[:, :, left, 0])
    return [sideways, forwards, upwards, _together(speed[:, :, right], speed[:, :, left])]


def _distances(where: Tensor, *pairs: tuple[int, int]) -> list[Tensor]:
    """Distance features of a pair of joints, and of its mirror image if given."""
    courses = [_of_course(_log(torch.linalg.vector_norm(where[:, :, a] - where[:, :, b], dim=-1), 0.05)) for a, b in pairs]
    return _sides(*courses) if len(courses) == 2 else courses


def _angles(right: Tensor, to: Tensor, left: Tensor, left_to: Tensor) -> list[Tensor]:
    """Features of the angles between two vectors on the right and on the left side."""
    return _sides(_of_course(_angle(right, to)), _of_course(_angle(left, left_to)))


def _upper(where: Tensor, limbs: Tensor) -> list[Tensor]:
    """Features of arms and trunk."""
    neck, up = where[:, :, NECK], where.new_tensor((0.0, 0.0, 1.0))
    shoulders = where[:, :, RS] - where[:, :, LS]
    turn, side = torch.atan2(shoulders[..., 1], shoulders[..., 0]), torch.atan2(neck[..., 0], neck[..., 2])
    limb = limbs.unbind(dim=2)
    return [
        *_angles(limb[RE], limb[RW], limb[LE], limb[LW]),
        *_angles(limb[RE], -neck, limb[LE], -neck),
        *_angles(limb[RE], up, limb[LE], up),
        *_angles(limb[RW], up, limb[LW], up),
        _of_course(turn.abs()),
        _spread(turn),
        _of_course(_angle(neck, up)),
        _spread(side),
        _of_course(_angle(limb[HEAD], neck)),
        *_distances(where, (RW, LW)),
        *_distances(where, (RW, HEAD), (LW, HEAD)),
        *_distances(where, (RS, LW), (LS, RW)),
        *_alike(where, RW, LW),
        *_alike(where, RE, LE),
    ]


def _lower(where: Tensor, limbs: Tensor) -> list[Tensor]:
    """Features of the legs."""
    down = where.new_tensor((0.0, 0.0, -1.0))
    limb = limbs.unbind(dim=2)
    return [
        *_angles(limb[RK], limb[RA], limb[LK], limb[LA]),
        *_angles(limb[RK], down, limb[LK], down),
        *_angles(limb[RA], down, limb[LA], down),
        _of_course(-where[:, :, [RA, LA], 2].amin(dim=-1)),
        _of_course((where[:, :, RA, 0] - where[:, :, LA, 0]).abs()),
        *_distances(where, (RA, LA)),
        *_distances(where, (RK, LK)),
        *_alike(where, RA, LA),
        *_alike(where, RK, LK),
    ]


def _ways_together(where: Tensor, first: tuple[int, int], second: tuple[int, int], axis: int) -> Tensor:
    """Correlation of two joints along an axis, averaged over both sides: ``(sample, 1)``."""
    right, left = (_together(where[:, :, a, axis], where[:, :, b, axis]) for a, b in (first, second))
    return (right + left) / 2


def _arms_and_legs(where: Tensor) -> list[Tensor]:
    """Correlations of arms and legs, of the same and of opposite sides."""
    features = [_together(where[:, :, [RW, LW], 2].mean(dim=-1), (where[:, :, RA, 0] - where[:, :, LA, 0]).abs())]
    for first, second in (((RW, RA), (LW, LA)), ((RW, LA), (LW, RA)), ((RW, RK), (LW, LK)), ((RW, LK), (LW, RK))):
        features += _distances(where, first, second)
        features += [_ways_together(where, first, second, axis) for axis in (1, 2)]
    return features


def summary(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Window features for a linear classifier, invariant to mirroring: ``(sample, feature)``."""
    limbs = _in_sizes(states)
    where = places(limbs)
    right = [joint for joint in (RK, RA, RS, RE, RW) if joint in joints]
    left = [skeleton.MIRROR[joint] for joint in right]
    sides = _sides(_of_joints(where[:, :, right]), _of_joints(where[:, :, left] * where.new_tensor(_SIDEWAYS)))
    features = [values.flatten(1) for values in sides]
    if NECK in joints:
        middle = where[:, :, [NECK, HEAD]]  # with the sideways distance only, for invariance to mirroring
        features.append(_of_joints(torch.cat([middle[..., :1].abs(), middle[..., 1:]], dim=-1)).flatten(1))
        features += _upper(where, limbs)
    if RK in joints:
        features += _lower(where, limbs)
    if NECK in joints and RK in joints:
        features += _arms_and_legs(where)
    return torch.cat(features, dim=1)


def turns(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Roundness of joint paths, invariant to mirroring ``(sample, feature)``: a circle has two equal extents, a line no area."""
    where = places(_in_sizes(states))
    right = [joint for joint in (RK, RA, RE, RW) if joint in joints]
    features: list[Tensor] = []
    for side in (right, [skeleton.MIRROR[joint] for joint in right]):
        path = (where[:, :, side] - where[:, :, side].mean(dim=1, keepdim=True)).transpose(1, 2)
        extents = torch.linalg.eigvalsh(path.transpose(2, 3) @ path / path.shape[2]).flip(-1).clamp_min(0).sqrt()
        steps = torch.diff(path, dim=2)
        area = torch.linalg.vector_norm(torch.linalg.cross(path[:, :, :-1], steps).sum(dim=2), dim=-1, keepdim=True) / 2
        length = torch.linalg.vector_norm(steps, dim=-1).sum(dim=2)[..., None]
        first = extents[..., :1] + 0.02
        features.append(torch.cat([_log(extents, 0.01), extents[..., 1:] / first, area / first**2, length / first], dim=-1))
    return torch.cat([values.flatten(1) for values in _sides(*features)], dim=1)


def _extremes(values: Tensor) -> Tensor:
    """Extremes ``(sample, 8)`` of both sides' time series ``(sample, frame, 2)``, by side and that both reach at once."""
    courses = torch.stack([values.amax(dim=1), values.amin(dim=1), values.mean(dim=1)], dim=1)
    at_once = torch.stack([values.amin(dim=-1).amax(dim=1), values.amax(dim=-1).amin(dim=1)], dim=1)
    return torch.cat([courses.amax(dim=-1), courses.amin(dim=-1), at_once], dim=1)


def _paces(speed: Tensor) -> Tensor:
    """Speed features ``(sample, 5)`` of both sides' speeds ``(sample, frame, 2)``."""
    top, mean, rest = (_log(values, 0.05) for values in (speed.amax(dim=1), speed.mean(dim=1), speed.amin(dim=1)))
    return torch.stack([top.amax(dim=-1), top.amin(dim=-1), mean.amax(dim=-1), mean.amin(dim=-1), rest.mean(dim=-1)], dim=1)


def _both(where: Tensor, right: int, axis: int) -> Tensor:
    """Coordinate of a joint on both sides ``(sample, frame, 2)``, sideways away from the body."""
    sign = where.new_tensor((1.0, -1.0 if axis == 0 else 1.0))
    return where[:, :, [right, skeleton.MIRROR[right]], axis] * sign


def _bent(limbs: Tensor, upper: int, lower: int) -> Tensor:
    """Flexion of a joint on both sides in radians ``(sample, frame, 2)``."""
    sides = ((upper, lower), (skeleton.MIRROR[upper], skeleton.MIRROR[lower]))
    return torch.stack([_angle(limbs[:, :, a], limbs[:, :, b]) for a, b in sides], dim=-1)


def _pair_together(values: Tensor) -> Tensor:
    return _together(values[..., 0], values[..., 1])


def extremes(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Extremes of height, distance, flexion and speed, for a second classifier, invariant to mirroring: ``(sample, feature)``."""
    limbs = _in_sizes(states)
    where = places(limbs)
    velocity = torch.diff(where, dim=1) * FPS
    speed = torch.linalg.vector_norm(velocity, dim=-1).unfold(1, 3, 1).mean(dim=-1)
    down = where.new_tensor((0.0, 0.0, -1.0))
    features: list[Tensor] = []
    if RK in joints:
        width = where[:, :, RA, 0] - where[:, :, LA, 0]
        features += [_extremes(_both(where, joint, axis)) for joint, axis in ((RA, 2), (RA, 1), (RA, 0), (RK, 2), (RK, 1))]
        features += [_paces(speed[:, :, [RA, LA]]), _paces(speed[:, :, [RK, LK]])]
        features += [_extremes(_bent(limbs, RK, RA)), _extremes(_angle(limbs[:, :, [RK, LK]], down))]
        features += [_pair_together(_both(where, joint, axis)) for joint, axis in ((RA, 1), (RA, 2), (RK, 2))]
        features += [_pair_together(speed[:, :, [RA, LA]]), torch.stack([width.amax(1), width.amin(1), width.mean(1)], dim=1)]
    if NECK in joints:
        neck, shoulders = where[:, :, NECK], where[:, :, RS] - where[:, :, LS]
        turn = torch.atan2(shoulders[..., 1], shoulders[..., 0])
        hands = torch.linalg.vector_norm(where[:, :, RW] - where[:, :, LW], dim=-1)
        features += [_extremes(_both(where, joint, axis)) for joint, axis in ((RW, 2), (RW, 1), (RW, 0), (RE, 2))]
        features += [_paces(speed[:, :, [RW, LW]]), _paces(speed[:, :, [RE, LE]]), _extremes(_bent(limbs, RE, RW))]
        features += [
            _log(velocity[:, :, [RW, LW]].abs().mean(dim=(1, 2)), 0.02),
            neck.amax(dim=1)[:, 1:],
            neck.amin(dim=1)[:, 1:],
            neck[..., 2].mean(dim=1, keepdim=True),
            neck[..., 0].abs().amax(dim=1, keepdim=True),
            _log(torch.stack([speed[:, :, NECK].mean(dim=1), speed[:, :, NECK].amax(dim=1)], dim=1), 0.02),
            _log(torch.stack([turn.amax(1) - turn.amin(1), torch.diff(turn, dim=1).abs().mean(1) * FPS], dim=1), 0.04),
            turn.abs().amax(dim=1, keepdim=True),
            torch.stack([hands.amin(dim=1), hands.amax(dim=1), hands.mean(dim=1)], dim=1),
            *(_pair_together(_both(where, RW, axis)) for axis in range(3)),
            _pair_together(speed[:, :, [RW, LW]]),
        ]
    if NECK in joints and RK in joints:
        legs, arms = (_log(speed[:, :, pair].mean(dim=1), 0.05).mean(dim=1, keepdim=True) for pair in ([RA, LA], [RW, LW]))
        features += [legs - arms, _together(where[:, :, [RW, LW], 2].mean(dim=-1), width.abs())]
        features += [_ways_together(where, right, left, 1) for right, left in (((RW, RA), (LW, LA)), ((RW, LA), (LW, RA)))]
    return torch.cat(features, dim=1)
