"""Families of behaviour for the choice of the parametrisation: generators, with rules unknown to the method as judges.

Paths, pictures and series are users' data, pretrained with ``conf/own.yaml``. Relations are new relations for the shipped model of
object rearrangement. Reaches and beats are test families, evaluated once.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.apps.benchmark.families import beats, pictures, reaches
from ftl_lightning.domains.object_rearrangement.scenes import columns, overlap, random_scenes

TEMPLATES, TEMPLATE_SEED = 80, 990
"""Samples of each kind that a judge compares with."""
Points = NDArray[np.float64]


@dataclass(frozen=True)
class Family:
    """Kinds of behaviour.

    Attributes:
        training, new: names of kinds.
        draw: ``(kind, count, seed) -> (count, time, column)``.
        recognised: ``(samples, kind) -> (sample,)`` of bool, by a rule.
        pretrained: a shipped model; empty for one that is pretrained on the training kinds.
    """

    training: Sequence[str]
    new: Sequence[str]
    draw: Callable[[str, int, int], NDArray[np.float32]]
    recognised: Callable[[NDArray[np.float32], str], NDArray[np.bool_]]
    pretrained: str = ""


def _rng(*words: object) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(str(word).encode()) for word in words])


def _number(kind: str) -> int:
    return int(kind.rpartition(" ")[2])


# Paths in the plane: closed and open curves of three waves, lines through corners, spirals.


def _path(number: int) -> Callable[[Points], Points]:
    rng = _rng("path", number)
    if number % 4 == 2:
        corner = rng.uniform(-1, 1, (int(rng.integers(3, 6)), 2))
        reached = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1))))
        return lambda s: np.stack([np.interp(s * reached[-1], reached, corner[:, axis]) for axis in (0, 1)], axis=-1)
    if number % 4 == 3:
        turns, phase, growth, hand = rng.uniform(1, 3), rng.uniform(0, 6.28), rng.uniform(-0.9, 0.9), rng.choice((-1, 1))

        def spiral(s: Points) -> Points:
            angle = hand * 2 * np.pi * turns * s + phase
            return (0.55 + growth * (s - 0.5))[..., None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)

        return spiral
    size = rng.normal(size=(3, 2, 2)) / np.arange(1, 4)[:, None, None] ** 1.3
    drift = rng.normal(size=2) * 1.2 * (number % 4 == 1)
    turn = np.pi * (2 - number % 4)

    def curve(s: Points) -> Points:
        waves = [size[k, 0] * np.cos(turn * (k + 1) * s)[..., None] for k in range(3)]
        waves += [size[k, 1] * np.sin(turn * (k + 1) * s)[..., None] for k in range(3)]
        return s[..., None] * drift + np.sum(waves, axis=0)

    return curve


def _paths(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    rng, even = _rng("paths", kind, seed), np.linspace(0, 1, 40)
    pace = even + rng.uniform(-0.4, 0.4, (count, 1)) * np.sin(np.pi * even) * np.cos(np.pi * even) / np.pi
    points = _path(_number(kind))(pace)
    points = points - points.reshape(-1, 2).mean(axis=0)
    points = points / np.sqrt((points**2).mean()) * rng.uniform(0.8, 1.6, (count, 1, 1)) * rng.uniform(0.85, 1.15, (count, 1, 2))
    turn = rng.uniform(-0.25, 0.25, count)
    rotation = np.stack((np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)), axis=-1).reshape(count, 2, 2)
    moved = points @ rotation.transpose(0, 2, 1) + rng.uniform(-1.2, 1.2, (count, 1, 2))
    return np.asarray(moved + rng.normal(0, 0.015, points.shape), dtype=np.float32)


# Series of five columns in unlike units: rises, decaying swings, and a bump, a step, a ramp or a wave.

UNITS = np.array((1e-3, 1, 250, 4e3, 0.05))


def _series(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    shape, rng, s, drawn = _rng("a series", _number(kind)), _rng("series", kind, seed), np.linspace(0, 1, 60), []
    speed, decay, begin = shape.uniform(2, 14, 3), shape.uniform(0.5, 5, 3), shape.uniform(0.1, 0.6)
    third, sign, mixing = int(shape.integers(0, 4)), shape.choice((-1, 1), 3), shape.uniform(-1, 1, (5, 3))
    for _ in range(count):
        height, late, faster = rng.uniform(0.7, 1.3), begin + rng.uniform(-0.05, 0.05), rng.uniform(0.92, 1.08)
        rise = sign[0] * height * (1 - np.exp(-3 * decay[0] * np.clip(s - late, 0, None)))
        swing = sign[1] * height * np.exp(-decay[1] * s) * np.sin(2 * speed[1] * faster * s)
        bump = sign[2] * height * np.exp(-(((s - late) / 0.08) ** 2))
        others = (bump, height * (s > late), sign[2] * height * s, height * np.sin(speed[2] * faster * s))
        values = np.stack((rise, swing, others[third]), axis=-1) @ mixing.T
        drawn.append(values * UNITS + np.array((0.02, 20, 1e3, 1e4, 0)) + rng.normal(0, 0.01, values.shape) * UNITS)
    return np.asarray(drawn, dtype=np.float32)


def _nearest(
    draw: Callable[[str, int, int], NDArray[np.float32]], kinds: Sequence[str], placed: bool
) -> Callable[[NDArray[np.float32], str], NDArray[np.bool_]]:
    """A judge: the kind of the nearest of :data:`TEMPLATES` samples of each; of paths, whatever their place and size."""

    def flat(samples: NDArray[np.float32], scale: NDArray[np.float32]) -> Points:
        scaled = samples / scale
        if not placed:
            scaled = scaled - scaled.mean(axis=1, keepdims=True)
            scaled = scaled / np.sqrt((scaled**2).mean(axis=(1, 2), keepdims=True))
        return np.asarray(scaled.reshape(len(scaled), -1), dtype=np.float64)

    def judge(samples: NDArray[np.float32], kind: str) -> NDArray[np.bool_]:
        known = np.concatenate([draw(one, TEMPLATES, TEMPLATE_SEED) for one in kinds])
        scale = known.reshape(-1, known.shape[2]).std(axis=0) if known.shape[1] > 1 else np.ones(known.shape[2], dtype=np.float32)
        apart = np.linalg.norm(flat(samples, scale)[:, None] - flat(known, scale), axis=-1)
        return np.repeat(kinds, TEMPLATES)[apart.argmin(axis=1)] == kind

    return judge


def _own(word: str, draw: Callable[[str, int, int], NDArray[np.float32]], counts: tuple[int, int], placed: bool = True) -> Family:
    training = [f"{word} {number}" for number in range(counts[0])]
    new = [f"{word} {number}" for number in range(100, 100 + counts[1])]
    return Family(training, new, draw, _nearest(draw, [*training, *new], placed))


# Relations of three shapes that the paper does not have.


def _points(scenes: Tensor) -> Tensor:
    x, y, _ = columns(scenes)
    return torch.stack((x, y), dim=-1)  # circle, triangle, square


def _between(points: Tensor, one: int, other: int) -> Tensor:
    return (points[:, one] - points[:, other]).norm(dim=-1)


def _angle(points: Tensor, one: int, at: int, other: int) -> Tensor:
    first, second = points[:, one] - points[:, at], points[:, other] - points[:, at]
    cosine = (first * second).sum(dim=-1) / (first.norm(dim=-1) * second.norm(dim=-1))
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def _corners(points: Tensor) -> Tensor:
    return torch.stack([_angle(points, *some) for some in ((0, 1, 2), (1, 0, 2), (0, 2, 1))])


def _sides(points: Tensor) -> Tensor:
    return torch.stack([_between(points, *some) for some in ((0, 1), (1, 2), (0, 2))])


RULES: Mapping[str, Callable[[Tensor, float], Tensor]] = {
    "triangle midway": lambda p, m: (p[:, 1] - (p[:, 0] + p[:, 2]) / 2).norm(dim=-1) < 0.2 * m,
    "in a line": lambda p, m: _corners(p).amax(dim=0) > 180 - 5 * m,
    "equilateral": lambda p, m: (_corners(p) - 60).abs().amax(dim=0) < 5 * m,
    "far apart": lambda p, m: _sides(p).amin(dim=0) > 3.2 - 0.2 * m,
    "close together": lambda p, m: _sides(p).amax(dim=0) < 1.4 + 0.3 * m,
    "in a row": lambda p, m: (p[:, :, 1].amax(dim=1) - p[:, :, 1].amin(dim=1)) < 0.25 * m,
    "circle in the corner": lambda p, m: p[:, 0].amax(dim=-1) < 0.7 + 0.2 * m,
    "square in the middle": lambda p, m: (p[:, 2] - 2.5).norm(dim=-1) < 0.3 * m,
    "at a distance": lambda p, m: (_between(p, 0, 2) - 2.5).abs() < 0.12 * m,
    "mirrored": lambda p, m: ((p[:, 0, 0] + p[:, 2, 0] - 5).abs() < 0.25 * m) & ((p[:, 0, 1] - p[:, 2, 1]).abs() < 0.25 * m),
    "opposite corners": lambda p, m: (
        (p[:, 0, 0] < 0.8 + 0.2 * m) & (p[:, 0, 1] > 4.2 - 0.2 * m) & (p[:, 2, 0] > 4.2 - 0.2 * m) & (p[:, 2, 1] < 0.8 + 0.2 * m)
    ),
    "right angle": lambda p, m: (_angle(p, 0, 1, 2) - 90).abs() < 5 * m,
    "left of both": lambda p, m: (p[:, 1, 0] < p[:, 0, 0] - 1.2 + 0.2 * m) & (p[:, 1, 0] < p[:, 2, 0] - 1.2 + 0.2 * m),
    "gentle slope": lambda p, m: (
        ((p[:, 0, 1] - p[:, 2, 1] - 0.5 * (p[:, 0, 0] - p[:, 2, 0])).abs() < 0.15 * m) & (p[:, 0, 0] - p[:, 2, 0] > 0.8)
    ),
    "far below": lambda p, m: ((p[:, 0, 0] - p[:, 1, 0]).abs() < 0.2 * m) & (p[:, 1, 1] - p[:, 0, 1] > 2.5 - 0.2 * m),
}
"""``(centres (scene, shape, 2), margin) -> (scene,)``: demonstrations hold with margin 1, samples are right with 2."""
HARD = ("in a line", "equilateral", "far apart", "at a distance", "right angle")
"""Those of which one set of embeddings generates something in between, which is wrong."""


def _scenes(kind: str, count: int, seed: int) -> NDArray[np.float32]:
    found: list[Tensor] = []
    while sum(len(some) for some in found) < count:
        proposed = random_scenes(200_000, zlib.crc32(f"{kind} {seed} {len(found)}".encode()))
        fitting = proposed[RULES[kind](_points(proposed), 1.0)]
        found.append(fitting[~overlap(fitting)])
    return np.asarray(torch.cat(found)[:count, None].numpy(), dtype=np.float32)


def _holds(samples: NDArray[np.float32], kind: str) -> NDArray[np.bool_]:
    return np.asarray(RULES[kind](_points(torch.from_numpy(samples[:, 0])), 2.0).numpy())


FAMILIES: Mapping[str, Family] = {
    "relations": Family((), tuple(RULES), _scenes, _holds, "object_rearrangement"),
    "paths": _own("path", _paths, (8, 6), placed=False),
    "pictures": _own("picture", pictures, (8, 4)),
    "series": _own("series", _series, (8, 4)),
    "reaches": _own("reach", reaches, (8, 4)),
    "beats": _own("beat", beats, (8, 4)),
}
KEPT = ("reaches", "beats")
"""Families that nothing was chosen on."""
