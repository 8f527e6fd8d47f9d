"""Measures of generated motion: action, naturalness, and distance to recordings.

Domain metrics map ``(goal, states (sample, 32, 42), initial states or None) -> (sample,)``. Other measures compare sets of windows
by features of the judge, which was trained on neither generated motion nor the generator.
"""

import itertools
import warnings
from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.mocap import kinematics
from ftl_lightning.domains.mocap.features import extremes
from ftl_lightning.domains.mocap.judge import PARTS, WHOLE, Judge, shipped_judge
from ftl_lightning.domains.mocap.skeleton import BONES, RIGID, SHOULDERS, WRISTS, as_joints, bone_lengths
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import check_extra

POSE = "pose"
"""Observed feature of the initial pose."""
ENOUGH = 500
"""Windows per side above which distances of distributions depend more on motion than on the number of windows."""
JACKS, CIRCLES = ("jumping jacks",), ("arm circle",)
"""Goals with measures of hands and feet, and of turning arms."""
_RIGID = [BONES.index(bone) for bone in RIGID]


def recognised(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether the shipped judge recognises the goal: ``(sample,)`` of bool, see :meth:`Judge.recognised`."""
    return shipped_judge().recognised(goal, states)


def bone_error(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Mean relative difference of rigid bone lengths from those of the initial state: ``(sample,)``.

    Without initial states, from those of the first frame. Recordings have 0.
    """
    first = states[:, 0] if starts is None else starts.observed[POSE]
    usual = bone_lengths(first)[:, None, _RIGID]
    return ((bone_lengths(states)[..., _RIGID] - usual).abs() / usual.clamp_min(1e-3)).mean(dim=(1, 2))


def jerk(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Mean jerk: ``(sample,)``, see :func:`~ftl_lightning.domains.mocap.kinematics.jerk`."""
    return kinematics.jerk(states)


def rise(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether both wrists rise from below their shoulders to above them: ``(sample,)`` of bool.

    From raised arms, they have to come down and rise again; no initial pose suffices by itself.
    """
    joints = as_joints(states)
    above = joints[..., list(WRISTS), 2] - joints[..., list(SHOULDERS), 2]
    low, high = (above < 0).all(dim=-1), (above > 0).all(dim=-1)
    return (low.int().cummax(dim=1).values.bool() & high).any(dim=1)


def _nothing(states: Tensor) -> Tensor:
    return torch.full((len(states),), torch.nan)


def rule(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether the goal's rule of :mod:`~ftl_lightning.domains.mocap.kinematics` holds: ``(sample,)`` of 0 and 1.

    NaN for goals without a rule.
    """
    return kinematics.RULES[goal](states).float() if goal in kinematics.RULES else _nothing(states)


def _first(states: Tensor, starts: InitialStates | None) -> Tensor:
    return states[:, 0] if starts is None else starts.observed[POSE]


def level(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """:func:`rule` for level initial poses; NaN for strides."""
    return rule(goal, states, starts).masked_fill(kinematics.strides(_first(states, starts)), torch.nan)


def strides(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """:func:`rule` for strides as initial poses; NaN for level poses."""
    return rule(goal, states, starts).masked_fill(~kinematics.strides(_first(states, starts)), torch.nan)


def _limited(goals: tuple[str, ...], measure: Callable[[Tensor], Tensor]) -> Callable[[str, Tensor, InitialStates | None], Tensor]:
    """Restrict a measure to goals; NaN for others."""

    def measured(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        return measure(states).float() if goal in goals else _nothing(states)

    return measured


feet_in_time = _limited(JACKS, kinematics.feet_in_time)
amplitude_of_hands = _limited(JACKS, kinematics.hands_amplitude)
amplitude_of_feet = _limited(JACKS, kinematics.feet_amplitude)
degrees_turned = _limited(CIRCLES, kinematics.degrees_turned)


def distances(generated: Tensor, real: Tensor, seed: int, judge: Judge | None = None) -> dict[str, float]:
    """Frechet and kernel distance of two sets of windows in the judge's features, at equal numbers.

    The Frechet distance falls with the number of windows even for equal distributions: compare only rows of equal number, and add a
    row of real against real motion. The kernel distance has no such bias.

    Args:
        generated, real: windows ``(sample, 32, 42)``; the larger set is subsampled to the size of the smaller.
        seed: seed of the subsample.
        judge: source of features; ``None`` for the shipped judge.

    Returns:
        ``fid``, ``kid`` (times 1,000), and ``number`` of windows per side; below :data:`ENOUGH` the Frechet distance means little.

    Raises:
        UserError: for a side of fewer than two windows.
    """
    judge = judge or shipped_judge()
    number = min(len(generated), len(real))
    if number < 2:
        raise UserError(f"distances of motion: expected two windows or more on each side, found {len(generated)} and {len(real)}")
    draw = torch.Generator().manual_seed(seed)
    sides = {True: real, False: generated}
    chosen = {is_real: windows[torch.randperm(len(windows), generator=draw)[:number]] for is_real, windows in sides.items()}
    values = {}
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        warnings.simplefilter("ignore")  # about the memory of features, which are few
        torch.manual_seed(seed)
        frechet = FrechetInceptionDistance(feature=judge)
        kernel = KernelInceptionDistance(feature=judge, subsets=50, subset_size=min(number, ENOUGH))
        for name, metric in (("fid", frechet), ("kid", kernel)):
            for is_real, windows in chosen.items():
                metric.update(windows, real=is_real)
            value = metric.compute()
            values[name] = float(value[0] * 1000 if isinstance(value, tuple) else value)
    return values | {"number": float(number)}


def _mean_distance(features: Tensor, pairs: int, draw: torch.Generator) -> Tensor:
    """Mean distance of random pairs of different rows."""
    first = torch.randint(len(features), (pairs,), generator=draw)
    second = (first + torch.randint(1, len(features), (pairs,), generator=draw)) % len(features)
    return torch.linalg.vector_norm(features[first] - features[second], dim=-1).mean()


def diversity(states: Tensor, seed: int, pairs: int = 200, judge: Judge | None = None) -> float:
    """Mean distance of random pairs of windows ``(sample, 32, 42)`` in the judge's features.

    Raises:
        UserError: for fewer than two windows.
    """
    if len(states) < 2:
        raise UserError(f"diversity of motion: expected two windows or more, found {len(states)}")
    return float(_mean_distance((judge or shipped_judge())(states), pairs, torch.Generator().manual_seed(seed)))


def multimodality(states: Mapping[str, Tensor], seed: int, pairs: int = 20, judge: Judge | None = None) -> float:
    """Mean over goals of :func:`diversity` within a goal; goals of fewer than two windows are omitted.

    Raises:
        UserError: if no goal has two windows.
    """
    draw, judge = torch.Generator().manual_seed(seed), judge or shipped_judge()
    means = [_mean_distance(judge(windows), pairs, draw) for windows in states.values() if len(windows) > 1]
    if not means:
        raise UserError("multimodality of motion: expected two windows or more of some goal, found none")
    return float(torch.stack(means).mean())


def learned_elsewhere(generated: Mapping[str, Tensor], real: Mapping[str, Tensor]) -> float:
    """Balanced accuracy on real windows of a linear classifier trained on generated windows.

    Args:
        generated, real: windows ``(sample, 32, 42)`` by class, of the same classes.

    Raises:
        UserError: for different classes, or fewer than two; without scikit-learn.
    """
    check_extra("mocap", "learned_elsewhere")
    from sklearn.linear_model import LogisticRegression  # a second to import

    names = sorted(generated)
    if names != sorted(real) or len(names) < 2:
        raise UserError(
            f"train on generated, test on real: expected the same two classes or more, found {', '.join(names)} and "
            f"{', '.join(sorted(real))}"
        )
    joints = PARTS[WHOLE][0]

    def numbers(windows: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        labels = itertools.chain.from_iterable([index] * len(windows[name]) for index, name in enumerate(names))
        return extremes(torch.cat([windows[name] for name in names]), joints), torch.tensor(list(labels))

    (inputs, labels), (tested, right) = numbers(generated), numbers(real)
    mean, std = inputs.mean(dim=0), inputs.std(dim=0).clamp_min(0.02)
    classifier = LogisticRegression(C=0.01, max_iter=500).fit(((inputs - mean) / std).clamp(-5, 5).numpy(), labels.numpy())
    said = torch.from_numpy(classifier.predict(((tested - mean) / std).clamp(-5, 5).numpy()))
    return float(torch.stack([(said[right == index] == index).float().mean() for index in range(len(names))]).mean())


MEASURES: Mapping[str, Callable[[str, Tensor, InitialStates | None], Tensor]] = {
    "accuracy": recognised,
    "bone error": bone_error,
    "jerk": jerk,
    "rule": rule,
    "level": level,
    "strides": strides,
    "rise": rise,
    "feet in time": feet_in_time,
    "amplitude of hands": amplitude_of_hands,
    "amplitude of feet": amplitude_of_feet,
    "degrees turned": degrees_turned,
}
"""Metrics of plans by name; lower is better for bone error and jerk. ``rise`` to ``degrees turned`` are parts of the rules."""
