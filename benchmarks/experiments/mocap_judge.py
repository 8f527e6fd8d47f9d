"""Train the judge of motion, and measure how well it recognises actions of people outside its training set.

    python benchmarks/experiments/mocap_judge.py --root FOLDER

FOLDER contains recordings prepared by ``prepare mocap``. Writes the judge (a minute or two on one thread) and a table of numbers.
With ``--folds``, the table includes judges tested on people outside their training set (ten minutes or more for the first seed,
half of that for each further seed). The table is written after every seed.

Verifiers learn from hard negatives: near-actions made from recordings of the action. The table reports how often near-actions, made
by other rules from people outside the training set, are accepted as the action.
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from torch import Tensor
from torch.nn import functional

from ftl_lightning.domains.mocap.domain import begun_elsewhere
from ftl_lightning.domains.mocap.features import (
    LA,
    LE,
    LH,
    LK,
    LOWER,
    LS,
    LW,
    RA,
    RE,
    RH,
    RK,
    RS,
    RW,
    UPPER,
    bones,
    places,
    signals,
    sizes,
)
from ftl_lightning.domains.mocap.judge import LEGS, NUMBERS, PARTS, PATH, VERIFIED_BY, WHOLE, Judge, Network, Recogniser
from ftl_lightning.domains.mocap.skeleton import ANKLES, FPS, HORIZON, JOINTS, POSE, as_joints, mirrored
from ftl_lightning.domains.mocap.source import read_folder
from ftl_lightning.domains.mocap.tasks import CLASSES, OTHER, REVERSIBLE, STANDING, STEPPING, TESTED, action, of_legs
from ftl_lightning.services.tensor_file import file_hash, write_text

UNSEEN = ("13",)
"""Subjects whom the judge that ships has not seen: demonstrations of new concepts come from there."""
FOLDS = (
    ("13", "07", "29", "43"),
    ("14", "08", "93", "12", "38"),
    ("02", "35", "55", "11", "32"),
    ("86", "09", "26", "27", "104", "131"),
    ("05", "16", "30", "39"),
    ("49", "10", "03"),
)
"""Subjects who are held out together: of every tested class, somebody is left to learn from."""
MIXED = ("run, leap", "heian shodan", "up down", "bend over, scoop up, rise, lift arm", "jumps kicks and punches")
"""Descriptions of several actions of the judge, one after the other, without boundaries."""
STILL = 0.5
"""Metres a second. Where no joint is faster in a window, people stand; nobody shows anything but a pose."""
GLITCH = 12.0
"""Metres a second. No joint is faster."""
JUMP = 0.15
"""Metres above their usual height that the hips reach in a window of a jump."""
KICK = 0.6
"""Share of a trial's fastest ankle that a window of a kick contains."""
POOL, STEPS, BATCH = 8000, 700, 128
RATE, LARGER = (0.8, 1.25), (0.8, 1.2)
"""Paces and sizes of movement, compared to those that were recorded."""
HIDDEN = 0.3
"""Share of its courses that a network does not see, others in every window."""
RARE = 0.6
"""How often windows of a class that cannot be tested are drawn, compared to others."""
SPOILED = 1200
HARD, HARD_STEPS = 10000, 1500
"""Windows of tested actions that verifiers learn from, and as many hard negatives; steps of a verifier."""
KEPT, KEPT_CIRCLE = (0.7, 1.2), (0.9, 1.2)
"""Sizes of movement that are still the whole of an action. Recorded circles of arms are small and large; a third of a large one is
hardly smaller than a small one, so that these are not made smaller."""
AS_LARGE = (0.95, 1.05)
"""Sizes of movement that hard negatives are made of."""
SMALL, MORPHED = (0.15, 0.38), (0.35, 0.65)
"""Hard negatives: sizes of movement, compared to those that were recorded; an action's share of a mixture of two."""
BILATERAL = ("jumping jacks", "jump", "squat", "walk", "run", "arm circle")
"""Actions of both sides of the body. Whoever was recorded circling arms circled both: in nine of ten windows, the wrist that moves
less goes .92 or more of the other's way."""
STRAIGHT = ("jumping jacks", "arm circle")
"""Actions that a straight way between two of their poses is not; of a squat, for example, it is all there is in a second."""
IN_PLACE = ("signals", "twist", "arm circle", "toe touch")
"""Actions of arms and trunk for which people stand: on legs that step they are not the whole action."""


@dataclass(frozen=True)
class Windows:
    """Windows of 32 frames in one array of frames.

    Attributes:
        frames: ``(frame, 42)``.
        start, low, high: first frame of each window; ends of the single action that it is of.
        label: number of the class ``(window,)``.
        subject: whom it shows.
    """

    frames: Tensor
    start: Tensor
    low: Tensor
    high: Tensor
    label: Tensor
    subject: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, rows: Tensor) -> "Windows":
        fields = {name: getattr(self, name)[rows] for name in ("start", "low", "high", "label")}
        return replace(self, subject=self.subject[rows.numpy()], **fields)

    def of(self, subjects: Sequence[str], others: bool = False) -> "Windows":
        return self[torch.from_numpy(np.flatnonzero(np.isin(self.subject, subjects) != others))]

    def states(self, rate: Tensor | None = None) -> Tensor:
        """``(window, 32, 42)``, each at a pace of its own where rates are given."""
        pace = torch.ones(len(self)) if rate is None else rate
        times = self.start[:, None] + pace[:, None] * torch.arange(HORIZON)
        # What would end behind the action begins earlier.
        times = times - (times[:, -1:] - (self.high[:, None] - 1)).clamp_min(0)
        times = times.maximum(self.low[:, None].to(times))
        first = times.floor().long().minimum(self.high[:, None] - 1)
        after = (first + 1).minimum(self.high[:, None] - 1)
        share = (times - first)[..., None]
        return (1 - share) * self.frames[first] + share * self.frames[after]


def _spans(root: Path) -> Iterator[tuple[str, str, str, int, int]]:
    """Subject, description, kind and ends in frames: hand-made segments, else whole trials."""
    recordings, segments = read_folder(root)
    number = {trial: row for row, trial in enumerate(recordings.trial_id)}
    cut = {segment.trial_id for segment in segments}
    for row, trial in enumerate(recordings.trial_id):
        if trial not in cut:
            low, high = recordings.offsets[row : row + 2]
            yield recordings.subject[row], recordings.label[row], recordings.kind[row], int(low), int(high)
    for segment in segments:
        if segment.trial_id in number:
            row = number[segment.trial_id]
            low, high = (int(value) for value in recordings.offsets[row : row + 2])
            stop = high if segment.stop is None else min(low + segment.stop, high)
            yield recordings.subject[row], segment.label, recordings.kind[row], low + segment.start, stop


def _shows(name: str, frames: NDArray[np.int64], height: NDArray[np.float32], ankles: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether windows show the action of a description that tells of a part of its trial.

    Args:
        name: of the class.
        frames: ``(window, 32)``.
        height, ankles: of the hips in metres; of the faster ankle in metres a second ``(frame,)``.
    """
    if name == "kick":
        return ankles[frames[:, 4:-4]].max(axis=1) >= KICK * np.quantile(ankles[frames.min() : frames.max() + 1], 0.995)
    if name == "jump":
        usual = np.median(height[frames.min() : frames.max() + 1])
        return height[frames[:, 4:-4]].max(axis=1) >= usual + JUMP
    return np.ones(len(frames), dtype=bool)


def read(root: Path, stride: int, daz: bool = False) -> Windows:
    """All windows that have a class, one every ``stride`` frames."""
    recordings, _ = read_folder(root)
    joints = recordings.positions
    moved = np.linalg.norm(np.diff(joints, axis=0, append=joints[-1:]), axis=-1) * FPS
    fastest, ankles = moved.max(axis=1), moved[:, list(ANKLES)].max(axis=1)
    found: list[tuple[NDArray[np.int64], int, int, NDArray[np.int64], str]] = []
    for subject, text, kind, low, high in _spans(root):
        name = action(text) or OTHER
        starts = np.arange(low, high - HORIZON + 1, stride)
        if text in MIXED or not len(starts) or (kind == "bvh_daz" and not (daz and name in ("kick", "punch", "jump"))):
            continue
        frames = starts[:, None] + np.arange(HORIZON)
        speed = fastest[frames[:, :-1]].max(axis=1)
        shown = (speed < GLITCH) & _shows(name, frames, recordings.root[:, 2], ankles)
        label = np.where((speed < STILL) & (name != "pose"), CLASSES.index(OTHER), CLASSES.index(name))
        found.append((starts[shown], low, high, label[shown], subject))
    counts = [len(starts) for starts, *_ in found]

    def each(column: int) -> Tensor:
        return torch.from_numpy(np.repeat([row[column] for row in found], counts))

    return Windows(
        torch.from_numpy(joints).flatten(1),
        torch.from_numpy(np.concatenate([row[0] for row in found])),
        each(1),
        each(2),
        torch.from_numpy(np.concatenate([row[3] for row in found])),
        np.repeat([row[4] for row in found], counts),
    )


_EXCHANGED = torch.tensor([1 if name in STANDING else 2 if name in STEPPING else 0 for name in CLASSES])
"""What a window of each class may take from another: nothing, the legs of others who stand, the arms of others who step."""

_REVERSIBLE = torch.tensor([name in REVERSIBLE for name in CLASSES])


def _exchange(relative: Tensor, label: Tensor, other: Tensor, chosen: Tensor) -> Tensor:
    """Bones ``(window, frame, 14, 3)`` with another window's legs or arms, where both are of the same kind of action."""
    kind = _EXCHANGED[label]
    alike = chosen & (kind == kind[other])
    size = sizes(relative)
    lent = relative[other] / size[other] * size
    taken = torch.zeros(len(relative), 1, len(JOINTS), 1, dtype=torch.bool)
    taken[:, :, list(LOWER)] = (alike & (kind == 1))[:, None, None, None]
    taken[:, :, list(UPPER)] = (alike & (kind == 2))[:, None, None, None]
    return torch.where(taken, lent, relative)


def _turned(joints: Tensor, angles: Tensor) -> Tensor:
    """Joints ``(window, frame, 14, 3)`` about the axes by angles ``(window, 3)``, in radians."""
    x, y, z = angles.unbind(dim=-1)
    zero = torch.zeros_like(x)
    about = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.einsum("nij,ntkj->ntki", torch.linalg.matrix_exp(about), joints)


def _joints(*chosen: int) -> Tensor:
    return torch.zeros(len(JOINTS), 1, dtype=torch.bool).index_fill(0, torch.tensor(chosen), True)


def augmented(
    windows: Windows,
    draw: torch.Generator,
    change: Callable[[Tensor, Tensor, torch.Generator], Tensor] | None = None,
    larger: Tensor | None = None,
) -> Tensor:
    """``(window, 32, 42)`` of other paces, sides, sizes, bodies and postures, half begun elsewhere, slightly blurred or noisy.

    Args:
        windows: as recorded.
        draw: of all that is random.
        change: what else happens to bones ``(window, frame, 14, 3)`` with labels ``(window,)``, before noise.
        larger: least and greatest size of movement of each class ``(class, 2)``, otherwise :data:`LARGER`.
    """
    count = len(windows)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=draw)

    def chance(share: float) -> Tensor:
        return uniform(0, 1, count) < share

    room = (windows.high - windows.low - 1) / (HORIZON - 1)
    states = windows.states(uniform(*RATE, count).minimum(room))
    states = torch.where(chance(0.5)[:, None, None], mirrored(states), states)
    states = torch.where((_REVERSIBLE[windows.label] & chance(0.5))[:, None, None], states.flip(1), states)
    other = torch.randperm(count, generator=draw)
    relative = _exchange(bones(as_joints(states)), windows.label, other, chance(0.5))
    length = torch.linalg.vector_norm(relative, dim=-1, keepdim=True)
    middle = relative.mean(dim=1, keepdim=True)
    noise = 1 + 0.1 * normal(count, 1, len(JOINTS), 1)
    low, high = (torch.tensor(LARGER).expand(len(CLASSES), 2) if larger is None else larger)[windows.label].T[..., None, None, None]
    scale = (low + (high - low) * uniform(0, 1, count, 1, 1, 1)) * noise
    relative = middle + scale * (relative - middle)
    relative = relative * length / torch.linalg.vector_norm(relative, dim=-1, keepdim=True).clamp_min(1e-3)
    relative = relative * (1 + 0.08 * normal(count, 1, len(JOINTS), 1)).clamp(0.75, 1.25)
    # Each bone leans a little otherwise through the whole window: posture differs from person to person.
    relative = relative + 0.1 * length.mean(dim=1, keepdim=True) * normal(count, 1, len(JOINTS), 3)
    if change is not None:
        relative = change(relative, windows.label, draw)
    joints = _turned(places(relative), normal(count, 3) * torch.tensor([0.05, 0.05, 0.12]))
    drift = functional.interpolate(0.015 * normal(count, 3 * len(JOINTS), 6), size=HORIZON, mode="linear", align_corners=True)
    states = joints.flatten(2) + drift.transpose(1, 2) + uniform(0, 0.005, count, 1, 1) * normal(*states.shape)
    # Who is judged may come from another pose, as generated motion does.
    states, _ = begun_elsewhere(states, {POSE: states[:, 0]}, draw)
    padded = functional.pad(states.transpose(1, 2), (1, 1), mode="replicate")
    return torch.where(chance(0.4)[:, None, None], functional.avg_pool1d(padded, 3, stride=1).transpose(1, 2), states)


def _lenders(c: str) -> tuple[list[bool], list[bool], list[bool]]:
    """Of each class, whether its legs, its arms or its whole motion make hard negatives of action ``c``."""
    common = [name in TESTED or name == OTHER for name in CLASSES]
    steps = [name in TESTED and name not in STANDING for name in CLASSES]
    others = [of_legs(name) not in (of_legs(c), OTHER if c in IN_PLACE else None) for name in CLASSES]
    legs = [a and b for a, b in zip(steps if c in IN_PLACE else common, others, strict=True)]
    return legs, [a and name != c for a, name in zip(common, CLASSES, strict=True)], [name != c for name in CLASSES]


_LENDERS = torch.tensor([_lenders(name) for name in CLASSES])
"""``(class, 3, class)``."""
LEGS_OF_OTHERS, ARMS_OF_OTHERS, STRAIGHT_WAY, SMALLER, ONE_SIDE, MORPH = range(6)
_HARD = torch.tensor(
    [
        [
            name not in STANDING or name in IN_PLACE,
            name not in STEPPING,
            2 * (name == "arm circle") or name in STRAIGHT,
            3 * (name == "arm circle") or name not in ("walk", "run"),
            name in BILATERAL,
            True,
        ]
        for name in CLASSES
    ]
).float()
"""Of each class, how often each kind of hard negative is made of its windows, compared to others ``(class, 6)``."""
_RIGHT_ARM, _LEFT_ARM, _RIGHT_LEG, _LEFT_LEG = (RS, RE, RW), (LS, LE, LW), (RH, RK, RA), (LH, LK, LA)


def _partners(label: Tensor, lenders: Tensor, draw: torch.Generator) -> Tensor:
    """For each window the row of another, of a class ``(class, class)`` that lends to its own."""
    found = torch.arange(len(label))
    for name in label.unique():
        rows, others = (label == name).nonzero()[:, 0], lenders[name][label].nonzero()[:, 0]
        if len(others):
            found[rows] = others[torch.randint(len(others), (len(rows),), generator=draw)]
    return found


def _as_long(relative: Tensor, like: Tensor) -> Tensor:
    """Bones as long as others."""
    length = torch.linalg.vector_norm(like, dim=-1, keepdim=True)
    return relative * length / torch.linalg.vector_norm(relative, dim=-1, keepdim=True).clamp_min(1e-3)


def _at(relative: Tensor, frame: Tensor) -> Tensor:
    """One frame ``(window,)`` of each window, as a window of one frame."""
    return relative[torch.arange(len(relative)), frame][:, None]


def _straight_ways(relative: Tensor, label: Tensor, draw: torch.Generator) -> Tensor:
    """From a frame straight to the one that is farthest from it, after a while, at some speed; held, or back on the same way.

    Some begin as somebody else stands. Nobody returns in jumping jacks: there and back would be one.
    """
    count = len(relative)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, 1, generator=draw)

    frame = torch.randint(HORIZON, (count,), generator=draw)
    distance = torch.linalg.vector_norm(relative - _at(relative, frame), dim=-1)[..., list(UPPER)].sum(dim=-1)
    end = _at(relative, distance.argmax(dim=1))
    standing = torch.tensor([name in (OTHER, "walk", "signals") for name in CLASSES])
    partner = _partners(label, standing.expand(len(CLASSES), -1), draw)
    size = sizes(relative)
    start = torch.where(uniform(0, 1) < 0.3, _at(relative[partner] / size[partner] * size, frame), _at(relative, frame))
    lasts = uniform(0.3, 1)
    time = (torch.linspace(0, 1, HORIZON)[:, None, None] - uniform(0, 0.6) * (1 - lasts)) / lasts
    returns = (uniform(0, 1) < 0.5) & (label != CLASSES.index("jumping jacks"))[:, None, None, None]
    time = torch.where(returns, 1 - (2 * time - 1).abs(), time).clamp(0, 1)
    share = torch.where(uniform(0, 1) < 0.7, time**2 * (3 - 2 * time), time)
    found = (1 - share) * start + share * end
    found = torch.where(uniform(0, 1) < 0.5, _as_long(found, relative), found)
    legs_stay = (uniform(0, 1) < 0.5) & torch.tensor([name in STANDING for name in CLASSES])[label][:, None, None, None]
    return torch.where(legs_stay & _joints(*LOWER), relative, found)


def _one_sided(relative: Tensor, label: Tensor, draw: torch.Generator) -> Tensor:
    """One arm, one leg or both of a side do nothing, of those that matter."""
    count = len(relative)
    side = torch.stack([_joints(*_RIGHT_ARM), _joints(*_LEFT_ARM), _joints(*_RIGHT_LEG), _joints(*_LEFT_LEG)])
    right, which = torch.randint(2, (count,), generator=draw), torch.randint(3, (count,), generator=draw)
    kind = _EXCHANGED[label]
    legs_only, arms_only = (kind == 2) | (label == CLASSES.index("jump")), kind == 1
    arm = (which != 0) & ~legs_only | (which == 0) & arms_only
    leg = (which != 1) & ~arms_only | (which == 1) & legs_only
    frozen = arm[:, None, None] & side[right] | leg[:, None, None] & side[2 + right]
    some = _at(relative, torch.randint(HORIZON, (count,), generator=draw))
    mean = _as_long(relative.mean(dim=1, keepdim=True), some)
    rest = torch.where(torch.rand(count, 1, 1, 1, generator=draw) < 0.5, some, mean)
    return torch.where(frozen[:, None], rest, relative)


def hard_negatives(relative: Tensor, label: Tensor, draw: torch.Generator) -> Tensor:
    """What is nearly an action, but not the whole: of bones ``(window, frame, 14, 3)``, the same number.

    Arms and trunk on another action's legs, legs with another's arms, a straight way between two poses, a third of the movement,
    one side only, mixtures with other actions.
    """
    size = sizes(relative)
    kind = torch.multinomial(_HARD[label], 1, generator=draw)[:, :, None, None]
    legs, arms, whole = (
        relative[other] / size[other] * size for other in (_partners(label, _LENDERS[:, n], draw) for n in range(3))
    )

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(len(relative), 1, 1, 1, generator=draw)

    middle = relative.mean(dim=1, keepdim=True)
    small = _as_long(middle + uniform(*SMALL) * (relative - middle), relative)
    share = uniform(*MORPHED)
    morph = share * relative + (1 - share) * whole
    morph = torch.where(uniform(0, 1) < 0.5, _as_long(morph, relative), morph)
    lower = _joints(*LOWER)
    found = {
        LEGS_OF_OTHERS: torch.where(lower, legs, relative),
        ARMS_OF_OTHERS: torch.where(lower, relative, arms),
        STRAIGHT_WAY: _straight_ways(relative, label, draw),
        SMALLER: small,
        ONE_SIDE: _one_sided(relative, label, draw),
        MORPH: morph,
    }
    for number, changed in found.items():
        relative = torch.where(kind == number, changed, relative)
    return relative


def spoiled(states: Tensor, draw: torch.Generator) -> Tensor:
    """Windows that are no motion: a frozen frame, frames in random order, trembling joints; a third of each."""
    count = len(states)
    rows = torch.arange(count)
    noise = torch.randn(states.shape, generator=draw)
    frozen = states[rows, torch.randint(HORIZON, (count,), generator=draw)][:, None] + 0.002 * noise
    shuffled = states[rows[:, None], torch.rand(count, HORIZON, generator=draw).argsort(dim=1)]
    trembling = 0.03 + 0.03 * torch.rand(count, 1, 1, generator=draw)
    kind = torch.arange(count)[:, None, None] % 3
    return torch.where(kind == 0, frozen, torch.where(kind == 1, shuffled, states + trembling * noise))


def chances(windows: Windows) -> Tensor:
    """How often each window is drawn: classes alike; of a class, subjects by the square root of their number of windows."""
    subjects = np.unique(windows.subject, return_inverse=True)[1]
    pairs, pair, number = np.unique(np.stack([windows.label.numpy(), subjects]), axis=1, return_inverse=True, return_counts=True)
    share = np.sqrt(number)
    of_class = np.bincount(pairs[0], weights=share)
    wanted = np.where(windows.label.numpy() < len(TESTED), 1.0, RARE)
    return torch.from_numpy(wanted * (share / number / of_class[pairs[0]])[pair.reshape(-1)])


def labels_of(part: str, label: Tensor) -> Tensor:
    """Numbers of the part's classes, given those of :data:`CLASSES`."""
    names = PARTS[part][1]
    return torch.tensor([names.index(of_legs(name) if part == LEGS else name) for name in CLASSES])[label]


def pool(windows: Windows, seed: int) -> tuple[Tensor, Tensor]:
    """States ``(POOL + SPOILED, 32, 42)`` and classes to train on."""
    draw = torch.Generator().manual_seed(seed)
    chosen = windows[torch.multinomial(chances(windows), POOL, replacement=True, generator=draw)]
    states = augmented(chosen, draw)
    nothing = spoiled(states[torch.randint(POOL, (SPOILED,), generator=draw)], draw)
    label = torch.cat([chosen.label, torch.full((SPOILED,), CLASSES.index(OTHER))])
    return torch.cat([states, nothing]), label


@torch.no_grad()
def _fit_linear(layer: torch.nn.Module, numbers: Tensor, label: Tensor, strength: float) -> None:
    assert isinstance(layer, torch.nn.Linear)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it stops before it has converged, which is as good as more regularisation
        found = LogisticRegression(C=strength, max_iter=150).fit(numbers.numpy(), label.numpy())
    layer.weight.zero_()
    layer.bias.fill_(-20.0)  # a class that nobody shows is never said
    layer.weight[torch.from_numpy(found.classes_)] = torch.from_numpy(found.coef_).float()
    layer.bias[torch.from_numpy(found.classes_)] = torch.from_numpy(found.intercept_).float()


def fit(recogniser: Recogniser, states: Tensor, label: Tensor, seed: int, steps: int = STEPS) -> None:
    """Train networks and linear recognisers.

    Args:
        recogniser: is changed.
        states, label: windows ``(window, 32, 42)`` and the numbers of their classes.
        seed: of the networks' weights and of the order of windows.
        steps: of a network.
    """
    recogniser.set_scale("signals", signals(states, recogniser.joints), 0.02)
    courses = recogniser.courses(states)
    for name, strength in (("summary", 1e-3), ("extremes", 2e-3)):
        recogniser.set_scale(name, NUMBERS[name](states, recogniser.joints), 0.02)
        _fit_linear(recogniser.linear[name], recogniser.numbers(states)[name], label, strength)

    def loss(logits: Tensor, rows: Tensor) -> Tensor:
        return functional.cross_entropy(logits, label[rows], label_smoothing=0.1)

    for member, network in enumerate(recogniser.networks):
        _fit_network(network, courses, loss, 1000 * seed + member, steps)
    first = recogniser.networks[0]
    assert isinstance(first, Network)
    with torch.no_grad():
        recogniser.set_scale("embedding", torch.cat([first.embedding(some) for some in courses.split(1000)]), 1e-3)


def _fit_network(
    network: torch.nn.Module,
    courses: Tensor,
    loss: Callable[[Tensor, Tensor], Tensor],
    seed: int,
    steps: int,
    hidden: float = HIDDEN,
    decay: float = 0.05,
) -> None:
    """Train a network from the start on courses ``(window, channel, frame)``.

    Args:
        network: is changed.
        courses: that it sees.
        loss: of its logits ``(row, class)`` for rows of the courses.
        seed: of its weights and of the order of windows.
        steps: how many.
    """
    network.train()
    torch.manual_seed(seed)
    for layer in network.modules():
        if isinstance(layer, torch.nn.Conv1d | torch.nn.Linear | torch.nn.GroupNorm):
            layer.reset_parameters()
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    for _ in range(steps):
        rows = torch.randint(len(courses), (BATCH,))
        seen = (torch.rand(BATCH, *courses.shape[1:-1], 1) > hidden) / (1 - hidden) if hidden else 1.0
        found = loss(network(courses[rows] * seen), rows)
        optimiser.zero_grad()
        found.backward()
        optimiser.step()
        schedule.step()
    network.eval()


def hard_pools(windows: Windows, seed: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Windows ``(window, 32, 42)`` of tested actions, and hard negatives of them, each with numbers of their classes.

    Verifiers learn more actions than they are asked about: where they learned five, they refused more people.
    """
    draw = torch.Generator().manual_seed(10_000 + seed)
    often = chances(windows) * torch.tensor([2.0 if name in STRAIGHT else 1.0 for name in CLASSES])[windows.label]
    asked = torch.tensor([name in TESTED for name in CLASSES])
    kept = torch.tensor([KEPT_CIRCLE if name == "arm circle" else KEPT for name in CLASSES])

    def drawn(weight: Tensor, count: int) -> Tensor:
        return torch.multinomial(weight, count, replacement=True, generator=draw)

    whole = windows[drawn(often * asked[windows.label], HARD)]
    shown = augmented(whole, draw, larger=kept)
    # Half as many windows of all classes follow, which only lend what hard negatives take from others.
    nearly_whole = windows[torch.cat([drawn(often * asked[windows.label], HARD), drawn(chances(windows), HARD // 2)])]
    hard = augmented(nearly_whole, draw, hard_negatives, torch.tensor(AS_LARGE).expand(len(CLASSES), 2))
    return (shown, whole.label), (hard[:HARD], nearly_whole.label[:HARD])


def fit_verifiers(
    recogniser: Recogniser, whole: tuple[Tensor, Tensor], hard: tuple[Tensor, Tensor], seed: int, steps: int = HARD_STEPS
) -> None:
    """Train verifiers of a recogniser whose scale is known.

    Args:
        recogniser: is changed.
        whole, hard: windows ``(window, 32, 42)`` that show an action and that nearly do, each with the numbers of their classes.
        seed: of the networks' weights and of the order of windows.
        steps: of a network.
    """
    states, label = torch.cat([whole[0], hard[0]]), torch.cat([whole[1], hard[1]])
    recogniser.set_scale("turns", VERIFIED_BY["turns"](states, recogniser.joints), 0.02)
    numbers = torch.cat([torch.cat(list(recogniser.numbers(some).values()), dim=1) for some in states.split(2000)])
    shown = torch.cat([torch.ones(len(whole[1])), torch.zeros(len(hard[1]))])

    def loss(logits: Tensor, rows: Tensor) -> Tensor:
        asked = logits.gather(1, label[rows][:, None])[:, 0]
        return functional.binary_cross_entropy_with_logits(asked, shown[rows])

    for member, verifier in enumerate(recogniser.verifiers):
        _fit_network(verifier, numbers, loss, 1000 * seed + 100 + member, steps, hidden=0.0, decay=0.1)


def train(
    windows: Windows, seed: int, parts: Sequence[str] = tuple(PARTS), steps: int = STEPS, hard_steps: int = HARD_STEPS
) -> Judge:
    """A judge that has seen these windows."""
    states, label = pool(windows, seed)
    judge = Judge()
    for name in parts:
        fit(judge.part(name), states, labels_of(name, label), seed, steps)
    if WHOLE in parts:
        fit_verifiers(judge.part(WHOLE), *hard_pools(windows, seed), seed, hard_steps)
    return judge


def _tested(part: str) -> list[str]:
    """Classes of a part that two subjects or more show."""
    return list(dict.fromkeys(of_legs(name) if part == LEGS else name for name in TESTED))


def _recalls(part: str, scores: Tensor, label: Tensor) -> dict[str, float]:
    names, said = PARTS[part][1], scores.argmax(dim=-1).masked_fill(scores.isinf().all(dim=-1), -1)
    return {name: float((said[label == names.index(name)] == names.index(name)).float().mean()) for name in _tested(part)}


def _closed(part: str, scores: Tensor) -> Tensor:
    """Scores as if the tested classes were all there are."""
    names = PARTS[part][1]
    allowed = torch.tensor([name in _tested(part) for name in names])
    return scores.masked_fill(~allowed, -torch.inf)


def _of_class(windows: Windows, *names: str) -> Tensor:
    """Windows ``(window, 32, 42)`` of these classes."""
    classes = [CLASSES.index(name) for name in names]
    return windows[torch.from_numpy(np.flatnonzero(np.isin(windows.label, classes)))].states()


def nearly(name: str, shown: Tensor, walks: Tensor, stands: Tensor) -> dict[str, Tensor]:
    """Windows that nearly show an action, by rules without chance.

    Args:
        name: 'jumping jacks' or 'arm circle'.
        shown, walks, stands: windows ``(window, 32, 42)`` that show it, and of people who walk and who stand.
    """
    rows = torch.arange(len(shown))
    relative = bones(as_joints(shown))
    size = sizes(relative)
    lower = _joints(*LOWER)

    def of(others: Tensor) -> Tensor:
        lent = bones(as_joints(others[rows * 7 % len(others)]))
        return lent / sizes(lent) * size

    hands = as_joints(shown)[:, :, [RW, LW], 2].mean(dim=-1)
    hanging, raised = _at(relative, hands.argmin(dim=1)), _at(relative, hands.argmax(dim=1))
    share = torch.linspace(0, 1, HORIZON)[:, None, None]
    middle = relative.mean(dim=1, keepdim=True)
    found = {
        "arms on walking legs": torch.where(lower, of(walks), relative),
        "straight line from hanging arms to the raised pose": hanging + share * (raised - hanging),
        "the same in half the time, then held": hanging + (2 * share).clamp(max=1) * (raised - hanging),
        "a third of the amplitude": _as_long(middle + (relative - middle) / 3, relative),
        "one arm only": torch.cat([torch.where(_joints(*arm), hanging, relative) for arm in (_RIGHT_ARM, _LEFT_ARM)]),
        "half walking": (relative + of(walks)) / 2,
    }
    if name == "arm circle":
        back = 1 - (2 * share - 1).abs()
        return found | {"straight up and straight back": hanging + back * (raised - hanging)}
    sides = ((_RIGHT_ARM, _RIGHT_LEG), (_LEFT_ARM, _LEFT_LEG))
    return found | {
        "arms on standing legs": torch.where(lower, of(stands), relative),
        "legs with walking arms": torch.where(lower, relative, of(walks)),
        "legs with standing arms": torch.where(lower, relative, of(stands)),
        "one leg only": torch.cat([torch.where(_joints(*leg), hanging, relative) for _, leg in sides]),
        "one side only": torch.cat([torch.where(_joints(*arm, *leg), hanging, relative) for arm, leg in sides]),
    }


def hard_shares(judge: Judge, unseen: Windows, others: Windows) -> dict[str, dict[str, float]]:
    """How often the judge says an action of what is nearly one, and of what is one, by action and person.

    Args:
        judge: has not seen the people of ``unseen``.
        unseen: windows that show the actions, from which all is made.
        others: windows whose people lend what is exchanged or mixed, where those of ``unseen`` neither walk nor stand.
    """
    found: dict[str, dict[str, float]] = {}
    walks, stands = (
        own if len(own := _of_class(unseen, *classes)) else _of_class(others, *classes) for classes in (("walk",), (OTHER,))
    )
    for name, person in ((name, str(person)) for name in STRAIGHT for person in np.unique(unseen.subject)):
        shown = _of_class(unseen.of((person,)), name)
        if not len(shown):
            continue
        relative = bones(as_joints(shown))
        middle = relative.mean(dim=1, keepdim=True)
        seven_tenths = places(_as_long(middle + 0.7 * (relative - middle), relative)).flatten(2)
        made = {kind: places(windows).flatten(2) for kind, windows in nearly(name, shown, walks, stands).items()}
        begun, _ = begun_elsewhere(shown, {POSE: shown[:, 0]}, torch.Generator().manual_seed(0))
        begun = begun[(begun[:, 0] != shown[:, 0]).any(dim=1)]
        with torch.no_grad():
            found[f"{name} of subject {person}"] = {
                kind: float(judge.part(WHOLE).says(states, name).float().mean())
                for kind, states in {
                    "as recorded": shown,
                    "begun in another pose": begun,
                    "seven tenths of the amplitude": seven_tenths,
                    **made,
                }.items()
            }
    return found


def across_people(root: Path, seed: int, parts: Sequence[str]) -> dict[str, Any]:
    """How judges recognise people they have not seen: every subject is judged by one that was trained without."""
    learned, asked = read(root, 2), read(root, 6)
    scores: dict[str, list[Tensor]] = {}
    tests = [asked.of(fold) for fold in FOLDS]
    hard: dict[str, dict[str, float]] = {}
    for fold, test in zip(FOLDS, tests, strict=True):
        judge = train(learned.of(fold, others=True), seed, parts)
        hard |= hard_shares(judge, learned.of(fold), learned)
        with torch.no_grad():
            for part in parts:
                recogniser, states = judge.part(part), test.states()
                for name, vote in {**recogniser.votes(states), "together": recogniser(states)}.items():
                    scores.setdefault(f"{part} {name}", []).append(vote)
    found: dict[str, Any] = {"seed": seed, "windows": sum(map(len, tests)), "hard negatives": hard}
    label = torch.cat([test.label for test in tests])
    subject = np.concatenate([test.subject for test in tests])
    for key, votes_of_folds in scores.items():
        part, name = key.split()
        vote, right = torch.cat(votes_of_folds), labels_of(part, label)
        recalls = _recalls(part, vote, right)
        found[key] = {
            "balanced accuracy": float(np.mean(list(recalls.values()))),
            "of the tested classes alone": float(np.mean(list(_recalls(part, _closed(part, vote), right).values()))),
        }
        if name != "together":
            continue
        said, names = vote.argmax(dim=-1), PARTS[part][1]
        found[key] |= {
            "recalls": recalls,
            "recalls by subject": {
                class_name: {
                    str(person): float((said[rows] == names.index(class_name)).float().mean())
                    for person in np.unique(subject[(right == names.index(class_name)).numpy()])
                    if len(rows := np.flatnonzero((right == names.index(class_name)).numpy() & (subject == person)))
                }
                for class_name in _tested(part)
            },
            "false positives": {
                class_name: float((said[right != names.index(class_name)] == names.index(class_name)).float().mean())
                for class_name in ("jumping jacks", "arm circle", "knee raise")
                if class_name in names
            },
        }
    return found


def references(judge: Judge, root: Path) -> dict[str, float]:
    """What the judge says of jumping jacks of a subject it has not seen, of walking, and of what is no motion."""
    windows = read(root, 4)
    unseen = windows.of(UNSEEN)
    jacks = unseen[torch.from_numpy(np.flatnonzero(unseen.label == CLASSES.index("jumping jacks")))].states()
    walks = windows[torch.from_numpy(np.flatnonzero(windows.label == CLASSES.index("walk")))].states()
    frames = jacks[:, ::8].flatten(0, 1)[:, None].repeat(1, HORIZON, 1)
    mean = unseen.states().mean(dim=(0, 1), keepdim=True).repeat(1, HORIZON, 1)
    shuffled = jacks[:, torch.randperm(HORIZON, generator=torch.Generator().manual_seed(0))]
    # Arms of jumping jacks on legs that walk, two people: a composition by hand.
    joints, legs = as_joints(jacks).clone(), as_joints(walks)
    joints[:, :, list(LOWER)] = legs[torch.arange(len(joints)) * 7 % len(legs)][:, :, list(LOWER)]
    both = joints.flatten(2)
    rows = {"jumping jacks": jacks, "walking": walks, "frozen frames": frames, "mean pose": mean, "shuffled frames": shuffled}
    found = {
        f"{name} judged jumping jacks": float(judge.recognised("jumping jacks", states).float().mean())
        for name, states in rows.items()
    }
    frozen = read(root, 20).states()[:, :1].repeat(1, HORIZON, 1)
    said = judge.part(WHOLE)(frozen).argmax(dim=-1)
    found["frozen frames of any motion judged a tested class"] = float((said < len(TESTED)).float().mean())
    for size in (0.01, 0.03, 0.06):
        noise = torch.randn(jacks.shape, generator=torch.Generator().manual_seed(1))
        name = f"jumping jacks that tremble by {100 * size:.0f} cm judged jumping jacks"
        found[name] = float(judge.recognised("jumping jacks", jacks + size * noise).float().mean())
    for name, states in (("arms of jumping jacks on walking legs", both), ("jumping jacks", jacks), ("walking", walks)):
        found[f"{name} judged jumping jacks + walk"] = float(judge.recognised("jumping jacks + walk", states).float().mean())
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Train the judge of motion.")
    parser.add_argument("--root", type=Path, required=True, help="folder of recordings")
    parser.add_argument("--out", type=Path, default=PATH, help="file of the judge")
    parser.add_argument("--table", type=Path, default=Path("results/mocap_judge.json"), help="file of the numbers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folds", type=int, default=0, help="seeds for which judges are tested on people they have not seen")
    chosen = parser.parse_args(arguments)
    began = time.time()
    judge = train(read(chosen.root, 2).of(UNSEEN, others=True), chosen.seed)
    settings = {
        "seed": chosen.seed,
        "without subjects": UNSEEN,
        "windows": POOL,
        "steps": STEPS,
        "windows for hard negatives": HARD,
        "steps of a verifier": HARD_STEPS,
        "tested classes": TESTED,
    }
    judge.save(chosen.out, settings)
    judge = Judge.load(chosen.out)
    table = json.loads(chosen.table.read_text()) if chosen.table.is_file() else {}
    every = read(chosen.root, 2)
    table |= {
        "judge": file_hash(chosen.out),
        "training": settings,
        "references": references(judge, chosen.root),
        "hard negatives": hard_shares(judge, every.of(UNSEEN), every),
    }

    def write() -> None:
        write_text(chosen.table, json.dumps(table, indent=1) + "\n")

    write()
    print(f"{chosen.out}: {chosen.out.stat().st_size / 1000:.0f} kB, {time.time() - began:.0f} s", flush=True)
    for name, value in table["references"].items():
        print(f"{name:68} {value:.2f}")
    _print_hard(table["hard negatives"])
    runs: list[dict[str, Any]] = []
    for number in range(chosen.folds):
        runs.append(across_people(chosen.root, chosen.seed + number, (WHOLE,) if number else tuple(PARTS)))
        table["across people"] = runs
        write()
        print(f"seed {runs[-1]['seed']}: balanced accuracy {runs[-1][f'{WHOLE} together']['balanced accuracy']:.3f}", flush=True)
        _print_hard(runs[-1]["hard negatives"])
    for key in [key for key, value in runs[0].items() if isinstance(value, dict) and "balanced accuracy" in value] if runs else []:
        values = [run[key]["balanced accuracy"] for run in runs if key in run]
        alone = [run[key]["of the tested classes alone"] for run in runs if key in run]
        print(f"{key:18} {np.mean(values):.3f} ({np.std(values):.3f}), tested classes alone {np.mean(alone):.3f}")


def _print_hard(shares: dict[str, dict[str, float]]) -> None:
    for name, of_kind in shares.items():
        print(f"{name}: {', '.join(f'{kind} {share:.2f}' for kind, share in of_kind.items())}", flush=True)


if __name__ == "__main__":
    main()
