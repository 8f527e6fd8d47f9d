"""Many kinds of hand-drawn strokes: pretraining and evaluation data of the shipped model ``pretrained/strokes``.

They include the kinds of :mod:`ftl_lightning.apps.testing.strokes`, drawn less precisely: rounded corners, bent lines, and closed
strokes do not quite close. Variation in place, size and slant is adjustable: one person's strokes vary less than many people's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.apps.testing.strokes import NEW, SHAPES, STEPS, TRAINING, Points, corners, polar
from ftl_lightning.services.randomness import task_key

TEMPLATES = 100
"""Default number of templates per kind of :class:`Judge`."""
TEMPLATE_SEED = 5_000_000
"""Seed of the templates, far from the seeds of other strokes."""
RANDOM = "scribble"
"""Name of strokes without a common form: smooth curves and polylines through random corners."""


def _x_y(x: Points, y: Points) -> Points:
    return np.stack((x, y), axis=-1)


def _turning(start: float, end: float, width: float = 1.0, height: float = 1.0) -> Callable[[Points], Points]:
    """Arc of an ellipse between two angles in half turns."""
    return lambda s: polar(np.ones_like(s), np.pi * (start + (end - start) * s)) * (width, height)


def _joined(*parts: tuple[float, Callable[[Points], Points]]) -> Callable[[Points], Points]:
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


def _loops(count: int, wide: float) -> Callable[[Points], Points]:
    """Loops of a telephone cord, from left to right."""
    return lambda s: _x_y(wide * (2 * s - 1) - 0.45 * np.sin(2 * np.pi * count * s), 0.6 * -np.cos(2 * np.pi * count * s))


def _fish(s: Points) -> Points:
    angle = np.pi * (0.75 + 1.5 * (1 - s)) + np.pi / 2
    return _x_y(-np.cos(angle) * 1.1, 0.75 * np.sin(2 * angle))


_OPEN: dict[str, Callable[[Points], Points]] = {
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
_CLOSED: dict[str, Callable[[Points], Points]] = {
    "oval": lambda s: polar(np.ones_like(s), np.pi * (0.5 + 2 * s)) * (1.1, 0.55),
    "half moon": _joined((2.4, _turning(0.5, 1.5, 0.9, 1.0)), (1.8, _turning(-0.5, 0.5, -0.35, 1.0))),
    "half circle": _joined((2.0, corners((-1, -0.4), (1, -0.4))), (3.1, _turning(0, 1, 1.0, 1.0))),
    "leaf": _joined((1, _turning(0.75, 0.25, 1.4, 1.4)), (1, _turning(-0.25, -0.75, 1.4, 1.4))),
    "flower": lambda s: polar(0.7 + 0.35 * np.cos(8 * np.pi * s), np.pi * (0.5 + 2 * s)),
}
_VALIDATION: dict[str, Callable[[Points], Points]] = {
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
_TEST: dict[str, Callable[[Points], Points]] = {
    "star": lambda s: corners(*[(np.sin(0.8 * np.pi * k), np.cos(0.8 * np.pi * k)) for k in range(6)])(s),
    "letter M": corners((-0.9, -0.9), (-0.7, 0.9), (0, -0.4), (0.7, 0.9), (0.9, -0.9)),
    "check mark": corners((-0.8, 0.0), (-0.3, -0.7), (0.9, 0.9)),
    "house": corners((-0.8, -0.9), (-0.8, 0.2), (0, 1.0), (0.8, 0.2), (0.8, -0.9), (-0.8, -0.9)),
    "pentagon": corners(*[(np.sin(0.4 * np.pi * k), np.cos(0.4 * np.pi * k)) for k in range(6)]),
    "infinity": lambda s: _x_y(1.1 * np.sin(2 * np.pi * s), 0.5 * np.sin(4 * np.pi * s)),
}
_GOES_ON = {"circle", "triangle", "figure eight", "square", "heart", *_CLOSED, "diamond", "drop", "hourglass", "star", "house"}
_GOES_ON |= {"pentagon", "infinity"}
"""Closed strokes, which may begin slightly early or late and end before or beyond their beginning."""
KNOWN = (*TRAINING, *_OPEN, *_CLOSED)
"""Kinds for pretraining."""
MIRRORED, BACKWARDS = "mirrored ", "backwards "
"""Prefixes of kinds that are mirrored left to right, or drawn from end to start."""
VALIDATION = (*NEW, *_VALIDATION)
"""New kinds for model selection: those of :data:`ftl_lightning.apps.testing.strokes.NEW`, and six more."""
TEST = tuple(_TEST)
"""New kinds for the final evaluation, used once."""
_EVERY = SHAPES | _OPEN | _CLOSED | _VALIDATION | _TEST


def _random(even: Points, rng: np.random.Generator) -> Points:
    """Strokes ``(count, time, 2)`` without a common form, of about the size of the kinds."""
    strokes = []
    for share in even:
        if rng.random() < 0.5:
            waves = np.arange(1, 6)
            factors = rng.normal(0, 1, (2, 5)) / waves**1.3
            path = np.stack([np.cos(np.pi * np.outer(share, waves)) @ factor for factor in factors], axis=-1)
        else:
            path = corners(*[tuple(point) for point in rng.uniform(-1, 1, (rng.integers(3, 8), 2))])(share)
        path = path - path.mean(axis=0)
        strokes.append(path / np.maximum(np.abs(path).max(), 1e-6))
    return np.stack(strokes)


def drawn(kind: str, count: int, seed: int, alike: float = 0.0) -> NDArray[np.float32]:
    """Hand-drawn strokes of one kind.

    Args:
        kind: one of :data:`KNOWN`, :data:`VALIDATION` or :data:`TEST`, also after :data:`MIRRORED` or :data:`BACKWARDS`; or
            :data:`RANDOM`.
        count: number of strokes.
        seed: random seed; strokes are equal on every machine up to rounding.
        alike: 0 for strokes of many people, all over the canvas; up to 1 for one person's strokes at the same place, which differ
            in bending and trembling.

    Returns:
        ``(count, 40, 2)``, x and y, in centimetres, mostly within 4 of the origin.
    """
    rng = np.random.default_rng([seed, task_key(kind)])
    plain = kind.removeprefix(MIRRORED).removeprefix(BACKWARDS)
    free = 1 - alike
    person = rng.uniform(-1, 1, 6) * alike  # common to all strokes of one person

    def differs(width: float, part: int) -> Points:
        return width * (person[part] + free * rng.uniform(-1, 1, count))

    even = np.linspace(0, 1, STEPS)
    pace = rng.uniform(-0.4, 0.4, (count, 1)) * np.sin(np.pi * even) * np.cos(np.pi * even) / np.pi
    done = even + pace
    if kind.startswith(BACKWARDS):
        done = 1 - done
    if plain in _GOES_ON:
        begin, beyond = rng.uniform(-0.02, 0.02, (count, 1)), rng.uniform(-0.04, 0.03, (count, 1))
        done = (begin + done * (1 + beyond)) % 1
    points = _random(done, rng) if kind == RANDOM else _EVERY[plain](done)
    if kind.startswith(MIRRORED):
        points = points * (-1, 1)
    rounded = points.copy()
    rounded[:, 1:-1] = (points[:, :-2] + points[:, 1:-1] + points[:, 2:]) / 3
    points = points + rng.uniform(0, 1, (count, 1, 1)) * (rounded - points)
    waves = np.arange(1, 5)
    bend = rng.normal(0, 0.05, (count, 2, 4)) / np.sqrt(waves)
    points = points + np.einsum("caw,tw->cta", bend, np.cos(np.pi * np.outer(even, waves)))
    size = 1.5 * np.exp(differs(0.35, 0))
    wide = np.exp(differs(0.15, 1))
    turn, lean = differs(0.2, 2), differs(0.15, 3)
    points = points * np.stack((size * wide, size / wide), axis=-1)[:, None]
    points[..., 0] += lean[:, None] * points[..., 1]
    rotation = np.stack((np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)), axis=-1).reshape(count, 2, 2)
    place = np.stack((differs(1.4, 4), differs(1.4, 5)), axis=-1)[:, None]
    tremble = rng.normal(0, 0.01, points.shape)
    strokes = points @ rotation.transpose(0, 2, 1) + place + tremble
    return strokes.astype(np.float32)


def _form(points: NDArray[np.float32]) -> Points:
    """Normalise strokes ``(stroke, 40, 2)`` to mean 0 and root mean square 1, and flatten them."""
    centred = points.astype(np.float64) - points.mean(axis=1, keepdims=True)
    size = np.sqrt((centred**2).mean(axis=(1, 2), keepdims=True))
    flat: Points = (centred / np.maximum(size, 1e-9)).reshape(len(points), -1)
    return flat


@dataclass(frozen=True)
class Judge:
    """Classifier of strokes by the nearest template, invariant to place and size.

    Attributes:
        kinds: known kinds.
        templates: normalised ``(kind * template, 80)``.
    """

    kinds: tuple[str, ...]
    templates: Points

    @classmethod
    def of(cls, kinds: tuple[str, ...] = (*KNOWN, *VALIDATION, *TEST), count: int = TEMPLATES) -> "Judge":
        """Create a classifier of some kinds with ``count`` templates each."""
        return cls(kinds, np.concatenate([_form(drawn(kind, count, TEMPLATE_SEED)) for kind in kinds]))

    def _apart(self, strokes: NDArray[np.float32]) -> Points:
        """Squared distance of each stroke to the nearest template of each kind ``(stroke, kind)``."""
        form = _form(strokes)
        apart = np.square(form).sum(axis=1)[:, None] + np.square(self.templates).sum(axis=1) - 2 * form @ self.templates.T
        nearest: Points = apart.reshape(len(strokes), len(self.kinds), -1).min(axis=2)
        return nearest

    def kind(self, strokes: NDArray[np.float32]) -> list[str]:
        """The kind of each stroke ``(stroke, 40, 2)``."""
        return [self.kinds[index] for index in self._apart(strokes).argmin(axis=1).tolist()]

    def distance(self, strokes: NDArray[np.float32], kind: str) -> float:
        """Median distance of strokes ``(stroke, 40, 2)`` to the nearest template of a kind, at a root mean square size of 1."""
        squared = self._apart(strokes)[:, self.kinds.index(kind)]
        return float(np.sqrt(np.maximum(np.median(squared), 0) / (2 * STEPS)))

    def rate(self, strokes: NDArray[np.float32], kind: str) -> float:
        """Fraction of strokes ``(stroke, 40, 2)`` classified as a kind."""
        return float(np.mean([predicted == kind for predicted in self.kind(strokes)]))
