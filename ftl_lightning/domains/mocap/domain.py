"""Domain object of human motion, and its views: states as in files, or with rigid bones; initial poses augmented."""

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.data.features import Feature, InitialStates, Observed, check_starts
from ftl_lightning.domains.comparison import OURS, WITH_ADAPTER, WITH_KNOTS, WITH_MODES, Compared, Comparison
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Metric, Plans, Recordings, View, deferred
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.judge import identity
from ftl_lightning.domains.mocap.skeleton import (
    COLUMNS,
    CONTACT,
    GROUPS,
    HIPS,
    HORIZON,
    NAME,
    OBSERVED,
    POSE,
    RIGID,
    ROOT,
    ROOTED_NAME,
    as_joints,
    at_rest_with_root,
    drawn_poses,
    has_root,
    mean_pose,
    with_joints,
)
from ftl_lightning.domains.mocap.source import Recorded
from ftl_lightning.domains.mocap.tasks import NEW_CONCEPTS, SUITES, TESTED, TRAINING_CONCEPTS, action, judged
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.tasks import training_suite
from ftl_lightning.services.randomness import drawn

SLIDING = 0.016  # Maximum metres a frame that a standing foot of generated motion slides: the 90th percentile of recordings
SHORTEST = 1e-3  # Minimum length in metres of a generated bone with a direction; shorter bones are not changed


def with_rigid_bones(states: Tensor, observed: Observed) -> Tensor:
    """Scale rigid bones of states ``(sample, horizon, 42)`` in metres to their lengths in the initial pose :data:`POSE`.

    From the middle of the hips outwards, each joint moves along its bone with all its descendants; recordings are unchanged.
    """
    joints, start = as_joints(states), as_joints(observed[POSE])
    moved = list(joints.unbind(dim=-2))
    for inner, outer in sorted(RIGID, key=lambda bone: bone != HIPS):
        length = torch.linalg.vector_norm(start[:, outer] - start[:, inner], dim=-1)[:, None, None]
        bone = joints[..., outer, :] - joints[..., inner, :]
        norm = torch.linalg.vector_norm(bone, dim=-1, keepdim=True)
        bone = torch.where(norm > SHORTEST, bone * (length / norm.clamp_min(SHORTEST)), bone)
        if (inner, outer) == HIPS:
            moved[inner] = -bone / 2
        moved[outer] = moved[inner] + bone
    return with_joints(states, torch.stack(moved, dim=-2))


def smoothed(states: Tensor, observed: Observed) -> Tensor:
    """Apply a running mean of three frames twice, then :func:`with_rigid_bones`; first and last frame are constant.

    Network errors are independent between frames, motion is not: the weighted mean of five frames keeps a fourth of the variance.
    """
    for _ in range(2):
        inside = (states[:, :-2] + states[:, 1:-1] + states[:, 2:]) / 3
        states = torch.cat((states[:, :1], inside, states[:, -1:]), dim=1)
    return with_rigid_bones(states, observed)


SHARE = 0.5  # Share of windows with another initial pose
BLENDED = (8, 12)  # Minimum and maximum frames of the transition to the recorded window


def _fade(share: Tensor) -> Tensor:
    """Cosine weights of the initial pose by the share of the transition that has passed: 1 at 0, 0 from 1 on."""
    return (1 + torch.cos(torch.pi * share.clamp(max=1))) / 2


def begun_elsewhere(states: Tensor, observed: Observed, draw: torch.Generator | None) -> tuple[Tensor, Observed]:
    """Start half of the windows ``(sample, frame, 42)`` in a standing or walking pose with arms down; none without ``draw``.

    Demonstrations start at rest; without this augmentation, no window leaves a stride. Frames of the transition to the recording
    are means of pose and recording with cosine weights, and with the bone lengths of the recording.
    """
    if draw is None:
        return states, observed
    count, device = len(states), states.device
    poses = with_rigid_bones(drawn(count, lambda n: drawn_poses(n, draw)).to(states)[:, None], observed)
    poses = at_rest_with_root(poses) if has_root(states) else poses
    low, high = BLENDED
    length = drawn(count, lambda n: torch.randint(low, high + 1, (n, 1, 1), generator=draw, device=draw.device)).to(device)
    share = torch.arange(states.shape[1], device=device)[None, :, None] / length
    elsewhere = (drawn(count, lambda n: torch.rand((n, 1, 1), generator=draw, device=draw.device)) < SHARE).to(device)
    weight = elsewhere * _fade(share)
    begun = torch.where(weight > 0, with_rigid_bones(weight * poses + (1 - weight) * states, observed), states)
    return begun, {**observed, POSE: begun[:, 0, : len(COLUMNS)]}


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


def _fading(states: Tensor, observed: Observed) -> Tensor:
    """Initial pose less the mean pose, which fades out over the frames of a transition; zero for the root. As states."""
    share = torch.arange(states.shape[1], device=states.device) / (sum(BLENDED) / 2)
    fading = _fade(share)[None, :, None] * (observed[POSE] - mean_pose().to(states))[:, None]
    return torch.nn.functional.pad(fading, (0, states.shape[-1] - len(COLUMNS)))


def planted(states: Tensor, observed: Observed) -> Tensor:
    """Move the root of states with root ``(sample, frame, 46)`` so that a foot that stands slides by at most :data:`SLIDING`."""
    slid, low = skeleton.sliding(states)
    size = torch.linalg.vector_norm(slid, dim=-1, keepdim=True)
    excess = slid * (1 - SLIDING / size.clamp_min(SLIDING)) * (low <= CONTACT)[..., None]
    columns = [len(COLUMNS) + ROOT.index(name) for name in ("Root.right", "Root.forward")]
    moved = states.clone()
    moved[:, 1:, columns] -= excess
    return moved


VIEWS = {
    "rigid": _RIGID,
    "faded": replace(
        _RIGID,
        encode=lambda states, observed: states - _fading(states, observed),
        decode=lambda states, observed: smoothed(states + _fading(states, observed), observed),
    ),
    "smooth": replace(_RIGID, decode=smoothed),
    "steps": View(OBSERVED, observe=lambda observed: observed, encode=_encode_steps, decode=_decode_steps),
}
"""``rigid`` has training states as in files, and generated states with rigid bones; ``smooth`` adds a running mean of generated
states. ``faded`` also subtracts the initial pose, which fades out: after a third of a second plans do not depend on how the network
subtracts it. ``steps`` has differences of poses, for autoregressive methods."""


_DRAWING, _MEASURES = "ftl_lightning.domains.mocap.rendering", "ftl_lightning.domains.mocap.measures"

_PARTS = ("full turn", "feet in time", "amplitude of hands", "amplitude of feet", "degrees turned")
_KINEMATIC = ("rule", "level", "strides", "rise", *_PARTS)
"""Metrics of :mod:`~ftl_lightning.domains.mocap.measures` without the judge, by name."""


def _frozen(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    """Plans without motion."""
    return check_starts(starts).observed[POSE][:, None].repeat(1, HORIZON, 1)


DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, COLUMNS, ("m",) * len(COLUMNS), resolution=1e-3, at_rest=False, groups=GROUPS, views=VIEWS),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES | {"training": training_suite(tuple(text for text in TRAINING_CONCEPTS if action(text) in TESTED))},
        descriptions=(*TRAINING_CONCEPTS, *NEW_CONCEPTS, *SUITES["whole"].goals),
        reads=judged,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=Recorded,
    observed=OBSERVED,
    metrics={
        ACCURACY: Metric(deferred(f"{_MEASURES}:recognised"), identity=identity()),
        **{name: Metric(deferred(f"{_MEASURES}:{name.replace(' ', '_')}")) for name in _KINEMATIC},
        "bone error": Metric(deferred(f"{_MEASURES}:bone_error"), less_is_better=True),
        "jerk": Metric(deferred(f"{_MEASURES}:jerk"), less_is_better=True),
    },
    show=Show(
        deferred(f"{_DRAWING}:picture"),
        deferred(f"{_DRAWING}:film"),
        deferred(f"{_DRAWING}:wireframe"),
        exports={".bvh": deferred("ftl_lightning.domains.mocap.bvh:bvh")},
    ),
    comparison=Comparison(
        ours=Compared(OURS, f"{WITH_MODES}, {WITH_KNOTS}, {WITH_ADAPTER}"),
        headline="rule",
        references={"frozen frame": _frozen},
        fresh=False,  # recordings are finite
    ),
    recordings=Recordings(
        prepare=deferred("ftl_lightning.domains.mocap.prepare:prepare"),
        imports={".bvh": deferred("ftl_lightning.domains.mocap.prepare:demonstrated")},
    ),
)


def _standing_still(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    """Plans with root, without motion."""
    return at_rest_with_root(_frozen(goal, count, starts, seed))


_POSE_ALONE = {POSE: Feature((len(COLUMNS),))}  # not a whole state, as the root's motion is not observed


def _with_root(view: View) -> View:
    """View of states with root, whose standing feet hardly slide."""
    return replace(view, features=_POSE_ALONE, decode=lambda states, observed: planted(view.decode(states, observed), observed))


ROOTED = replace(
    DOMAIN,
    name=ROOTED_NAME,
    plans=replace(
        DOMAIN.plans,
        columns=(*COLUMNS, *ROOT),
        units=(*DOMAIN.plans.units, "m", "m", "m", "rad"),
        groups={**GROUPS, "legs": (*GROUPS["legs"], *range(len(COLUMNS), len(COLUMNS) + len(ROOT)))},
        views={name: _with_root(VIEWS[name]) for name in ("rigid", "faded", "smooth")},
    ),
    source=partial(Recorded, rooted=True),
    observed=_POSE_ALONE,
    metrics={**DOMAIN.metrics, "skating": Metric(deferred(f"{_MEASURES}:skating"), less_is_better=True)},
    comparison=replace(DOMAIN.comparison, references={"frozen frame": _standing_still}),
    recordings=replace(DOMAIN.recordings, imports={".bvh": deferred("ftl_lightning.domains.mocap.prepare:demonstrated_with_root")}),
)
"""Human motion with the path of the root over the ground."""
