"""Films of moving shapes, drawn by web pages at any size, in a hundredth of the bytes of pictures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.wireframe import Wireframe, disc, seen, window

Kind = Literal["area", "line", "dots", "way"]


@dataclass(frozen=True)
class Shape:
    """Shape of a film.

    Attributes:
        kind: ``'area'``, a filled polygon; ``'line'`` through the points; ``'dots'``, a disc at each point; ``'way'``, the past
            path of a single point.
        points: ``(frame, point, 2)`` in the film's unit, x right and y up; ``(1, point, 2)`` for a still shape. Shapes with a point
            that is not finite are hidden in this frame.
        colour: ``#rrggbb``.
        size: width of a line or radius of a disc in the film's unit; 0 for a hairline, or the outline of an area.
        filled: whether areas and discs are filled.
    """

    kind: Kind
    points: NDArray[np.float32]
    colour: str
    size: float = 0.0
    filled: bool = True


@dataclass(frozen=True)
class VectorFilm:
    """Film of a plan or episode.

    Attributes:
        shapes: shapes in drawing order; moving shapes have the same number of frames.
        window: visible window: left edge, lower edge, width and height, in the film's unit.
        rate: frames per second. Points are interpolated linearly between frames.
    """

    shapes: Sequence[Shape]
    window: tuple[float, float, float, float]
    rate: float

    @property
    def frames(self) -> int:
        """Number of frames."""
        return max((len(shape.points) for shape in self.shapes), default=0)


def still(kind: Kind, points: Sequence[Sequence[float]] | NDArray[np.floating], colour: str, size: float = 0.0) -> Shape:
    """Still shape from points ``(point, 2)``."""
    return Shape(kind, np.asarray(points, dtype=np.float32)[None], colour, size)


def regular(corners: int, radius: float, turn: float = 0.0) -> NDArray[np.float32]:
    """Regular polygon ``(corners, 2)`` around the origin, with a corner at the angle ``turn`` in radians."""
    angle = turn + np.arange(corners) * 2 * math.pi / corners
    return (radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)).astype(np.float32)


def some(count: int, most: int) -> NDArray[np.int64]:
    """At most ``most`` evenly spaced frames, including the first and last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


FLOOR, LIMB = "#dfe3e8", 0.045
"""Colour of the floor and width of lines in metres."""


def of_wireframe(wireframe: Wireframe) -> VectorFilm:
    """Vector film of a wireframe, with its floor."""
    at = seen(wireframe.points)[..., :2]
    left, lower, side = window([wireframe])
    shapes = [still("area", seen(disc(wireframe.room[0]))[:, :2], FLOOR)]
    shapes += [
        Shape("line", at[:, list(pair)], colour, LIMB) for pair, colour in zip(wireframe.lines, wireframe.colours, strict=True)
    ]
    shapes += [Shape("dots", at[:, [point]], colour, radius) for point, radius, colour in wireframe.heads]
    return VectorFilm(shapes, (left, lower, side, side), wireframe.rate)
