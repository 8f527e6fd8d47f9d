"""Four families of behaviour that resemble user data: no simulator, no initial states, concepts that are words or numbers.

Each family is a domain. A number defines a kind of pictures, reaches or beats. A sample is correct if its nearest neighbour among
many samples of all kinds is of the goal's kind.
"""

import itertools
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.apps.benchmark import strokes
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Generated, Metric, Plans
from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.services.randomness import FRESH_SEED

TEMPLATES, TEMPLATE_SEED = 80, 7_000_000  # number of templates per kind, and their reserved seed
CHANCE, ORACLE = "random kind (chance)", "generator (oracle)"
Draw = Callable[[str, int, int], NDArray[np.float32]]  # ``(kind, count, seed) -> (count, time, column)``
Kind = Callable[[NDArray[np.float32]], Sequence[str]]  # ``(samples (sample, time, column)) -> kind of each sample``


def _rng(*words: object) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(str(word).encode()) for word in words])


def _number(kind: str) -> int:
    return int(kind.rpartition(" ")[2])


def pictures(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Pictures of polylines with three to five corners, drawn with a soft pen: ``(count, 1, 64)``. A state has 8 x 8 grey values
    from 0 to 16, row by row. The kind ``'picture NUMBER'`` determines the corners; the seed determines slant, size, place and width
    of each picture.
    """
    rng, shape = _rng("pictures", kind, seed), _rng("picture", _number(kind))
    corner = shape.uniform(0.12, 0.88, (int(shape.integers(3, 6)), 2))
    rows, cols = np.mgrid[0:32, 0:32] / 31
    pixels, drawn = np.stack((cols, rows), axis=-1).reshape(-1, 2), []
    for _ in range(count):
        points = corner + rng.normal(0, 0.04, corner.shape)
        angle, slant, middle = rng.uniform(-0.2, 0.2), rng.uniform(-0.25, 0.25), points.mean(axis=0)
        change = np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))) @ np.array(((1, slant), (0, 1)))
        points = (points - middle) @ (change * rng.uniform(0.85, 1.1)).T + middle + rng.normal(0, 0.03, 2)
        width, distance = rng.uniform(0.05, 0.1), np.full(len(pixels), 9.0)
        for start, end in itertools.pairwise(points):
            segment = end - start
            along = np.clip(((pixels - start) @ segment) / (segment @ segment + 1e-9), 0, 1)
            distance = np.minimum(distance, np.linalg.norm(pixels - start - along[:, None] * segment, axis=1))
        grey = np.clip(1.3 - 0.6 * distance / width, 0, 1).reshape(8, 4, 8, 4).mean(axis=(1, 3))
        drawn.append(np.round(16 * np.clip(1.2 * grey, 0, 1)).reshape(1, 64))
    return np.asarray(drawn, dtype=np.float32)


def reaches(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Hand trajectories through three waypoints, with a gripper that closes on the way: ``(count, 50, 4)``. Columns are x, y and z
    in metres, mostly within 0.6 of the origin, and the opening from 0 to 80 mm. The kind ``'reach NUMBER'`` determines waypoints
    and time of closing; the seed determines start and deviations of each trajectory.
    """
    shape, rng, s, drawn = _rng("a reach", _number(kind)), _rng("reaches", kind, seed), np.linspace(0, 1, 50), []
    goals, closing, height = shape.uniform(-0.4, 0.4, (3, 3)), shape.uniform(0.2, 0.8), shape.uniform(0.05, 0.3)
    for _ in range(count):
        start, places = rng.normal(0, 0.05, 3), goals + rng.normal(0, 0.03, goals.shape)
        knots = np.stack((start, *places))
        smooth = s * s * (3 - 2 * s)
        path = np.stack([np.interp(smooth, np.linspace(0, 1, 4), knots[:, axis]) for axis in range(3)], axis=-1)
        path = np.stack([np.convolve(np.pad(column, 4, mode="edge"), np.ones(9) / 9, mode="valid") for column in path.T], axis=-1)
        path[:, 2] += height * np.sin(np.pi * s)
        grip = 1 / (1 + np.exp(-(s - closing - rng.uniform(-0.05, 0.05)) * 40))
        drawn.append(np.column_stack((path + rng.normal(0, 0.001, path.shape), 80 * grip)))
    return np.asarray(drawn, dtype=np.float32)


def beats(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Heartbeats of four waves on a drifting baseline: ``(count, 120, 1)``, in millivolts, mostly within 3 of zero. The kind
    ``'beat NUMBER'`` determines the waves; the seed determines pace, size and drift of each beat.
    """
    shape, rng, s, drawn = _rng("a beat", _number(kind)), _rng("beats", kind, seed), np.linspace(0, 1, 120), []
    place, width, height = np.sort(shape.uniform(0.1, 0.9, 4)), shape.uniform(0.015, 0.08, 4), shape.normal(0, 1, 4)
    for _ in range(count):
        at, pace = place + rng.normal(0, 0.01, 4), rng.uniform(0.9, 1.1)
        waves = height * rng.uniform(0.8, 1.2) * np.exp(-(((s[:, None] * pace - at) / width) ** 2))
        wander = 0.1 * np.sin(2 * np.pi * (rng.uniform(0.3, 1) * s + rng.uniform()))
        drawn.append((waves.sum(axis=1) + wander + rng.normal(0, 0.01, len(s)))[:, None])
    return np.asarray(drawn, dtype=np.float32)


@dataclass(frozen=True)
class Nearest:
    """Classify samples by the nearest template of known kinds; columns are scaled by their spread."""

    draw: Draw
    kinds: tuple[str, ...]

    @cached_property
    def _templates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Templates ``(kind * template, time * column)`` in units of their spread, and the spread ``(column,)``."""
        templates = np.concatenate([self.draw(kind, TEMPLATES, TEMPLATE_SEED) for kind in self.kinds]).astype(np.float64)
        # Columns of single states share a scale, as some are constant.
        scale = templates.reshape(-1, templates.shape[2]).std(axis=0) if templates.shape[1] > 1 else np.ones(templates.shape[2])
        return (templates / scale).reshape(len(templates), -1), scale

    def __call__(self, samples: NDArray[np.float32]) -> Sequence[str]:
        """The kind of each sample ``(sample, time, column)``; empty for non-finite samples."""
        templates, scale = self._templates
        kinds = []
        for sample in (samples / scale).reshape(len(samples), -1):
            nearest = np.square(templates - sample).sum(axis=1).argmin() if np.isfinite(sample).all() else None
            kinds.append("" if nearest is None else self.kinds[int(nearest) // TEMPLATES])
        return kinds


_stroke_judge = cache(strokes.Judge.of)


def stroke_kinds(samples: NDArray[np.float32]) -> Sequence[str]:
    """The kind of each stroke ``(sample, 40, 2)``, invariant to position and size; empty for non-finite strokes."""
    finite = [bool(np.isfinite(stroke).all()) for stroke in samples]
    kinds = _stroke_judge().kind(np.nan_to_num(samples, nan=0, posinf=0, neginf=0))
    return [kind if good else "" for kind, good in zip(kinds, finite, strict=True)]


def family(name: str, plans: Plans, draw: Draw, kinds: tuple[Sequence[str], Sequence[str], Sequence[str]], judge: Kind) -> Domain:
    """Domain of a family, from kinds for training, validation and test; ``judge`` classifies samples by kind."""
    training, validation, test = (tuple(names) for names in kinds)
    all_kinds = (*training, *validation, *test)

    def right(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        return torch.tensor([kind == goal for kind in judge(states.numpy())], dtype=torch.bool)

    def tensor(kind: str, count: int, seed: int) -> Tensor:
        return torch.from_numpy(draw(kind, count, seed))

    def chance(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
        # Balanced over kinds, to reduce variance.
        return torch.cat([tensor(all_kinds[index % len(all_kinds)], 1, FRESH_SEED + seed + index) for index in range(count)])

    def oracle(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
        return tensor(goal, count, 2 * FRESH_SEED + seed)

    def new(kinds: Sequence[str]) -> Suite:
        return Suite(tuple(EvaluationTask("new concept", kind, (kind,)) for kind in kinds))

    source = Generated(name, plans, training, tensor)
    return Domain(
        name=name,
        plans=plans,
        concepts=Concepts(training, {"training": training_suite(training), "validation": new(validation), "paper": new(test)}),
        source=lambda root: source,
        metrics={ACCURACY: Metric(right)},
        comparison=Comparison(references={CHANCE: chance, ORACLE: oracle}),
    )


def _numbered(name: str, word: str, plans: Plans, draw: Draw) -> Domain:
    """Family of eight kinds for training, four for validation and four for the test."""
    training, validation, test = (
        [f"{word} {number}" for number in numbers] for numbers in (range(8), range(200, 204), range(100, 104))
    )
    return family(name, plans, draw, (training, validation, test), Nearest(draw, (*training, *validation, *test)))


STROKES = family(
    "benchmark_strokes",
    Plans(40, ("x", "y"), ("cm", "cm")),
    strokes.drawn,
    (strokes.KNOWN, strokes.VALIDATION, strokes.TEST),
    stroke_kinds,
)
PICTURES = _numbered(
    "benchmark_pictures",
    "picture",
    Plans(1, tuple(f"row {row} column {column}" for row in range(8) for column in range(8)), ("grey",) * 64),
    pictures,
)
REACHES = _numbered("benchmark_reaches", "reach", Plans(50, ("x", "y", "z", "opening"), ("m", "m", "m", "mm")), reaches)
BEATS = _numbered("benchmark_beats", "beat", Plans(120, ("potential",), ("mV",)), beats)
