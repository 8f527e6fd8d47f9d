"""Pen strokes in the plane: a small data set on which nothing in this package was tuned, with a classifier of its kinds.

Eight kinds are for pretraining; three new kinds are learned from five strokes each.
"""

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.services.randomness import task_key

STEPS = 40
"""Number of points of a stroke."""
TEMPLATES = 60
"""Number of templates per kind of :func:`recognised`."""
TEMPLATE_SEED = 4_000_000
"""Seed of the templates, far from the seeds of other strokes."""

Points = NDArray[np.float64]
"""``(..., 2)``."""


def corners(*points: tuple[float, float]) -> Callable[[Points], Points]:
    """Polyline through points at an even pace: a function of the completed share ``(...,)``, from 0 to 1."""
    corner = np.array(points)
    reached = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1))))
    return lambda s: np.stack([np.interp(s * reached[-1], reached, corner[:, axis]) for axis in (0, 1)], axis=-1)


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


SHAPES: dict[str, Callable[[Points], Points]] = {
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
"""Path of each kind, within about 1 of the origin, as a function of the completed share."""
NEW = ("square", "heart", "S-curve")
"""Kinds to learn from a few strokes."""
TRAINING = tuple(kind for kind in SHAPES if kind not in NEW)
"""Kinds for pretraining."""


def strokes(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Strokes of one kind with different size, proportions, place, slant and pace, and a slight tremble.

    Args:
        kind: one of :data:`TRAINING` or :data:`NEW`.
        count: number of strokes.
        seed: random seed; strokes are equal on every machine up to rounding.

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


def _shape(points: NDArray[np.float32]) -> Points:
    """Normalise strokes ``(stroke, 40, 2)`` to mean 0 and root mean square 1, and flatten them."""
    centred = points.astype(np.float64) - points.mean(axis=1, keepdims=True)
    size = np.sqrt((centred**2).mean(axis=(1, 2), keepdims=True))
    flat: Points = (centred / np.maximum(size, 1e-9)).reshape(len(points), -1)
    return flat


@functools.cache
def _templates() -> Points:
    """``(kind * template, 80)``."""
    return np.concatenate([_shape(strokes(kind, TEMPLATES, TEMPLATE_SEED)) for kind in SHAPES])


def recognised(stroke: NDArray[np.float32]) -> list[str]:
    """Classify strokes ``(stroke, 40, 2)`` by the nearest template of all kinds, invariant to place and size."""
    apart = np.linalg.norm(_shape(stroke)[:, None] - _templates(), axis=-1)
    return [list(SHAPES)[index // TEMPLATES] for index in apart.argmin(axis=1).tolist()]
