"""Pen strokes in the plane: six kinds for pretraining, two new ones to learn from five strokes each."""

from math import pi

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import Concepts, Domain, Metric, Plans
from ftl_lightning.domains.generated import Generated
from ftl_lightning.domains.tasks import few_shot_suites
from ftl_lightning.seeding import generator, task_key

NAME, PLANS = "strokes", Plans(horizon=32, columns=("x", "y"), units=("cm", "cm"))
S = torch.linspace(0, 1, PLANS.horizon)  # the way along a stroke
TURN = 2 * pi * S
CURVES = {
    "line": (2 * S - 1, 0.3 * (2 * S - 1)),
    "arc": (-torch.cos(TURN / 2), torch.sin(TURN / 2)),
    "circle": (torch.cos(TURN), torch.sin(TURN)),
    "wave": (2 * S - 1, 0.5 * torch.sin(2 * TURN)),
    "zigzag": (2 * S - 1, (8 * S % 2 - 1).abs() - 0.5),
    "spiral": (S * torch.cos(2 * TURN), S * torch.sin(2 * TURN)),
    "figure eight": (0.6 * torch.sin(2 * TURN), torch.cos(TURN)),
    "hook": (torch.where(S < 0.5, 0.6, 0.6 * torch.cos(TURN - pi)), torch.where(S < 0.5, 1 - 2 * S, -0.6 * torch.sin(TURN - pi))),
}
NEW = ("figure eight", "hook")
TRAINING = tuple(kind for kind in CURVES if kind not in NEW)


def draw(kind: str, count: int, seed: int) -> Tensor:
    """Strokes ``(count, 32, 2)`` of a kind that differ in size, slant and place."""
    rng = generator("cpu", seed, task_key(kind))
    size, angle, place = (torch.rand(count, 1, 1, columns, generator=rng)[:, 0] for columns in (1, 1, 2))
    x, y = torch.stack(CURVES[kind]).expand(count, 2, -1).unbind(dim=1)
    angle = 0.5 * angle[..., 0] - 0.25
    turned = torch.stack((x * angle.cos() - y * angle.sin(), x * angle.sin() + y * angle.cos()), dim=-1)
    return (1 + size) * turned + 2 * place - 1


def recognised(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether each stroke is near the goal's curve, and nearer to it than to any other, whatever its size and place."""
    curves = torch.stack([torch.stack(curve, dim=-1) for curve in CURVES.values()])
    found, known = (one - one.mean(dim=1, keepdim=True) for one in (states, curves))
    found, known = (one / one.square().mean(dim=(1, 2), keepdim=True).sqrt() for one in (found, known))
    apart = (found[:, None] - known).square().mean(dim=(2, 3)).sqrt()
    return (apart.argmin(dim=1) == list(CURVES).index(goal)) & (apart.amin(dim=1) < 0.4)


DOMAIN = Domain(
    name=NAME,
    plans=PLANS,
    concepts=Concepts(TRAINING, few_shot_suites(TRAINING, NEW)),
    source=lambda root: Generated(NAME, PLANS, TRAINING, draw),
    metrics={"accuracy": Metric(recognised)},
)
