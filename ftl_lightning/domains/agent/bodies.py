"""Meshes of revolution for bodies without a pybullet primitive: cone and bowl."""

import math
from collections.abc import Sequence

Mesh = tuple[list[list[float]], list[int]]
"""Vertices ``[x, y, z]`` in metres, y up, and triangles as a flat list of vertex indices, counter-clockwise from outside."""

SEGMENTS = 24


def revolve(profile: Sequence[tuple[float, float]], segments: int = SEGMENTS) -> Mesh:
    """Rotate a closed profile around the y axis.

    Args:
        profile: ``(radius, y)`` from the lower pole to the upper one along the outside of the body; both ends on the axis.
        segments: segments of a full turn.
    """
    vertices: list[list[float]] = []
    for radius, y in profile:
        for step in range(segments):
            angle = 2 * math.pi * step / segments
            vertices.append([radius * math.sin(angle), y, radius * math.cos(angle)])
    triangles: list[int] = []
    for ring in range(len(profile) - 1):
        for step in range(segments):
            here, right = ring * segments + step, ring * segments + (step + 1) % segments
            above, above_right = here + segments, right + segments
            triangles += [here, right, above_right, here, above_right, above]
    return vertices, triangles


def cone(radius: float, half_height: float) -> Mesh:
    """Cone standing on its base, centred at half its height."""
    return revolve([(0.0, -half_height), (radius, -half_height), (0.0, half_height)])


def bowl(radius: float, half_height: float, thickness: float, rings: int = 6) -> Mesh:
    """Concave open shell between two half ellipsoids.

    Args:
        radius: outer radius of the rim.
        half_height: half the height; the centre is at half the height.
        thickness: thickness of the wall.
        rings: rings of each surface.
    """
    height = 2 * half_height
    angles = [math.pi / 2 * ring / rings for ring in range(rings + 1)]
    outside = [(radius * math.sin(a), half_height - height * math.cos(a)) for a in angles]
    inside = [((radius - thickness) * math.sin(a), half_height - (height - thickness) * math.cos(a)) for a in reversed(angles)]
    return revolve([*outside, *inside])
