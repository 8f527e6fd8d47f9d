"""Motion as points and lines in space: what films of bodies are drawn from, here and by a web page.

Everything is drawn from one place, from the front and a little from the side and from above, without perspective, so that lengths
can be compared within a film and between films.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Points = NDArray[np.float32]

SIDE, ABOVE = math.radians(28), math.radians(12)
"""Where the film is seen from: turned about the vertical towards +x, and raised above the horizontal."""
SIZE = 240
"""Width and height of a frame in pixels."""
FINER = 3
"""Frames are drawn this many times as large and made smaller, which smooths lines."""
PAPER, GROUND, GRID = (255, 255, 255), (238, 240, 242), (214, 218, 222)


@dataclass(frozen=True)
class Wireframe:
    """A motion of points, some of them joined by lines.

    Attributes:
        points: ``(frame, point, 3)`` in metres: x and y along the floor, z upwards, the floor at 0. Who faces +y faces the viewer.
        lines: pairs of points; colours: one ``#rrggbb`` each, in the same order.
        heads: points with a ball around them, with its radius in metres and colour.
        rate: frames a second.
        room: radius of the floor, a disc, and the height that is always in sight, in metres. Films with the same room have the same
            scale, unless something leaves it.
    """

    points: Points
    lines: tuple[tuple[int, int], ...]
    colours: tuple[str, ...]
    heads: tuple[tuple[int, float, str], ...] = ()
    rate: float = 30.0
    room: tuple[float, float] = (0.75, 2.1)


def seen(points: Points) -> Points:
    """Where points are in the picture.

    Args:
        points: ``(..., 3)`` in metres.

    Returns:
        ``(..., 3)``: to the right, upwards, and towards the viewer, in metres.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    # The viewer stands at +y, so that +x is at the left.
    across, near = -x * math.cos(SIDE) + y * math.sin(SIDE), x * math.sin(SIDE) + y * math.cos(SIDE)
    return np.stack(
        (across, z * math.cos(ABOVE) - near * math.sin(ABOVE), near * math.cos(ABOVE) + z * math.sin(ABOVE)), axis=-1
    ).astype(np.float32)


def window(wireframes: Sequence[Wireframe]) -> tuple[float, float, float]:
    """The square that all of some motions are seen in: its left and lower edge and its side, in metres of :func:`seen`."""
    radius, height = wireframes[0].room
    top = np.array([[0, 0, height]], dtype=np.float32)
    flat = np.concatenate([seen(disc(radius)), seen(top)])[:, :2]
    everything = [flat, *(seen(one.points)[..., :2].reshape(-1, 2) for one in wireframes)]
    low = np.min([part.min(axis=0) for part in everything], axis=0)
    high = np.max([part.max(axis=0) for part in everything], axis=0)
    side = float((high - low).max())
    left, lower = (low + high - side) / 2
    return float(left), float(lower), side


def disc(radius: float) -> Points:
    """The edge ``(64, 3)`` of a round floor."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), 0 * angle), axis=-1).astype(np.float32)


def drawn(wireframe: Wireframe, size: int = SIZE) -> list[NDArray[np.uint8]]:
    """Frames ``(size, size, 3)`` of a motion, on a round floor.

    Args:
        wireframe: the motion.
        size: of a frame in pixels.
    """
    wide = size * FINER
    left, lower, side = window([wireframe])
    margin = 0.04 * wide
    scale = (wide - 2 * margin) / side

    def place(points: Points) -> Points:
        at = seen(points)
        at[..., 0] = margin + (at[..., 0] - left) * scale
        at[..., 1] = wide - margin - (at[..., 1] - lower) * scale
        return at

    empty = Image.new("RGB", (wide, wide), PAPER)
    _floor(ImageDraw.Draw(empty), place, wireframe.room[0], wide)
    pictures = []
    at = place(wireframe.points)
    shade = place(wireframe.points * np.array([1, 1, 0], dtype=np.float32))
    for frame, shadow in zip(at, shade, strict=True):
        picture = empty.copy()
        pen = ImageDraw.Draw(picture)
        for a, b in wireframe.lines:
            _line(pen, shadow[a], shadow[b], GRID, 0.045 * scale)
        depth = [float(frame[a, 2] + frame[b, 2]) for a, b in wireframe.lines]
        for index in np.argsort(depth):  # what is nearer hides what is behind it
            a, b = wireframe.lines[index]
            _line(pen, frame[a], frame[b], wireframe.colours[index], 0.045 * scale)
        for point, radius, colour in wireframe.heads:
            _ball(pen, frame[point], radius * scale, colour)
        pictures.append(np.asarray(picture.resize((size, size), Image.Resampling.BOX), dtype=np.uint8))
    return pictures


def _floor(pen: ImageDraw.ImageDraw, place: Callable[[Points], Points], radius: float, wide: int) -> None:
    for part, colour in ((1.0, GROUND), (2 / 3, None), (1 / 3, None)):  # rings, a third of the floor apart
        edge = [(x, y) for x, y, _ in place(disc(radius * part)).tolist()]
        pen.polygon(edge, fill=colour, outline=GRID, width=max(1, wide // 360))


def _line(pen: ImageDraw.ImageDraw, a: Points, b: Points, colour: str | tuple[int, int, int], width: float) -> None:
    pen.line((float(a[0]), float(a[1]), float(b[0]), float(b[1])), fill=colour, width=max(1, round(width)))
    for end in (a, b):
        _ball(pen, end, width / 2, colour)


def _ball(pen: ImageDraw.ImageDraw, at: Points, radius: float, colour: str | tuple[int, int, int]) -> None:
    x, y = float(at[0]), float(at[1])
    pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
