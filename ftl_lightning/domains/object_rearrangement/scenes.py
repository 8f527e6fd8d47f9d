"""Spatial relations between the three shapes: grammar, exact form and relaxed form; generation of scenes.

A task is a conjunction of relations in words, possibly negated (``'circle above square and not circle right of square'``).
:func:`holds` defines each relation; generation, a vectorised rejection sampling, uses exact margins, evaluation relaxed margins
(Netanyahu et al., 2024, appendix 'Object Rearrangement').
"""

import itertools
import re
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import task_key

SHAPES = ("circle", "triangle", "square")
EXTENT = 5.0
"""Centres lie in ``[0, EXTENT]^2`` (length units of the paper)."""
PER_SHAPE = 4 + len(SHAPES)
"""Columns per shape: x, y, size, angle, one-hot type."""

ORDERED_PAIRS = tuple(itertools.permutations(SHAPES, 2))
AND, NOT = " and ", "not "
PAIRWISE = ("right of", "above", "diagonal to", "antidiagonal to", "next to")
RADIUS_TOLERANCE, EXACT_TOLERANCE = 0.3, 1e-3
"""Tolerance of a ring's circumradius in evaluation, and of rings and lines in generated scenes."""
NEXT_TO_GAP = (0.3, 0.8)
"""Largest gap between two outlines that are 'next to' each other: exact, relaxed."""
SIZE = (0.3, 1.0)  # range of a shape's radius (paper)
PROPOSALS, PLAIN = 32_768, 256
"""Scenes per proposal round of :func:`generate` and :func:`plain_scene`."""
PATIENCE = 200
"""Maximum number of rounds before a task counts as infeasible."""
_ALONG = {"diagonal to": (1 + 1j) / abs(1 + 1j), "antidiagonal to": (-1 + 1j) / abs(-1 + 1j)}
"""Unit direction x + iy from B to A on a relation's line."""


@dataclass(frozen=True)
class Relation:
    """Relation between shapes.

    Attributes:
        kind: from :data:`PAIRWISE`, or ``'ring'`` (all three shapes on a circle).
        shapes: ordered pair (A, B), or all three shapes for a ring.
        radius: circumradius of a ring, 0 otherwise.
        negated: whether the relation must not hold.
    """

    kind: str
    shapes: tuple[str, ...]
    radius: float = 0.0
    negated: bool = False

    def __str__(self) -> str:
        if self.negated:
            return f"{NOT}{self.plain}"
        if self.kind == "ring":
            return f"circle, triangle and square in a circle of radius {self.radius:g}"
        return f"{self.shapes[0]} {self.kind} {self.shapes[1]}"

    @property
    def plain(self) -> "Relation":
        """The relation without negation."""
        return replace(self, negated=False)


def sentence(task: str) -> str:
    """Wording of a task for a language model (paper, appendix, 'Language')."""
    return AND.join(_worded(relation) for relation in parse(task))


def _worded(relation: Relation) -> str:
    if relation.negated:
        return f"{NOT}{_worded(relation.plain)}"
    if relation.kind == "ring":
        return f"circle triangle and square in a circle of radius {relation.radius:g}"
    if relation.kind == "diagonal to":
        return f"{relation.shapes[0]} right and above diagonally to {relation.shapes[1]}"
    return str(relation)


TRAINING_RELATIONS = tuple(Relation(kind, pair) for kind in ("right of", "above") for pair in ORDERED_PAIRS)

_SHAPE, _KIND = "|".join(SHAPES), "|".join(PAIRWISE)
_PAIR = rf"(?P<a>{_SHAPE}) (?P<kind>{_KIND}) (?!(?P=a))(?P<b>{_SHAPE})"
_RING = r"circle,? triangle and square in a circle of radius (?P<radius>\d+(?:\.\d+)?)"
_RELATION = re.compile(f"(?P<negated>{NOT})?(?:{_PAIR}|{_RING})")


def parse(task: str) -> tuple[Relation, ...]:
    """Parse relations joined by ``' and '``; raise a ``UserError`` if a part is not a relation."""
    relations = []
    end = -len(AND)
    while end < len(task):
        part = _RELATION.match(task, end + len(AND)) if end < 0 or task.startswith(AND, end) else None
        if part is None:
            raise UserError(
                f"object_rearrangement task {task!r}: found {task[max(end, 0) :]!r}, expected 'A <relation> B' with A, B different "
                f"among {', '.join(SHAPES)} and <relation> among {', '.join(PAIRWISE)}, or "
                f"'{Relation('ring', SHAPES, 1.67)}', after '{NOT}' or not, joined by '{AND}'"
            )
        negated = bool(part["negated"])
        if part["radius"]:
            relations.append(Relation("ring", SHAPES, float(part["radius"]), negated))
        else:
            relations.append(Relation(part["kind"], (part["a"], part["b"]), negated=negated))
        end = part.end()
    return tuple(relations)


def columns(states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and radius of the shapes, each ``(scene, shape)``, from ``(scene, 21)``."""
    shapes = states.unflatten(-1, (len(SHAPES), PER_SHAPE))
    return shapes[..., 0], shapes[..., 1], shapes[..., 2]


def circumradius(x: Tensor, y: Tensor) -> Tensor:
    """Radius ``(scene,)`` of the circle through three centres ``(scene, 3)``; infinite if collinear."""
    points = torch.stack((x, y), dim=-1)
    a, b, c = ((points[:, i] - points[:, j]).norm(dim=-1) for i, j in ((0, 1), (1, 2), (2, 0)))
    twice_area = ((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])).abs()
    return a * b * c / (2 * twice_area)


def holds(relation: Relation, states: Tensor, relaxed: bool) -> Tensor:
    """Whether a relation holds in each scene ``(scene, 21)``, exactly or in the relaxed form of evaluation, as for any negated
    one.
    """
    if relation.negated:
        return ~holds(relation.plain, states, relaxed=True)
    x, y, radius = columns(states)
    if relation.kind == "ring":
        return (circumradius(x, y) - relation.radius).abs() < (RADIUS_TOLERANCE if relaxed else EXACT_TOLERANCE)
    a, b = (SHAPES.index(shape) for shape in relation.shapes)
    dx, dy = x[:, a] - x[:, b], y[:, a] - y[:, b]
    reach = 2 * torch.maximum(radius[:, a], radius[:, b])
    margin = reach if relaxed else radius[:, a]
    on_line = reach if relaxed else torch.full_like(reach, EXACT_TOLERANCE)
    match relation.kind:
        case "right of":
            return (dx > 0) & (dy.abs() <= margin)
        case "above":
            return (dy > 0) & (dx.abs() <= margin)
        case "diagonal to":  # both centres on f(x) = x
            offset = torch.maximum((y[:, a] - x[:, a]).abs(), (y[:, b] - x[:, b]).abs())
            return (dx > 0) & (dy > 0) & (offset <= on_line)
        case "antidiagonal to":  # both centres on f(x) = EXTENT - x, A upper left
            offset = torch.maximum((y[:, a] + x[:, a] - EXTENT).abs(), (y[:, b] + x[:, b] - EXTENT).abs())
            return (dx < 0) & (dy > 0) & (offset <= on_line)
    gap = torch.hypot(dx, dy) - radius[:, a] - radius[:, b]  # next to
    return (gap >= 0) & (gap <= NEXT_TO_GAP[relaxed])


def overlap(states: Tensor) -> Tensor:
    """Whether circumscribed circles of any two shapes intersect: ``(scene,)`` of bool from ``(scene, 21)``."""
    x, y, radius = columns(states)
    touching = [
        torch.hypot(x[:, i] - x[:, j], y[:, i] - y[:, j]) <= radius[:, i] + radius[:, j]
        for i, j in itertools.combinations(range(len(SHAPES)), 2)
    ]
    return torch.stack(touching).any(dim=0)


def generate(task: str, count: int, seed: int) -> Tensor:
    """Draw scenes ``(count, 21)`` in which a task holds exactly, no shapes overlap and no unrelated training relation holds.

    Columns of circle, triangle and square: x, y in [0, 5], radius in [0.3, 1], angle in [0, 2 pi], one-hot type. Deterministic.

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
    """Uniform scenes, at most ``(PROPOSALS, 21)``, placed to satisfy relations of measure zero: rings, then moved rigidly."""
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
    """Rotate and shift centres until A and B lie on a line through the square's middle, A further along the unit direction."""
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
