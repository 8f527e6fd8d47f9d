"""Films as shapes that move: a web page draws them at any size, in a hundredth of the bytes of pictures."""

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
    """Something that is drawn.

    Attributes:
        kind: ``'area'``, a filled polygon; ``'line'`` through the points; ``'dots'``, a disc at each point; ``'way'``, the line
            through all places so far of a single point.
        points: ``(frame, point, 2)`` in the film's unit, x to the right and y upwards, or ``(1, point, 2)`` where nothing moves.
            A shape with a point that is not finite is not there in this frame.
        colour: ``#rrggbb``.
        size: width of a line or radius of a disc in the film's unit; 0 for a hairline, or the outline of an area.
        filled: whether areas and discs are.
    """

    kind: Kind
    points: NDArray[np.float32]
    colour: str
    size: float = 0.0
    filled: bool = True


@dataclass(frozen=True)
class VectorFilm:
    """A film of one plan or episode.

    Attributes:
        shapes: in the order in which they are drawn; those that move have equally many frames.
        window: what is in sight: left, lower edge, width and height, in the film's unit.
        rate: frames a second. Between frames, points move evenly.
    """

    shapes: Sequence[Shape]
    window: tuple[float, float, float, float]
    rate: float

    @property
    def frames(self) -> int:
        """How many there are."""
        return max((len(shape.points) for shape in self.shapes), default=0)


def still(kind: Kind, points: Sequence[Sequence[float]] | NDArray[np.floating], colour: str, size: float = 0.0) -> Shape:
    """A shape that does not move, from its points ``(point, 2)``."""
    return Shape(kind, np.asarray(points, dtype=np.float32)[None], colour, size)


def regular(corners: int, radius: float, turn: float = 0.0) -> NDArray[np.float32]:
    """A regular polygon ``(corners, 2)`` around the origin, with a corner at the angle ``turn`` in radians."""
    angle = turn + np.arange(corners) * 2 * math.pi / corners
    return (radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)).astype(np.float32)


def some(count: int, most: int) -> NDArray[np.int64]:
    """At most so many of some frames, evenly, with the first and the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


FLOOR, LIMB = "#dfe3e8", 0.045
"""Colour of the floor, and the width of lines in metres."""


def of_wireframe(wireframe: Wireframe) -> VectorFilm:
    """A motion in space as it is seen in pictures, on its floor."""
    at = seen(wireframe.points)[..., :2]
    left, lower, side = window([wireframe])
    shapes = [still("area", seen(disc(wireframe.room[0]))[:, :2], FLOOR)]
    shapes += [
        Shape("line", at[:, list(pair)], colour, LIMB) for pair, colour in zip(wireframe.lines, wireframe.colours, strict=True)
    ]
    shapes += [Shape("dots", at[:, [point]], colour, radius) for point, radius, colour in wireframe.heads]
    return VectorFilm(shapes, (left, lower, side, side), wireframe.rate)
