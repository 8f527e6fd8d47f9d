"""What a judge sees of a window of motion.

Joints are seen from the one they hang on, in units of the body's size, and by how fast they move: a body of another size is judged
alike, and a frozen frame or trembling joints are another motion.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.skeleton import FPS, HEAD, NECK, as_joints

RH, RK, RA, LH, LK, LA, RS, RE, RW, LS, LE, LW = range(12)
"""Joints of the right and the left side: hip, knee, ankle, shoulder, elbow, wrist."""
JOINTS = len(skeleton.JOINTS)
LOWER, UPPER = (RH, RK, RA, LH, LK, LA), (RS, RE, RW, LS, LE, LW, NECK, HEAD)
"""Joints of the legs; of arms and trunk."""
PARENT = {RK: RH, RA: RK, LK: LH, LA: LK, HEAD: NECK, RS: NECK, LS: NECK, RE: RS, LE: LS, RW: RE, LW: LE}
"""The joint that each hangs on, those near the hips first; hips and neck hang on the middle of the hips, which is the origin."""
_FREQUENCIES = 6
_SIDEWAYS = (-1.0, 1.0, 1.0)


def bones(joints: Tensor) -> Tensor:
    """Each joint ``(..., 14, 3)`` relative to its parent."""
    origin = torch.zeros_like(joints[..., 0, :])
    base = [joints[..., PARENT[joint], :] if joint in PARENT else origin for joint in range(JOINTS)]
    return joints - torch.stack(base, dim=-2)


def places(relative: Tensor) -> Tensor:
    """The inverse of :func:`bones`."""
    found = dict(enumerate(relative.unbind(dim=-2)))
    for joint, parent in PARENT.items():
        found[joint] = found[joint] + found[parent]
    return torch.stack([found[joint] for joint in range(JOINTS)], dim=-2)


def sizes(relative: Tensor) -> Tensor:
    """Length of all bones of the half of the body that each bone ``(sample, frame, 14, 3)`` is in: ``(sample, 1, 14, 1)``."""
    length = torch.linalg.vector_norm(relative, dim=-1).mean(dim=1, keepdim=True)
    half = [length[..., list(part)].sum(dim=-1) for part in (LOWER, UPPER)]
    return torch.stack([half[joint in UPPER] for joint in range(JOINTS)], dim=-1)[..., None].clamp_min(1e-3)


def _in_sizes(states: Tensor) -> Tensor:
    relative = bones(as_joints(states))
    return relative / sizes(relative)


def signals(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Courses over time for a network: of windows ``(sample, frame, 42)``, ``(sample, 9 * joints, frame)``.

    Bones and places in body sizes, and velocities in body sizes in a third of a second.
    """
    relative = _in_sizes(states)
    where = places(relative)
    velocity = torch.diff(where, dim=1) * (FPS / 3)
    velocity = torch.cat([velocity[:, :1], velocity], dim=1)
    chosen = list(joints)
    return torch.cat([values[:, :, chosen] for values in (relative, where, velocity)], dim=2).flatten(2).transpose(1, 2)


def _log(values: Tensor, floor: float) -> Tensor:
    return torch.log(floor + values)


def _of_joints(where: Tensor) -> Tensor:
    """Of joints' places ``(sample, frame, joint, 3)``: ``(sample, joint, feature)``, where they are, how far and how they move."""
    velocity = torch.diff(where, dim=1) * FPS
    speed = torch.linalg.vector_norm(velocity, dim=-1)
    change = torch.linalg.vector_norm(torch.diff(velocity, dim=1), dim=-1)
    high, low = where.amax(dim=1), where.amin(dim=1)
    waves = torch.fft.rfft(where - where.mean(dim=1, keepdim=True), dim=1).abs()[:, 1 : 1 + _FREQUENCIES] / where.shape[1]
    return torch.cat(
        [
            where.mean(dim=1),
            _log(where.std(dim=1), 0.01),
            _log(high - low, 0.03),
            high,
            low,
            _log(torch.stack([speed.mean(dim=1), speed.std(dim=1), speed.amax(dim=1), speed.amin(dim=1)], dim=-1), 0.02),
            _log(change.mean(dim=1), 0.1)[..., None],
            _log(velocity.abs().mean(dim=1), 0.003),
            _log(waves, 0.003).permute(0, 2, 3, 1).flatten(2),
        ],
        dim=-1,
    )


def _of_course(values: Tensor) -> Tensor:
    """Of a course ``(sample, frame)``: ``(sample, 5)``, its mean, spread, extremes and how fast it changes."""
    change = torch.diff(values, dim=1).abs().mean(dim=1) * FPS
    return torch.stack(
        [values.mean(dim=1), _log(values.std(dim=1), 0.02), values.amax(dim=1), values.amin(dim=1), _log(change, 0.1)], dim=1
    )


def _sides(right: Tensor, left: Tensor) -> list[Tensor]:
    """Mean and difference of both sides, which are the same for the mirror image."""
    return [(right + left) / 2, (right - left).abs()]


def _angle(one: Tensor, other: Tensor) -> Tensor:
    """Between vectors ``(..., 3)``, radians."""
    across = torch.linalg.vector_norm(torch.linalg.cross(one, other.expand_as(one)), dim=-1)
    return torch.atan2(across, (one * other).sum(dim=-1))


def _spread(values: Tensor) -> Tensor:
    return _log(torch.stack([values.std(dim=1), values.amax(dim=1) - values.amin(dim=1)], dim=1), 0.03)


def _together(one: Tensor, other: Tensor) -> Tensor:
    """Correlation of two trajectories ``(sample, frame)``: ``(sample, 1)`` from -1 to 1, near 0 where they hardly change."""
    one, other = (values - values.mean(dim=1, keepdim=True) for values in (one, other))
    lengths = torch.linalg.vector_norm(one, dim=1) * torch.linalg.vector_norm(other, dim=1)
    return ((one * other).sum(dim=1) / (lengths + 0.05))[:, None]


def _alike(where: Tensor, right: int, left: int) -> list[Tensor]:
    """Correlation of a right and a left joint: sideways, forwards, upwards, in speed."""
    speed = torch.linalg.vector_norm(torch.diff(where, dim=1), dim=-1)
    return [
        _together(-where[:, :, right, 0], where[:, :, left, 0]),
        _together(where[:, :, right, 1], where[:, :, left, 1]),
        _together(where[:, :, right, 2], where[:, :, left, 2]),
        _together(speed[:, :, right], speed[:, :, left]),
    ]


def _distances(where: Tensor, *pairs: tuple[int, int]) -> list[Tensor]:
    """Between two joints, and between their mirror images where they have any."""
    found = [
        _of_course(_log(torch.linalg.vector_norm(where[:, :, one] - where[:, :, other], dim=-1), 0.05)) for one, other in pairs
    ]
    return _sides(*found) if len(found) == 2 else found


def _upper(where: Tensor, limbs: Tensor) -> list[Tensor]:
    """Of arms and trunk."""
    neck, up = where[:, :, NECK], where.new_tensor((0.0, 0.0, 1.0))
    shoulders = where[:, :, RS] - where[:, :, LS]
    turn, side = torch.atan2(shoulders[..., 1], shoulders[..., 0]), torch.atan2(neck[..., 0], neck[..., 2])

    def angles(right: Tensor, left: Tensor) -> list[Tensor]:
        return _sides(_of_course(right), _of_course(left))

    return [
        *angles(_angle(limbs[:, :, RE], limbs[:, :, RW]), _angle(limbs[:, :, LE], limbs[:, :, LW])),
        *angles(_angle(limbs[:, :, RE], -neck), _angle(limbs[:, :, LE], -neck)),
        *angles(_angle(limbs[:, :, RE], up), _angle(limbs[:, :, LE], up)),
        *angles(_angle(limbs[:, :, RW], up), _angle(limbs[:, :, LW], up)),
        _of_course(turn.abs()),
        _spread(turn),
        _of_course(_angle(neck, up)),
        _spread(side),
        _of_course(_angle(limbs[:, :, HEAD], neck)),
        *_distances(where, (RW, LW)),
        *_distances(where, (RW, HEAD), (LW, HEAD)),
        *_distances(where, (RS, LW), (LS, RW)),
        *_alike(where, RW, LW),
        *_alike(where, RE, LE),
    ]


def _lower(where: Tensor, limbs: Tensor) -> list[Tensor]:
    """Of the legs."""
    down = where.new_tensor((0.0, 0.0, -1.0))
    found: list[Tensor] = []
    for right, left in (
        (_angle(limbs[:, :, RK], limbs[:, :, RA]), _angle(limbs[:, :, LK], limbs[:, :, LA])),
        (_angle(limbs[:, :, RK], down), _angle(limbs[:, :, LK], down)),
        (_angle(limbs[:, :, RA], down), _angle(limbs[:, :, LA], down)),
    ):
        found += _sides(_of_course(right), _of_course(left))
    return [
        *found,
        _of_course(-where[:, :, [RA, LA], 2].amin(dim=-1)),
        _of_course((where[:, :, RA, 0] - where[:, :, LA, 0]).abs()),
        *_distances(where, (RA, LA)),
        *_distances(where, (RK, LK)),
        *_alike(where, RA, LA),
        *_alike(where, RK, LK),
    ]


def _ways_together(where: Tensor, one: tuple[int, int], other: tuple[int, int], axis: int) -> Tensor:
    """How much two joints go together along an axis, and their mirror images: the mean ``(sample, 1)``."""
    first, second = (_together(where[:, :, a, axis], where[:, :, b, axis]) for a, b in (one, other))
    return (first + second) / 2


def _arms_and_legs(where: Tensor) -> list[Tensor]:
    """Correlation of arms and legs, of the same and of opposite sides."""
    found = [_together(where[:, :, [RW, LW], 2].mean(dim=-1), (where[:, :, RA, 0] - where[:, :, LA, 0]).abs())]
    for one, other in (((RW, RA), (LW, LA)), ((RW, LA), (LW, RA)), ((RW, RK), (LW, LK)), ((RW, LK), (LW, RK))):
        found += _distances(where, one, other)
        found += [_ways_together(where, one, other, axis) for axis in (1, 2)]
    return found


def summary(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Features of the whole window for a linear classifier, the same for its mirror image: ``(sample, feature)``.

    Args:
        states: windows ``(sample, frame, 42)``.
        joints: :data:`LOWER`, :data:`UPPER` or all; what of others is not looked at.
    """
    limbs = _in_sizes(states)
    where = places(limbs)
    right = [joint for joint in (RK, RA, RS, RE, RW) if joint in joints]
    left = [skeleton.MIRROR[joint] for joint in right]
    found = [
        values.flatten(1)
        for values in _sides(_of_joints(where[:, :, right]), _of_joints(where[:, :, left] * where.new_tensor(_SIDEWAYS)))
    ]
    if NECK in joints:
        middle = where[:, :, [NECK, HEAD]]
        # Sideways counts by how far, not by which side.
        found.append(_of_joints(torch.cat([middle[..., :1].abs(), middle[..., 1:]], dim=-1)).flatten(1))
        found += _upper(where, limbs)
    if RK in joints:
        found += _lower(where, limbs)
    if NECK in joints and RK in joints:
        found += _arms_and_legs(where)
    return torch.cat(found, dim=1)


def turns(states: Tensor, joints: Sequence[int]) -> Tensor:
    """How round joints' ways are, the same for the mirror image: ``(sample, feature)``.

    A way there and back on one line has one extent and encloses no area; a circle has two alike.

    Args:
        states: windows ``(sample, frame, 42)``.
        joints: :data:`LOWER`, :data:`UPPER` or all; what of others is not looked at.
    """
    where = places(_in_sizes(states))
    right = [joint for joint in (RK, RA, RE, RW) if joint in joints]
    found: list[Tensor] = []
    for side in (right, [skeleton.MIRROR[joint] for joint in right]):
        way = (where[:, :, side] - where[:, :, side].mean(dim=1, keepdim=True)).transpose(1, 2)
        extents = torch.linalg.eigvalsh(way.transpose(2, 3) @ way / way.shape[2]).flip(-1).clamp_min(0).sqrt()
        steps = torch.diff(way, dim=2)
        area = torch.linalg.vector_norm(torch.linalg.cross(way[:, :, :-1], steps).sum(dim=2), dim=-1, keepdim=True) / 2
        length = torch.linalg.vector_norm(steps, dim=-1).sum(dim=2)[..., None]
        first = extents[..., :1] + 0.02
        found.append(torch.cat([_log(extents, 0.01), extents[..., 1:] / first, area / first**2, length / first], dim=-1))
    return torch.cat([values.flatten(1) for values in _sides(*found)], dim=1)


def _extremes(values: Tensor) -> Tensor:
    """Of both sides' courses ``(sample, frame, 2)``: ``(sample, 8)``.

    Highest, lowest and mean of the side where it is most and where it is least, and the extremes that both reach at a time.
    """
    courses = torch.stack([values.amax(dim=1), values.amin(dim=1), values.mean(dim=1)], dim=1)
    at_once = torch.stack([values.amin(dim=-1).amax(dim=1), values.amax(dim=-1).amin(dim=1)], dim=1)
    return torch.cat([courses.amax(dim=-1), courses.amin(dim=-1), at_once], dim=1)


def _paces(speed: Tensor) -> Tensor:
    """Of both sides' speeds ``(sample, frame, 2)``: ``(sample, 5)``."""
    top, mean, rest = (_log(values, 0.05) for values in (speed.amax(dim=1), speed.mean(dim=1), speed.amin(dim=1)))
    return torch.stack([top.amax(dim=-1), top.amin(dim=-1), mean.amax(dim=-1), mean.amin(dim=-1), rest.mean(dim=-1)], dim=1)


def _both(where: Tensor, right: int, axis: int) -> Tensor:
    """A joint's places along an axis on both sides ``(sample, frame, 2)``, sideways away from the body."""
    sign = where.new_tensor((1.0, -1.0 if axis == 0 else 1.0))
    return where[:, :, [right, skeleton.MIRROR[right]], axis] * sign


def _bent(limbs: Tensor, upper: int, lower: int) -> Tensor:
    """How far a joint is bent on both sides, radians ``(sample, frame, 2)``."""
    other = skeleton.MIRROR
    return torch.stack(
        [_angle(limbs[:, :, upper], limbs[:, :, lower]), _angle(limbs[:, :, other[upper]], limbs[:, :, other[lower]])], dim=-1
    )


def _pair_together(values: Tensor) -> Tensor:
    return _together(values[..., 0], values[..., 1])


def extremes(states: Tensor, joints: Sequence[int]) -> Tensor:
    """Fewer features of the whole window for a second linear classifier, the same for its mirror image: ``(sample, feature)``.

    How high, how far, how bent, how fast joints get, on the side that does more and on the one that does less.

    Args:
        states: windows ``(sample, frame, 42)``.
        joints: :data:`LOWER`, :data:`UPPER` or all; what of others is not looked at.
    """
    limbs = _in_sizes(states)
    where = places(limbs)
    velocity = torch.diff(where, dim=1) * FPS
    speed = torch.linalg.vector_norm(velocity, dim=-1).unfold(1, 3, 1).mean(dim=-1)
    down = where.new_tensor((0.0, 0.0, -1.0))
    found: list[Tensor] = []
    if RK in joints:
        apart = where[:, :, RA, 0] - where[:, :, LA, 0]
        found += [_extremes(_both(where, joint, axis)) for joint, axis in ((RA, 2), (RA, 1), (RA, 0), (RK, 2), (RK, 1))]
        found += [_paces(speed[:, :, [RA, LA]]), _paces(speed[:, :, [RK, LK]])]
        found += [_extremes(_bent(limbs, RK, RA)), _extremes(_angle(limbs[:, :, [RK, LK]], down))]
        found += [_pair_together(_both(where, joint, axis)) for joint, axis in ((RA, 1), (RA, 2), (RK, 2))]
        found += [_pair_together(speed[:, :, [RA, LA]]), torch.stack([apart.amax(1), apart.amin(1), apart.mean(1)], dim=1)]
    if NECK in joints:
        neck, shoulders = where[:, :, NECK], where[:, :, RS] - where[:, :, LS]
        turn = torch.atan2(shoulders[..., 1], shoulders[..., 0])
        hands = torch.linalg.vector_norm(where[:, :, RW] - where[:, :, LW], dim=-1)
        found += [_extremes(_both(where, joint, axis)) for joint, axis in ((RW, 2), (RW, 1), (RW, 0), (RE, 2))]
        found += [_paces(speed[:, :, [RW, LW]]), _paces(speed[:, :, [RE, LE]]), _extremes(_bent(limbs, RE, RW))]
        found += [
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
        found += [legs - arms, _together(where[:, :, [RW, LW], 2].mean(dim=-1), apart.abs())]
        for one, other in (((RW, RA), (LW, LA)), ((RW, LA), (LW, RA))):
            found.append(_ways_together(where, one, other, 1))
    return torch.cat(found, dim=1)
