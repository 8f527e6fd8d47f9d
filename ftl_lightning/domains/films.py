"""Films as data: moving shapes in the plane, and wireframes, moving points and lines in space, in a hundredth of pictures' bytes.

Wireframes are seen from a fixed direction in parallel projection, so that lengths are comparable within and between films.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Kind = Literal["area", "line", "dots", "way"]
Points = NDArray[np.float32]
Frames = list[NDArray[np.uint8]]
"""Pictures ``(height, width, 3)``."""

SIDE, ABOVE = math.radians(28), math.radians(12)
"""View direction: rotation about the vertical towards +x, and elevation."""
SIZE, FINER = 240, 3
"""Width and height of a frame in pixels, and its supersampling factor."""
PAPER, GROUND, GRID = (255, 255, 255), (238, 240, 242), (214, 218, 222)
FLOOR, LIMB = "#dfe3e8", 0.045
"""Colour of the floor and width of lines in metres."""


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
    points: Points
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
        scale: minimum pixels per unit on the page of ``play``, which then follows the last shape; 0 shows the whole window.
    """

    shapes: Sequence[Shape]
    window: tuple[float, float, float, float]
    rate: float
    scale: float = 0.0

    @property
    def frames(self) -> int:
        """Number of frames."""
        return max((len(shape.points) for shape in self.shapes), default=0)


@dataclass(frozen=True)
class Wireframe:
    """Motion of points connected by lines.

    Attributes:
        points: ``(frame, point, 3)`` in metres: x and y along the floor, z upwards, floor at 0. The viewer is at +y.
        lines: pairs of points; colours: ``#rrggbb`` of each line, in the same order.
        heads: points drawn as balls, with radius in metres and colour.
        rate: frames per second.
        room: radius of the floor, a disc, and height that is always visible, in metres. Films of the same room have the same scale,
            unless motion leaves the room.
    """

    points: Points
    lines: tuple[tuple[int, int], ...]
    colours: tuple[str, ...]
    heads: tuple[tuple[int, float, str], ...] = ()
    rate: float = 30.0
    room: tuple[float, float] = (0.75, 2.1)


def still(kind: Kind, points: Sequence[Sequence[float]] | NDArray[np.floating], colour: str, size: float = 0.0) -> Shape:
    """Still shape from points ``(point, 2)``."""
    return Shape(kind, np.asarray(points, dtype=np.float32)[None], colour, size)


def regular(corners: int, radius: float, turn: float = 0.0) -> Points:
    """Regular polygon ``(corners, 2)`` around the origin, with a corner at the angle ``turn`` in radians."""
    angle = turn + np.arange(corners) * 2 * math.pi / corners
    return (radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)).astype(np.float32)


def some(count: int, most: int) -> NDArray[np.int64]:
    """At most ``most`` evenly spaced frames, including the first and last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


def of_wireframe(wireframe: Wireframe) -> VectorFilm:
    """Vector film of a wireframe, with its floor."""
    at = seen(wireframe.points)[..., :2]
    left, lower, side = window([wireframe])
    shapes = [still("area", seen(disc(wireframe.room[0]))[:, :2], FLOOR)]
    lines = zip(wireframe.lines, wireframe.colours, strict=True)
    shapes += [Shape("line", at[:, list(pair)], colour, LIMB) for pair, colour in lines]
    shapes += [Shape("dots", at[:, [point]], colour, radius) for point, radius, colour in wireframe.heads]
    return VectorFilm(shapes, (left, lower, side, side), wireframe.rate)


def seen(points: Points) -> Points:
    """Project points ``(..., 3)`` to the picture ``(..., 3)``: right, up, and towards the viewer, in metres."""
    x, y, z = np.moveaxis(points, -1, 0)
    # The viewer is at +y, so +x points left.
    across, near = -x * math.cos(SIDE) + y * math.sin(SIDE), x * math.sin(SIDE) + y * math.cos(SIDE)
    up, towards = z * math.cos(ABOVE) - near * math.sin(ABOVE), near * math.cos(ABOVE) + z * math.sin(ABOVE)
    return np.stack((across, up, towards), axis=-1).astype(np.float32)


def window(wireframes: Sequence[Wireframe]) -> tuple[float, float, float]:
    """Square window around motions: left edge, lower edge and side, in metres of :func:`seen`."""
    radius, height = wireframes[0].room
    top = np.array([[0, 0, height]], dtype=np.float32)
    flat = np.concatenate([seen(disc(radius)), seen(top)])[:, :2]
    everything = [flat, *(seen(motion.points)[..., :2].reshape(-1, 2) for motion in wireframes)]
    low = np.min([part.min(axis=0) for part in everything], axis=0)
    high = np.max([part.max(axis=0) for part in everything], axis=0)
    side = float((high - low).max())
    left, lower = (low + high - side) / 2
    return float(left), float(lower), side


def disc(radius: float) -> Points:
    """Edge ``(64, 3)`` of a round floor."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), 0 * angle), axis=-1).astype(np.float32)


def drawn(wireframe: Wireframe) -> Frames:
    """Draw frames ``(SIZE, SIZE, 3)`` of a motion on a round floor."""
    wide = SIZE * FINER
    left, lower, side = window([wireframe])
    margin = 0.04 * wide
    scale = (wide - 2 * margin) / side

    def place(points: Points) -> Points:
        at = seen(points)
        at[..., 0] = margin + (at[..., 0] - left) * scale
        at[..., 1] = wide - margin - (at[..., 1] - lower) * scale
        return at

    empty = Image.new("RGB", (wide, wide), PAPER)
    for part, colour in ((1.0, GROUND), (2 / 3, None), (1 / 3, None)):  # rings, a third of the floor apart
        edge = [(x, y) for x, y, _ in place(disc(wireframe.room[0] * part)).tolist()]
        ImageDraw.Draw(empty).polygon(edge, fill=colour, outline=GRID, width=max(1, wide // 360))
    pictures = []
    at = place(wireframe.points)
    shade = place(wireframe.points * np.array([1, 1, 0], dtype=np.float32))
    for frame, shadow in zip(at, shade, strict=True):
        picture = empty.copy()
        pen = ImageDraw.Draw(picture)
        for a, b in wireframe.lines:
            _line(pen, shadow[a], shadow[b], GRID, LIMB * scale)
        depth = [float(frame[a, 2] + frame[b, 2]) for a, b in wireframe.lines]
        for index in np.argsort(depth):  # nearer lines on top
            a, b = wireframe.lines[index]
            _line(pen, frame[a], frame[b], wireframe.colours[index], LIMB * scale)
        for point, radius, head_colour in wireframe.heads:
            _ball(pen, frame[point], radius * scale, head_colour)
        pictures.append(np.asarray(picture.resize((SIZE, SIZE), Image.Resampling.BOX), dtype=np.uint8))
    return pictures


def _line(pen: ImageDraw.ImageDraw, a: Points, b: Points, colour: str | tuple[int, int, int], width: float) -> None:
    pen.line((float(a[0]), float(a[1]), float(b[0]), float(b[1])), fill=colour, width=max(1, round(width)))
    for end in (a, b):
        _ball(pen, end, width / 2, colour)


def _ball(pen: ImageDraw.ImageDraw, at: Points, radius: float, colour: str | tuple[int, int, int]) -> None:
    x, y = float(at[0]), float(at[1])
    pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
