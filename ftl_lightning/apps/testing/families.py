"""Kinds of behaviour defined by a number: pictures, reaches of a hand, and beats. They do not depend on any method."""

import itertools
import zlib

import numpy as np
from numpy.typing import NDArray


def _rng(*words: object) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(str(word).encode()) for word in words])


def _number(kind: str) -> int:
    return int(kind.rpartition(" ")[2])


def pictures(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Pictures of polylines with three to five corners, drawn with a soft pen.

    Args:
        kind: ``'picture NUMBER'``; the number determines the corners.
        count: number of pictures.
        seed: determines slant, size, place and width of each picture.

    Returns:
        ``(count, 1, 64)``: one state of 8 x 8 grey values from 0 to 16, row by row.
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
        width, far = rng.uniform(0.05, 0.1), np.full(len(pixels), 9.0)
        for start, end in itertools.pairwise(points):
            way = end - start
            along = np.clip(((pixels - start) @ way) / (way @ way + 1e-9), 0, 1)
            far = np.minimum(far, np.linalg.norm(pixels - start - along[:, None] * way, axis=1))
        grey = np.clip(1.3 - 0.6 * far / width, 0, 1).reshape(8, 4, 8, 4).mean(axis=(1, 3))
        drawn.append(np.round(16 * np.clip(1.2 * grey, 0, 1)).reshape(1, 64))
    return np.asarray(drawn, dtype=np.float32)


def reaches(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Reaches of a hand through three places, with a gripper that closes on the way.

    Args:
        kind: ``'reach NUMBER'``; the number determines the places, and when the gripper closes.
        count: number of reaches.
        seed: determines the start of each reach and its deviation from the places.

    Returns:
        ``(count, 50, 4)``: x, y and z in metres, mostly within 0.6 of the origin, and the opening from 0 to 80 mm.
    """
    shape, rng, s, drawn = _rng("a reach", _number(kind)), _rng("reaches", kind, seed), np.linspace(0, 1, 50), []
    goals, closing, height = shape.uniform(-0.4, 0.4, (3, 3)), shape.uniform(0.2, 0.8), shape.uniform(0.05, 0.3)
    for _ in range(count):
        start, places = rng.normal(0, 0.05, 3), goals + rng.normal(0, 0.03, goals.shape)
        knots = np.stack((start, *places))
        smooth = s * s * (3 - 2 * s)
        way = np.stack([np.interp(smooth, np.linspace(0, 1, 4), knots[:, axis]) for axis in range(3)], axis=-1)
        way = np.stack([np.convolve(np.pad(column, 4, mode="edge"), np.ones(9) / 9, mode="valid") for column in way.T], axis=-1)
        way[:, 2] += height * np.sin(np.pi * s)
        grip = 1 / (1 + np.exp(-(s - closing - rng.uniform(-0.05, 0.05)) * 40))
        drawn.append(np.column_stack((way + rng.normal(0, 0.001, way.shape), 80 * grip)))
    return np.asarray(drawn, dtype=np.float32)


def beats(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    """Beats of one column: four waves over a wandering line.

    Args:
        kind: ``'beat NUMBER'``; the number determines the waves' places, widths and heights.
        count: number of beats.
        seed: determines pace, size and wandering of each beat.

    Returns:
        ``(count, 120, 1)``, in millivolts, mostly within 3 of zero.
    """
    shape, rng, s, drawn = _rng("a beat", _number(kind)), _rng("beats", kind, seed), np.linspace(0, 1, 120), []
    place, width, height = np.sort(shape.uniform(0.1, 0.9, 4)), shape.uniform(0.015, 0.08, 4), shape.normal(0, 1, 4)
    for _ in range(count):
        at, pace = place + rng.normal(0, 0.01, 4), rng.uniform(0.9, 1.1)
        waves = height * rng.uniform(0.8, 1.2) * np.exp(-(((s[:, None] * pace - at) / width) ** 2))
        wander = 0.1 * np.sin(2 * np.pi * (rng.uniform(0.3, 1) * s + rng.uniform()))
        drawn.append((waves.sum(axis=1) + wander + rng.normal(0, 0.01, len(s)))[:, None])
    return np.asarray(drawn, dtype=np.float32)
