"""Motion between states of a vehicle ``(..., 7)`` in its frame, independent of the road."""

import torch
from torch import Tensor


def turned(pairs: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate ``(..., 2)`` by an angle."""
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def speed(states: Tensor) -> Tensor:
    """Velocity ``(..., 2)`` along and across the heading in m/s."""
    return turned(states[..., 3:5], states[..., 5], -states[..., 6])


def turn(before: Tensor, after: Tensor) -> Tensor:
    """Cosine and sine ``(..., 2)`` of the rotation between the headings."""
    return turned(after[..., 5:7], before[..., 5], -before[..., 6])


def way(before: Tensor, after: Tensor) -> Tensor:
    """Metres ``(..., 2)`` along and across the mean heading; on a curve: nearly its length, and 0."""
    seen = turned(after[..., 1:3] - before[..., 1:3], before[..., 5], -before[..., 6])
    cos, sin = turn(before, after).unbind(-1)
    half = torch.atan2(sin, cos) / 2
    return turned(seen, half.cos(), -half.sin())


def drive(before: Tensor, after: Tensor) -> Tensor:
    """Displacement and final velocity ``(..., 4)``: the driver's decision, independent of the road's direction."""
    return torch.cat((way(before, after), speed(after)), dim=-1)
