"""Drawn pen strokes: an example data set, and the data of the shipped model ``pretrained/strokes`` and of a benchmark suite.

:func:`strokes` draws 11 kinds precisely. No setting of the package was tuned on them: eight kinds are for pretraining, three are
new. :func:`drawn` draws 46 kinds as by hand: corners are rounded, lines bend, and closed strokes do not quite close. Their
variation in place, size and slant is adjustable, since strokes of a single person vary less than strokes of many people.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.recorder import reached
from ftl_lightning.services.randomness import task_key

STEPS = 40  #: Number of points of a stroke.
TEMPLATES, TEMPLATE_SEED = 100, 5_000_000  #: Number of templates per kind of :class:`Judge`, and their reserved seed.
RANDOM = "scribble"  #: Kind without a common form: smooth curves and polylines through random corners.
MIRRORED, BACKWARDS = "mirrored ", "backwards "  #: Prefixes of kinds that are mirrored left to right, or drawn from end to start.

Points = NDArray[np.float64]  #: ``(..., 2)``.
Shape = Callable[[Points], Points]
"""Path within about 1 of the origin: points ``(..., 2)`` at shares ``(...,)`` of the stroke, from 0 to 1."""


def corners(*points: tuple[float, float]) -> Shape:
    """Polyline through points at an even pace."""
    corner = np.array(points)
    along = reached(corner)
    return lambda s: np.stack([np.interp(s * along[-1], along, corner[:, axis]) for axis in (0, 1)], axis=-1)


def polar(radius: Points, angle: Points) -> Points:
    """Points from radius and angle in radians, ``(...,)`` each."""
    return np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=-1)


def _heart(s: Points) -> Points:
    angle = 2 * np.pi * s
    x = 16 * np.sin(angle) ** 3
    y = 13 * np.cos(angle) - 5 * np.cos(2 * angle) - 2 * np.cos(3 * angle) - np.cos(4 * angle)
    return np.stack((x, y), axis=-1) / 16


def _s_curve(s: Points) -> Points:
    """Two half circles, from the upper right to the lower left."""
    angle = np.pi * np.where(s < 0.5, 2 * s, 2 - 2 * s)
    x, y = -np.sin(angle), 0.5 * (1 + np.cos(angle))
    return np.stack((np.where(s < 0.5, x, -x), np.where(s < 0.5, y, -y)), axis=-1) * (0.7, 1.0)


def _x_y(x: Points, y: Points) -> Points:
    return np.stack((x, y), axis=-1)


def _turning(start: float, end: float, width: float = 1.0, height: float = 1.0) -> Shape:
    """Arc of an ellipse between two angles in half turns."""
    return lambda s: polar(np.ones_like(s), np.pi * (start + (end - start) * s)) * (width, height)


def _joined(*parts: tuple[float, Shape]) -> Shape:
    """Concatenate parts, each with its share of the stroke; each part begins at the end of the previous part."""
    shares = np.array([share for share, _ in parts])
    ends = np.cumsum(shares) / shares.sum()

    def shape(s: Points) -> Points:
        points, begin, place = np.zeros((*s.shape, 2)), 0.0, np.zeros(2)
        for number, (end, (_, part)) in enumerate(zip(ends, parts, strict=True)):
            first, last = part(np.zeros(1))[0], part(np.ones(1))[0]
            within = part(np.clip((s - begin) / (end - begin), 0, 1)) - first + place
            points = np.where(((s >= begin) | (number == 0))[..., None], within, points)
            begin, place = end, place + last - first
        return points

    return shape


def _loops(count: int, wide: float) -> Shape:
    """Loops of a telephone cord, from left to right."""
    return lambda s: _x_y(wide * (2 * s - 1) - 0.45 * np.sin(2 * np.pi * count * s), 0.6 * -np.cos(2 * np.pi * count * s))


def _fish(s: Points) -> Points:
    angle = np.pi * (0.75 + 1.5 * (1 - s)) + np.pi / 2
    return _x_y(-np.cos(angle) * 1.1, 0.75 * np.sin(2 * angle))


SHAPES: dict[str, Shape] = {
    "line": corners((-1, -0.4), (1, 0.4)),
    "arc": lambda s: polar(np.ones_like(s), np.pi * (1 - s)),
    "circle": lambda s: polar(np.ones_like(s), 2 * np.pi * s),
    "zigzag": corners((-1, -0.5), (-0.5, 0.5), (0, -0.5), (0.5, 0.5), (1, -0.5)),
    "spiral": lambda s: polar(0.1 + 0.9 * s, 4 * np.pi * s),
    "wave": lambda s: np.stack((2 * s - 1, 0.5 * np.sin(4 * np.pi * s)), axis=-1),
    "triangle": corners((-0.9, -0.6), (0.9, -0.6), (0, 0.9), (-0.9, -0.6)),
    "figure eight": lambda s: np.stack((0.6 * np.sin(4 * np.pi * s), np.cos(2 * np.pi * s)), axis=-1),
    "square": corners((-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8), (-0.8, -0.8)),
    "heart": _heart,
    "S-curve": _s_curve,
}
"""Paths of :func:`strokes`."""
_OPEN: dict[str, Shape] = {
    "hook": _joined((1.5, corners((0, 1), (0, -0.4))), (1.3, _turning(0, -1, 0.45, 0.45))),
    "letter C": _turning(0.3, 1.7, 0.8, 1.0),
    "letter L": corners((-0.6, 1), (-0.6, -0.9), (0.6, -0.9)),
    "letter U": _joined((1.2, corners((0, 1.2), (0, 0))), (2.0, _turning(1, 2, 0.65, 0.65)), (1.2, corners((0, 0), (0, 1.2)))),
    "letter V": corners((-0.7, 0.9), (0, -0.9), (0.7, 0.9)),
    "letter N": corners((-0.6, -0.9), (-0.6, 0.9), (0.6, -0.9), (0.6, 0.9)),
    "letter Z": corners((-0.7, 0.9), (0.7, 0.9), (-0.7, -0.9), (0.7, -0.9)),
    "letter P": _joined((1.8, corners((0, -1), (0, 0.9))), (1.7, _turning(0.5, -0.5, 0.8, 0.5))),
    "loop": _joined(
        (1, corners((-1, -0.6), (0.1, -0.5))), (2.6, _turning(-0.5, 1.5, 0.45, 0.7)), (1, corners((0, 0), (1.1, -0.1)))
    ),
    "coil": _loops(3, 1.0),
    "stairs": corners((-1, -0.9), (-1, -0.3), (-0.33, -0.3), (-0.33, 0.3), (0.33, 0.3), (0.33, 0.9), (1, 0.9)),
    "pulse": corners((-1, -0.5), (-0.4, -0.5), (-0.4, 0.6), (0.4, 0.6), (0.4, -0.5), (1, -0.5)),
    "bump": lambda s: _x_y(2 * s - 1, 1.4 * np.exp(-(((2 * s - 1) / 0.3) ** 2)) - 0.5),
    "number 2": _joined(
        (2.2, _turning(0.9, -0.2, 0.6, 0.5)), (1.6, corners((0.5, 0.2), (-0.6, -0.9))), (1.3, corners((0, 0), (1.2, 0)))
    ),
    "number 6": _joined((2.0, _turning(0.4, 1.0, 0.9, 1.4)), (3.0, _turning(1, 2.9, 0.55, 0.5))),
    "number 7": corners((-0.7, 0.9), (0.7, 0.9), (-0.2, -0.9)),
    "arrow": corners((-1, 0), (1, 0), (0.45, 0.5), (1, 0), (0.45, -0.5)),
    "fish": _fish,
}
_CLOSED: dict[str, Shape] = {
    "oval": lambda s: polar(np.ones_like(s), np.pi * (0.5 + 2 * s)) * (1.1, 0.55),
    "half moon": _joined((2.4, _turning(0.5, 1.5, 0.9, 1.0)), (1.8, _turning(-0.5, 0.5, -0.35, 1.0))),
    "half circle": _joined((2.0, corners((-1, -0.4), (1, -0.4))), (3.1, _turning(0, 1, 1.0, 1.0))),
    "leaf": _joined((1, _turning(0.75, 0.25, 1.4, 1.4)), (1, _turning(-0.25, -0.75, 1.4, 1.4))),
    "flower": lambda s: polar(0.7 + 0.35 * np.cos(8 * np.pi * s), np.pi * (0.5 + 2 * s)),
}
_VALIDATION: dict[str, Shape] = {
    "letter W": corners((-1, 0.7), (-0.5, -0.7), (0, 0.5), (0.5, -0.7), (1, 0.7)),
    "number 3": _joined((2.2, _turning(0.8, -0.5, 0.6, 0.5)), (2.6, _turning(0.5, -0.85, 0.65, 0.55))),
    "question mark": _joined(
        (2.6, _turning(1, -0.35, 0.55, 0.5)), (0.6, corners((0.3, 0.2), (0, -0.2))), (0.8, corners((0, 0), (0, -0.7)))
    ),
    "diamond": corners((0, 1), (0.75, 0), (0, -1), (-0.75, 0), (0, 1)),
    "drop": _joined(
        (1.3, corners((0, 1), (-0.6, -0.35))), (2.4, _turning(0.85, 2.15, 0.67, 0.67)), (1.3, corners((0.6, -0.35), (0, 1)))
    ),
    "hourglass": corners((-0.7, 0.9), (0.7, 0.9), (-0.7, -0.9), (0.7, -0.9), (-0.7, 0.9)),
}
_TEST: dict[str, Shape] = {
    "star": lambda s: corners(*[(np.sin(0.8 * np.pi * k), np.cos(0.8 * np.pi * k)) for k in range(6)])(s),
    "letter M": corners((-0.9, -0.9), (-0.7, 0.9), (0, -0.4), (0.7, 0.9), (0.9, -0.9)),
    "check mark": corners((-0.8, 0.0), (-0.3, -0.7), (0.9, 0.9)),
    "house": corners((-0.8, -0.9), (-0.8, 0.2), (0, 1.0), (0.8, 0.2), (0.8, -0.9), (-0.8, -0.9)),
    "pentagon": corners(*[(np.sin(0.4 * np.pi * k), np.cos(0.4 * np.pi * k)) for k in range(6)]),
    "infinity": lambda s: _x_y(1.1 * np.sin(2 * np.pi * s), 0.5 * np.sin(4 * np.pi * s)),
}
_CLOSED_KINDS = {"circle", "triangle", "figure eight", "square", "heart", *_CLOSED, "diamond", "drop", "hourglass"}
_CLOSED_KINDS |= {"star", "house", "pentagon", "infinity"}
"""Closed strokes, which may begin slightly early or late and end before or beyond their beginning."""
NEW = ("square", "heart", "S-curve")  #: New kinds of :func:`strokes`.
TRAINING = tuple(kind for kind in SHAPES if kind not in NEW)  #: Pretraining kinds of :func:`strokes`.
KNOWN = (*TRAINING, *_OPEN, *_CLOSED)  #: Pretraining kinds of :func:`drawn`.
VALIDATION = (*NEW, *_VALIDATION)  #: New kinds of :func:`drawn` for model selection.
TEST = tuple(_TEST)  #: New kinds of :func:`drawn` for the final evaluation, used once.
_SHAPES = SHAPES | _OPEN | _CLOSED | _VALIDATION | _TEST


def strokes(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Strokes of a kind with different size, proportions, place, slant and pace, and a slight tremble.

    Args:
        kind: from :data:`TRAINING` or :data:`NEW`.
        count, seed: number of strokes, and random seed; strokes are equal on every machine up to rounding.

    Returns:
        ``(count, 40, 2)``, x and y, in centimetres, mostly within 4 of the origin.
    """
    rng = np.random.default_rng([seed, task_key(kind)])
    even = np.linspace(0, 1, STEPS)
    uneven = rng.uniform(-0.5, 0.5, (count, 1)) * np.sin(np.pi * even) * np.cos(np.pi * even) / np.pi
    points = SHAPES[kind](even + uneven)
    size = rng.uniform(1.0, 2.0, (count, 1, 1)) * rng.uniform(0.85, 1.15, (count, 1, 2))
    turn = rng.uniform(-0.25, 0.25, count)
    rotation = np.stack((np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)), axis=-1).reshape(count, 2, 2)
    place = rng.uniform(-1.5, 1.5, (count, 1, 2))
    tremble = rng.normal(0, 0.02, points.shape)
    placed = (points * size) @ rotation.transpose(0, 2, 1) + place + tremble
    return placed.astype(np.float32)


def _scribbles(even: Points, rng: np.random.Generator) -> Points:
    """Strokes ``(count, time, 2)`` without a common form, of about the size of the kinds."""
    paths = []
    for share in even:
        if rng.random() < 0.5:
            waves = np.arange(1, 6)
            factors = rng.normal(0, 1, (2, 5)) / waves**1.3
            path = np.stack([np.cos(np.pi * np.outer(share, waves)) @ factor for factor in factors], axis=-1)
        else:
            path = corners(*[tuple(point) for point in rng.uniform(-1, 1, (rng.integers(3, 8), 2))])(share)
        path = path - path.mean(axis=0)
        paths.append(path / np.maximum(np.abs(path).max(), 1e-6))
    return np.stack(paths)


def drawn(kind: str, count: int, seed: int, alike: float = 0.0) -> NDArray[np.float32]:
    """Strokes of a kind as drawn by hand: ``(count, 40, 2)``, in the units of :func:`strokes`.

    Args:
        kind: from :data:`KNOWN`, :data:`VALIDATION` or :data:`TEST`, optionally prefixed by :data:`MIRRORED` or
            :data:`BACKWARDS`; or :data:`RANDOM`.
        alike: similarity of the strokes, from 0 (many people, all over the canvas) to 1 (the same person and place; strokes differ
            in bending and tremble).
    """
    rng = np.random.default_rng([seed, task_key(kind)])
    plain = kind.removeprefix(MIRRORED).removeprefix(BACKWARDS)
    free = 1 - alike
    person = rng.uniform(-1, 1, 6) * alike  # common to all strokes of a person

    def varied(width: float, part: int) -> Points:
        return width * (person[part] + free * rng.uniform(-1, 1, count))

    even = np.linspace(0, 1, STEPS)
    pace = rng.uniform(-0.4, 0.4, (count, 1)) * np.sin(np.pi * even) * np.cos(np.pi * even) / np.pi
    progress = even + pace
    if kind.startswith(BACKWARDS):
        progress = 1 - progress
    if plain in _CLOSED_KINDS:
        begin, beyond = rng.uniform(-0.02, 0.02, (count, 1)), rng.uniform(-0.04, 0.03, (count, 1))
        progress = (begin + progress * (1 + beyond)) % 1
    points = _scribbles(progress, rng) if kind == RANDOM else _SHAPES[plain](progress)
    if kind.startswith(MIRRORED):
        points = points * (-1, 1)
    rounded = points.copy()
    rounded[:, 1:-1] = (points[:, :-2] + points[:, 1:-1] + points[:, 2:]) / 3
    points = points + rng.uniform(0, 1, (count, 1, 1)) * (rounded - points)
    waves = np.arange(1, 5)
    bend = rng.normal(0, 0.05, (count, 2, 4)) / np.sqrt(waves)
    points = points + np.einsum("caw,tw->cta", bend, np.cos(np.pi * np.outer(even, waves)))
    size = 1.5 * np.exp(varied(0.35, 0))
    wide = np.exp(varied(0.15, 1))
    turn, lean = varied(0.2, 2), varied(0.15, 3)
    points = points * np.stack((size * wide, size / wide), axis=-1)[:, None]
    points[..., 0] += lean[:, None] * points[..., 1]
    rotation = np.stack((np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)), axis=-1).reshape(count, 2, 2)
    place = np.stack((varied(1.4, 4), varied(1.4, 5)), axis=-1)[:, None]
    tremble = rng.normal(0, 0.01, points.shape)
    placed = points @ rotation.transpose(0, 2, 1) + place + tremble
    return placed.astype(np.float32)


def _normalised(points: NDArray[np.float32]) -> Points:
    """Normalise strokes ``(stroke, 40, 2)`` to mean 0 and root mean square 1, and flatten them."""
    centred = points.astype(np.float64) - points.mean(axis=1, keepdims=True)
    size = np.sqrt((centred**2).mean(axis=(1, 2), keepdims=True))
    flat: Points = (centred / np.maximum(size, 1e-9)).reshape(len(points), -1)
    return flat


@dataclass(frozen=True)
class Judge:
    """Classifier of strokes by the nearest of normalised templates ``(kind * template, 80)``, invariant to place and size."""

    kinds: tuple[str, ...]
    templates: Points

    @classmethod
    def of(cls, kinds: tuple[str, ...] = (*KNOWN, *VALIDATION, *TEST), count: int = TEMPLATES) -> "Judge":
        """Create a classifier of ``kinds`` with ``count`` templates each."""
        return cls(kinds, np.concatenate([_normalised(drawn(kind, count, TEMPLATE_SEED)) for kind in kinds]))

    def _distances(self, strokes: NDArray[np.float32]) -> Points:
        """Squared distance of each stroke to the nearest template of each kind ``(stroke, kind)``."""
        form = _normalised(strokes)
        squared = np.square(form).sum(axis=1)[:, None] + np.square(self.templates).sum(axis=1) - 2 * form @ self.templates.T
        nearest: Points = squared.reshape(len(strokes), len(self.kinds), -1).min(axis=2)
        return nearest

    def kind(self, strokes: NDArray[np.float32]) -> list[str]:
        """The kind of each stroke ``(stroke, 40, 2)``."""
        return [self.kinds[index] for index in self._distances(strokes).argmin(axis=1).tolist()]

    def distance(self, strokes: NDArray[np.float32], kind: str) -> float:
        """Median distance of strokes ``(stroke, 40, 2)`` to the nearest template of a kind, at a root mean square size of 1."""
        squared = self._distances(strokes)[:, self.kinds.index(kind)]
        return float(np.sqrt(np.maximum(np.median(squared), 0) / (2 * STEPS)))

    def rate(self, strokes: NDArray[np.float32], kind: str) -> float:
        """Fraction of strokes ``(stroke, 40, 2)`` classified as a kind."""
        return float(np.mean([predicted == kind for predicted in self.kind(strokes)]))


@cache
def _precise() -> Judge:
    kinds = tuple(SHAPES)
    return Judge(kinds, np.concatenate([_normalised(strokes(kind, 60, 4_000_000)) for kind in kinds]))


def recognised(stroke: NDArray[np.float32]) -> list[str]:
    """Classify strokes ``(stroke, 40, 2)`` as kinds of :func:`strokes` by the nearest template."""
    return _precise().kind(stroke)
