"""Vectorised rejection sampling of scenes that show only their task."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.object_rearrangement.relations import (
    EXTENT,
    PER_SHAPE,
    SHAPES,
    TRAINING_RELATIONS,
    Relation,
    holds,
    overlap,
    parse,
)
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import task_key

SIZE = (0.3, 1.0)
"""Range of a shape's radius (paper)."""
PROPOSALS = 32_768
"""Scenes per proposal round."""
PATIENCE = 200
"""Maximum number of rounds before a task counts as infeasible."""
PLAIN = 256
"""Scenes per proposal round of :func:`plain_scene`."""
_ALONG = {"diagonal to": (1 + 1j) / abs(1 + 1j), "antidiagonal to": (-1 + 1j) / abs(-1 + 1j)}
"""Unit direction from B to A on a relation's line, as a complex number x + iy."""


def generate(task: str, count: int, seed: int) -> Tensor:
    """Draw scenes in which a task holds exactly, no shapes overlap and no unrelated training relation holds.

    Args:
        task: relations in words, see :func:`~ftl_lightning.domains.object_rearrangement.relations.parse`.
        count: number of scenes.
        seed: seed; the same task and seed give the same bytes.

    Returns:
        ``(count, 21)`` float32; for circle, triangle and square: x, y in [0, 5], radius in [0.3, 1], angle in [0, 2 pi],
        one-hot type.

    Raises:
        UserError: if the task cannot be parsed, or hardly any scene shows it.
    """
    relations = parse(task)
    related = {named for relation in relations for named in _related(relation)}
    unrelated = [relation for relation in TRAINING_RELATIONS if relation not in related]
    rng = np.random.default_rng([seed, task_key(task)])
    kept: list[Tensor] = []
    for _ in range(PATIENCE):
        scenes = _propose(relations, rng)
        good = ~overlap(scenes)
        for relation in relations:
            good &= holds(relation, scenes, relaxed=False)
        for relation in unrelated:
            good &= ~holds(relation, scenes, relaxed=False)
        kept.append(scenes[good])
        if sum(map(len, kept)) >= count:
            return torch.cat(kept)[:count].contiguous()
    raise UserError(
        f"object_rearrangement task {task!r}: {sum(map(len, kept))} of {count} scenes found in {PATIENCE * PROPOSALS:,} "
        "proposals; its relations contradict each other or leave hardly any room"
    )


def _related(relation: Relation) -> tuple[Relation, ...]:
    """A relation and the training relations implied by its definition."""
    if relation.kind == "diagonal to":
        return (relation, Relation("right of", relation.shapes), Relation("above", relation.shapes))
    if relation.kind == "antidiagonal to":
        return (relation, Relation("right of", relation.shapes[::-1]), Relation("above", relation.shapes))
    if relation.kind == "next to":
        both = (relation.shapes, relation.shapes[::-1])
        return (relation, *(Relation(kind, pair) for kind in ("right of", "above") for pair in both))
    return (relation,)


def _propose(relations: tuple[Relation, ...], rng: np.random.Generator) -> Tensor:
    """Uniform scenes, at most ``(PROPOSALS, 21)``; centres are placed to satisfy relations of measure zero, rings first and
    then moved rigidly.
    """
    scenes = _uniform_scenes(rng, PROPOSALS)
    wanted = sorted((relation for relation in relations if not relation.negated), key=lambda relation: relation.kind != "ring")
    on_ring = bool(wanted) and wanted[0].kind == "ring"
    for relation in wanted:
        which = [SHAPES.index(shape) for shape in relation.shapes]
        if on_ring and relation.kind in _ALONG:
            scenes[..., :2] = _moved_onto(_ALONG[relation.kind], scenes[..., :2], which[0], which[1])
        elif relation.kind == "diagonal to":
            scenes[:, which, 1] = scenes[:, which, 0]
        elif relation.kind == "antidiagonal to":
            scenes[:, which, 1] = EXTENT - scenes[:, which, 0]
        elif relation.kind == "ring":
            centre = rng.uniform(0, EXTENT, (PROPOSALS, 1, 2))
            turn = rng.uniform(0, 2 * np.pi, (PROPOSALS, 1))
            clockwise = rng.choice((-1, 1), (PROPOSALS, 1))  # either order of the shapes around the ring
            angle = turn + clockwise * np.arange(len(SHAPES)) * 2 * np.pi / len(SHAPES)
            scenes[..., :2] = centre + relation.radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    inside = ((scenes[..., :2] >= 0) & (scenes[..., :2] <= EXTENT)).all(axis=(1, 2))
    return _flat(scenes[inside])


def _moved_onto(along: complex, centres: NDArray[np.float32], a: int, b: int) -> NDArray[np.float32]:
    """Rotate and shift centres ``(scene, shape, 2)`` until A and B lie on a line, A further along it.

    Args:
        along: unit direction of the line, which passes through the middle of the square.
        centres: centres of the shapes.
        a, b: indices of A and B.
    """
    points = centres[..., 0] + 1j * centres[..., 1]
    way, middle = points[:, [a]] - points[:, [b]], (1 + 1j) * EXTENT / 2
    turned = (points - points[:, [a]]) * along * abs(way) / way
    moved = turned + middle + along * ((points[:, [a]] - middle) * along.conjugate()).real
    return np.stack((moved.real, moved.imag), axis=-1).astype(np.float32)


def _uniform_scenes(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Scenes ``(count, shape, 7)`` whose centres, radii and angles are uniform; shapes may overlap."""
    scenes = np.zeros((count, len(SHAPES), PER_SHAPE), dtype=np.float32)
    scenes[..., :2] = rng.uniform(0, EXTENT, (count, len(SHAPES), 2))
    scenes[..., 2] = rng.uniform(*SIZE, (count, len(SHAPES)))
    scenes[..., 3] = rng.uniform(0, 2 * np.pi, (count, len(SHAPES)))
    scenes[..., 4:] = np.eye(len(SHAPES), dtype=np.float32)
    return scenes


def random_scenes(count: int, seed: int) -> Tensor:
    """Uniform scenes ``(count, 21)``: baseline of a policy that ignores the task."""
    return _flat(_uniform_scenes(np.random.default_rng(seed), count))


def plain_scene(seed: int) -> Tensor:
    """Scene ``(21,)`` without overlapping shapes or training relations."""
    rng = np.random.default_rng(seed)
    while True:
        scenes = _flat(_uniform_scenes(rng, PLAIN))
        plain = ~overlap(scenes)
        for relation in TRAINING_RELATIONS:
            plain &= ~holds(relation, scenes, relaxed=False)
        if plain.any():
            return scenes[plain][0]


def _flat(scenes: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(scenes.reshape(len(scenes), len(SHAPES) * PER_SHAPE))
