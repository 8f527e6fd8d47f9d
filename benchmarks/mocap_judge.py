"""Train the judge of motion, and say how well it recognises people it has not seen.

    python benchmarks/mocap_judge.py --root FOLDER

FOLDER holds recordings as ``prepare mocap`` leaves them. Writes the judge (a minute on one thread) and a table of numbers; with
``--folds``, also of judges that are trained without the people they are tested on (ten minutes for a seed, five for each further
one).
"""

import argparse
import json
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from torch import Tensor
from torch.nn import functional

from ftl_lightning.domains.mocap.actions import CLASSES, OTHER, REVERSIBLE, STANDING, STEPPING, TESTED, action, of_legs
from ftl_lightning.domains.mocap.features import LOWER, UPPER, bones, places, signals, sizes
from ftl_lightning.domains.mocap.judge import LEGS, NUMBERS, PARTS, PATH, WHOLE, Judge, Network, Recogniser
from ftl_lightning.domains.mocap.recordings import read_folder
from ftl_lightning.domains.mocap.skeleton import ANKLES, FPS, HORIZON, JOINTS, as_joints, mirrored
from ftl_lightning.tensor_file import file_hash, write_text

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


def augmented(windows: Windows, draw: torch.Generator) -> Tensor:
    """``(window, 32, 42)`` of other paces, sides, sizes of movement, bodies and postures, slightly blurred or noisy."""
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
    larger = uniform(*LARGER, count, 1, 1, 1) * (1 + 0.1 * normal(count, 1, len(JOINTS), 1))
    relative = middle + larger * (relative - middle)
    relative = relative * length / torch.linalg.vector_norm(relative, dim=-1, keepdim=True).clamp_min(1e-3)
    relative = relative * (1 + 0.08 * normal(count, 1, len(JOINTS), 1)).clamp(0.75, 1.25)
    # Each bone leans a little otherwise through the whole window: posture differs from person to person.
    relative = relative + 0.1 * length.mean(dim=1, keepdim=True) * normal(count, 1, len(JOINTS), 3)
    joints = _turned(places(relative), normal(count, 3) * torch.tensor([0.05, 0.05, 0.12]))
    drift = functional.interpolate(0.015 * normal(count, 3 * len(JOINTS), 6), size=HORIZON, mode="linear", align_corners=True)
    states = joints.flatten(2) + drift.transpose(1, 2) + uniform(0, 0.005, count, 1, 1) * normal(*states.shape)
    padded = functional.pad(states.transpose(1, 2), (1, 1), mode="replicate")
    return torch.where(chance(0.4)[:, None, None], functional.avg_pool1d(padded, 3, stride=1).transpose(1, 2), states)


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
        _fit_linear(recogniser.linear[name], recogniser.numbers(name, states), label, strength)
    recogniser.train()
    networks = [network for network in recogniser.networks if isinstance(network, Network)]
    for member, network in enumerate(networks):
        torch.manual_seed(1000 * seed + member)
        for layer in network.modules():
            if isinstance(layer, torch.nn.Conv1d | torch.nn.Linear | torch.nn.GroupNorm):
                layer.reset_parameters()
        optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.05)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
        for _ in range(steps):
            rows = torch.randint(len(states), (BATCH,))
            seen = (torch.rand(BATCH, courses.shape[1], 1) > HIDDEN) / (1 - HIDDEN)
            loss = functional.cross_entropy(network(courses[rows] * seen), label[rows], label_smoothing=0.1)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    recogniser.eval()
    with torch.no_grad():
        recogniser.set_scale("embedding", torch.cat([networks[0].embedding(some) for some in courses.split(1000)]), 1e-3)


def train(windows: Windows, seed: int, parts: Sequence[str] = tuple(PARTS), steps: int = STEPS) -> Judge:
    """A judge that has seen these windows."""
    states, label = pool(windows, seed)
    judge = Judge()
    for name in parts:
        fit(judge.part(name), states, labels_of(name, label), seed, steps)
    return judge


def _tested(part: str) -> list[str]:
    """Classes of a part that two subjects or more show."""
    return list(dict.fromkeys(of_legs(name) if part == LEGS else name for name in TESTED))


def _recalls(part: str, scores: Tensor, label: Tensor) -> dict[str, float]:
    names, said = PARTS[part][1], scores.argmax(dim=-1)
    return {name: float((said[label == names.index(name)] == names.index(name)).float().mean()) for name in _tested(part)}


def _closed(part: str, scores: Tensor) -> Tensor:
    """Scores as if the tested classes were all there are."""
    names = PARTS[part][1]
    allowed = torch.tensor([name in _tested(part) for name in names])
    return scores.masked_fill(~allowed, -torch.inf)


def across_people(root: Path, seed: int, parts: Sequence[str]) -> dict[str, Any]:
    """How judges recognise people they have not seen: every subject is judged by one that was trained without."""
    learned, asked = read(root, 2), read(root, 6)
    scores: dict[str, list[Tensor]] = {}
    tests = [asked.of(fold) for fold in FOLDS]
    for fold, test in zip(FOLDS, tests, strict=True):
        judge = train(learned.of(fold, others=True), seed, parts)
        with torch.no_grad():
            for part in parts:
                recogniser, states = judge.part(part), test.states()
                for name, vote in {**recogniser.votes(states), "together": recogniser(states)}.items():
                    scores.setdefault(f"{part} {name}", []).append(vote)
    found: dict[str, Any] = {"seed": seed, "windows": sum(map(len, tests))}
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
    settings = {"seed": chosen.seed, "without subjects": UNSEEN, "windows": POOL, "steps": STEPS, "tested classes": TESTED}
    judge.save(chosen.out, settings)
    judge = Judge.load(chosen.out)
    table = json.loads(chosen.table.read_text()) if chosen.table.is_file() else {}
    table |= {"judge": file_hash(chosen.out), "training": settings, "references": references(judge, chosen.root)}
    print(f"{chosen.out}: {chosen.out.stat().st_size / 1000:.0f} kB, {time.time() - began:.0f} s")
    if chosen.folds:
        runs = [
            across_people(chosen.root, chosen.seed + number, (WHOLE,) if number else tuple(PARTS)) for number in range(chosen.folds)
        ]
        table["across people"] = runs
        for key in runs[0]:
            if isinstance(runs[0][key], dict):
                values = [run[key]["balanced accuracy"] for run in runs if key in run]
                alone = [run[key]["of the tested classes alone"] for run in runs if key in run]
                print(f"{key:18} {np.mean(values):.3f} ({np.std(values):.3f}), tested classes alone {np.mean(alone):.3f}")
    for name, value in table["references"].items():
        print(f"{name:68} {value:.2f}")
    write_text(chosen.table, json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
