"""Combinations of training concepts: Eq. 2 with the embeddings fixed to those of pretraining, so that only weights are learned.

With fixed embeddings the composed noise estimate is linear in the weights, and the loss of Eq. 2 is a quadratic function of them.
Its minimum needs no gradient descent: one evaluation of all branches gives the loss of every combination, and of every combination
learned from some of the demonstrations.
"""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.model import Invertible
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.services.randomness import generator

SAMPLES = 64
"""Noised windows of each demonstration."""
PENALTIES = (0.3, 0.1, 0.03, 0.01)
"""L1 penalties relative to the smallest that makes all weights 0, the largest first."""
ITERATIONS, CONVERGED = 1000, 1e-6
"""Maximum number of steps of the proximal gradient method, and largest change of a step, relative to the weights, that ends it."""
LEAST = 1e-3
"""Smallest weight of a combination, relative to the largest."""


@dataclass(frozen=True)
class Combination:
    """Weights of training concepts, and how well they explain demonstrations.

    Attributes:
        weights: ``(training concept,)`` float32 on the CPU; most are 0.
        loss: loss of the demonstrations (Eq. 2).
        own: the same, relative to their unconditional loss.
        left_out: the same of each demonstration ``(demo,)`` under weights learned from the others; ``None`` for a single one.
        folds: weights learned without each demonstration ``(demo, training concept)``; ``None`` for a single one.
        best: index of the training concept that explains the demonstrations best alone.
    """

    weights: Tensor
    loss: float
    own: float
    left_out: Tensor | None
    folds: Tensor | None
    best: int

    @classmethod
    @torch.no_grad()
    def of(cls, model: Invertible, demonstrations: Demonstrations, settings: InversionSettings) -> Self | None:
        """Minimise Eq. 2 plus an L1 penalty over the weights of all training concepts.

        The penalty is the largest whose leave-one-out loss is within one standard error of the lowest.

        Args:
            model: frozen model.
            demonstrations: demonstrations of one concept.
            settings: seed, kind of loss and timesteps.

        Returns:
            The combination; ``None`` for a model without composed denoiser.
        """
        draw = generator(model.device, settings.seed, 6)
        frames, products = model.frames_of(demonstrations), []
        for row in range(len(demonstrations)):
            draws = model.draws(SAMPLES, settings.loss.timestep_power, draw)
            share = torch.rand(SAMPLES, generator=draw, device=model.device).cpu()
            states, observed = model.windows(demonstrations, torch.full((SAMPLES,), row), share, draw)
            part = model.products(states, observed, frames, draws, settings.loss)
            if part is None:
                return None
            products.append(part.double().mean(dim=0).cpu())
        every = torch.stack(products)  # (demo, 1 + N, 1 + N)
        total = every.sum(dim=0)
        best = int((total.diagonal()[1:] - 2 * total[0, 1:]).argmin())
        if len(every) == 1:
            weights = _minimum(every, PENALTIES[1])
            loss = float(_losses(every, weights))
            return cls(weights[0].float(), loss, loss / float(every[0, 0, 0]), None, None, best)
        others = (total - every) / (len(every) - 1)
        empty = every[:, 0, 0]
        curve, folds = [], []
        for penalty in PENALTIES:
            folds.append(_minimum(others, penalty))
            curve.append(_losses(every, folds[-1]) / empty)
        left_out = torch.stack(curve)  # (penalty, demo)
        mean = left_out.mean(dim=1)
        lowest = int(mean.argmin())
        error = (left_out - left_out[lowest]).std(dim=1) / len(every) ** 0.5  # of differences: the demonstrations are the same
        chosen = int((mean - mean[lowest] <= error).nonzero()[0])
        weights = _minimum(total[None] / len(every), PENALTIES[chosen])
        loss = float(_losses(every, weights.expand(len(every), -1)).mean())
        return cls(weights[0].float(), loss, loss / float(empty.mean()), left_out[chosen].float(), folds[chosen].float(), best)


def _minimum(products: Tensor, penalty: float) -> Tensor:
    """Weights ``(problem, N)`` that minimise ``w A w - 2 b w + 2 penalty max|b| |w|_1`` (FISTA, Beck & Teboulle, 2009).

    Args:
        products: ``(problem, 1 + N, 1 + N)``, with b in the first row and A in the others.
    """
    b, a = products[:, 0, 1:], products[:, 1:, 1:]
    step = 1 / torch.linalg.matrix_norm(a, 2).clamp(min=1e-12)[:, None]
    threshold = step * penalty * b.abs().amax(dim=1, keepdim=True)
    weights = ahead = torch.zeros_like(b)
    momentum = 1.0
    for _ in range(ITERATIONS):
        moved = ahead + step * (b - torch.einsum("pij,pj->pi", a, ahead))
        new = moved.sign() * (moved.abs() - threshold).clamp(min=0)
        if float((new - weights).abs().max()) <= CONVERGED * float(new.abs().max()):
            weights = new
            break
        following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead, weights, momentum = new + (momentum - 1) / following * (new - weights), new, following
    return torch.where(weights.abs() > LEAST * weights.abs().amax(dim=1, keepdim=True), weights, 0)


def _losses(products: Tensor, weights: Tensor) -> Tensor:
    """Losses ``(problem,)`` of weights ``(problem, N)``."""
    linear = torch.einsum("pi,pi->p", products[:, 0, 1:], weights)
    return products[:, 0, 0] - 2 * linear + torch.einsum("pi,pij,pj->p", weights, products[:, 1:, 1:], weights)
