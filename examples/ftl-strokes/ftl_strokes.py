"""Pen strokes in the plane: four shapes drawn four ways, of which two are new and learned from five strokes each."""

from math import pi

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Concepts, Domain, Generated, Metric, Plans
from ftl_lightning.domains.tasks import few_shot_suites
from ftl_lightning.services.randomness import generator, task_key

PLANS = Plans(horizon=32, columns=("x", "y"), units=("cm", "cm"))
S = torch.linspace(0, 1, PLANS.horizon)  # the way along a stroke; points are complex numbers x + iy
SHAPES = {
    "line": 2 * S - 1 + 0j,
    "arc": -torch.exp(-1j * pi * S),
    "wave": 2 * S - 1 + 0.5j * torch.sin(4 * pi * S),
    "zigzag": 2 * S - 1 + 1j * (8 * S % 2 - 1).abs() - 0.5j,
}
WAYS = {"rightwards": 1, "upwards": 1j, "leftwards": -1, "downwards": -1j}
CURVES = {f"{shape} {way}": turn * curve for shape, curve in SHAPES.items() for way, turn in WAYS.items()}
NEW = ("wave upwards", "zigzag leftwards")
KNOWN = tuple(kind for kind in CURVES if kind not in NEW)


def draw(kind: str, count: int, seed: int) -> Tensor:
    """Strokes ``(count, 32, 2)`` of one kind that differ in size, slant and place."""
    size, slant, x, y = torch.rand(4, count, 1, generator=generator("cpu", seed, task_key(kind)))
    points = (1 + size) * torch.exp(0.5j * (slant - 0.5)) * CURVES[kind] + 2 * torch.complex(x, y) - (1 + 1j)
    return torch.view_as_real(points)


def recognised(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether strokes ``(sample, 32, 2)`` are like the goal's curve, and more so than like any other, whatever size and place."""
    curves = torch.stack(tuple(CURVES.values()))
    centred = [points - points.mean(dim=1, keepdim=True) for points in (torch.view_as_complex(states.contiguous()), curves)]
    found, known = (points / points.abs().square().mean(dim=1, keepdim=True).sqrt() for points in centred)
    apart = (found[:, None] - known).abs().square().mean(dim=2).sqrt()  # (sample, curve)
    return (apart.argmin(dim=1) == list(CURVES).index(goal)) & (apart.amin(dim=1) < 0.4)


CONCEPTS = Concepts(KNOWN, few_shot_suites(KNOWN, NEW))
SOURCE = Generated("strokes", PLANS, KNOWN, draw)
DOMAIN = Domain("strokes", PLANS, CONCEPTS, lambda root: SOURCE, metrics={"accuracy": Metric(recognised)})
