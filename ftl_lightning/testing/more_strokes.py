"""Many kinds of strokes as a hand draws them: what the model that ships, ``pretrained/strokes``, was pretrained and judged on.

Kinds of :mod:`ftl_lightning.testing.strokes` are among them. The hand differs: corners are rounded, lines bend, closed strokes do
not quite close. How much strokes of a kind differ in place, size and slant can be chosen, as one person draws more alike than many.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.seeding import task_key
from ftl_lightning.testing.strokes import NEW, SHAPES, STEPS, TRAINING, Points, corners, polar

TEMPLATES = 100
"""Strokes of each kind that :class:`Judge` compares with, by default."""
TEMPLATE_SEED = 5_000_000
"""Far from the seeds that anybody draws strokes from."""
RANDOM = "scribble"
"""Name of strokes that have no common form: smooth curves and ways through random corners."""


def _x_y(x: Points, y: Points) -> Points:
    return np.stack((x, y), axis=-1)


def _turning(start: float, end: float, width: float = 1.0, height: float = 1.0) -> Callable[[Points], Points]:
    """A part of an ellipse, between two angles in half turns."""
    return lambda s: polar(np.ones_like(s), np.pi * (start + (end - start) * s)) * (width, height)


def _joined(*parts: tuple[float, Callable[[Points], Points]]) -> Callable[[Points], Points]:
    """One part after the other, each with the share of the stroke that it takes; each begins where the last ends."""
    shares = np.array([share for share, _ in parts])
    ends = np.cumsum(shares) / shares.sum()

    def shape(s: Points) -> Points:
        found, begin, place = np.zeros((*s.shape, 2)), 0.0, np.zeros(2)
        for number, (end, (_, part)) in enumerate(zip(ends, parts, strict=True)):
            first, last = part(np.zeros(1))[0], part(np.ones(1))[0]
            within = part(np.clip((s - begin) / (end - begin), 0, 1)) - first + place
            found = np.where(((s >= begin) | (number == 0))[..., None], within, found)
            begin, place = end, place + last - first
        return found

    return shape


def _loops(count: int, wide: float) -> Callable[[Points], Points]:
    """Loops of a telephone cord, from the left to the right."""
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
"""Closed strokes, which may begin a little early or late and end before or beyond where they began."""
KNOWN = (*TRAINING, *_OPEN, *_CLOSED)
"""Kinds of pretraining."""
MIRRORED, BACKWARDS = "mirrored ", "backwards "
"""Before the name of a kind, which is drawn from the right to the left then, or from the end to the start."""
VALIDATION = (*NEW, *_VALIDATION)
"""New kinds that the model was chosen by: those of :data:`ftl_lightning.testing.strokes.NEW`, and six more."""
TEST = tuple(_TEST)
"""New kinds that were looked at once, when everything was fixed."""
_EVERY = SHAPES | _OPEN | _CLOSED | _VALIDATION | _TEST


def _random(even: Points, rng: np.random.Generator) -> Points:
    """Strokes of no common form ``(count, time, 2)``, of about the size of the kinds."""
    found = []
    for share in even:
        if rng.random() < 0.5:
            waves = np.arange(1, 6)
            factors = rng.normal(0, 1, (2, 5)) / waves**1.3
            path = np.stack([np.cos(np.pi * np.outer(share, waves)) @ factor for factor in factors], axis=-1)
        else:
            path = corners(*[tuple(point) for point in rng.uniform(-1, 1, (rng.integers(3, 8), 2))])(share)
        path = path - path.mean(axis=0)
        found.append(path / np.maximum(np.abs(path).max(), 1e-6))
    return np.stack(found)


def drawn(kind: str, count: int, seed: int, alike: float = 0.0) -> NDArray[np.float32]:
    """Strokes of one kind as a hand draws them.

    Args:
        kind: one of :data:`KNOWN`, :data:`VALIDATION` or :data:`TEST`, also :data:`MIRRORED` or :data:`BACKWARDS`; or
            :data:`RANDOM`.
        count: how many.
        seed: decides them; the same on every machine up to rounding.
        alike: 0 for strokes of many people, all over the canvas; up to 1 for those of one who draws the same at the same place,
            where what differs is the hand's bending and trembling.

    Returns:
        ``(count, 40, 2)``, x and y, in centimetres, mostly within 4 of the origin.
    """
    rng = np.random.default_rng([seed, task_key(kind)])
    plain = kind.removeprefix(MIRRORED).removeprefix(BACKWARDS)
    free = 1 - alike
    person = rng.uniform(-1, 1, 6) * alike  # what all strokes of one who draws alike have in common

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
    found = points @ rotation.transpose(0, 2, 1) + place + tremble
    return found.astype(np.float32)


def _form(points: NDArray[np.float32]) -> Points:
    """Strokes ``(stroke, 40, 2)`` without their place and size, flattened: mean 0, root mean square 1."""
    centred = points.astype(np.float64) - points.mean(axis=1, keepdims=True)
    size = np.sqrt((centred**2).mean(axis=(1, 2), keepdims=True))
    flat: Points = (centred / np.maximum(size, 1e-9)).reshape(len(points), -1)
    return flat


@dataclass(frozen=True)
class Judge:
    """Tells of which kind strokes are: that of the nearest template, whatever their place and size.

    Attributes:
        kinds: that it knows.
        templates: ``(kind * template, 80)``, without place and size.
    """

    kinds: tuple[str, ...]
    templates: Points

    @classmethod
    def of(cls, kinds: tuple[str, ...] = (*KNOWN, *VALIDATION, *TEST), count: int = TEMPLATES) -> "Judge":
        """One that knows some kinds by so many templates each."""
        return cls(kinds, np.concatenate([_form(drawn(kind, count, TEMPLATE_SEED)) for kind in kinds]))

    def _apart(self, strokes: NDArray[np.float32]) -> Points:
        """Squared distance of each stroke to its nearest template of each kind ``(stroke, kind)``."""
        form = _form(strokes)
        apart = np.square(form).sum(axis=1)[:, None] + np.square(self.templates).sum(axis=1) - 2 * form @ self.templates.T
        found: Points = apart.reshape(len(strokes), len(self.kinds), -1).min(axis=2)
        return found

    def kind(self, strokes: NDArray[np.float32]) -> list[str]:
        """The kind of each stroke ``(stroke, 40, 2)``."""
        return [self.kinds[index] for index in self._apart(strokes).argmin(axis=1).tolist()]

    def distance(self, strokes: NDArray[np.float32], kind: str) -> float:
        """Median distance of strokes ``(stroke, 40, 2)`` to the nearest template of a kind, where root mean square size is 1."""
        own = self._apart(strokes)[:, self.kinds.index(kind)]
        return float(np.sqrt(np.maximum(np.median(own), 0) / (2 * STEPS)))

    def rate(self, strokes: NDArray[np.float32], kind: str) -> float:
        """Share of strokes ``(stroke, 40, 2)`` that are of a kind."""
        return float(np.mean([found == kind for found in self.kind(strokes)]))
