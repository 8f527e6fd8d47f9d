"""Plans as cosines over time, each on a scale of its own: what is smooth in pretraining stays smooth in what is learned."""

import math
from functools import cache

import torch
from torch import Tensor, nn

LEAST = 1e-6
"""Of the largest spread; a cosine that varies less is taken to be constant."""


@cache
def cosines(count: int) -> Tensor:
    """Orthonormal discrete cosine transform (type II), ``(cosine, time)`` in double precision; its inverse is its transpose."""
    number = torch.arange(count, dtype=torch.float64, device="cpu")  # wherever a network is being made, as this is kept
    basis = torch.cos(math.pi / count * number[:, None] * (number + 0.5)) * (2 / count) ** 0.5
    basis[0] /= 2**0.5
    return basis


class Spectrum(nn.Module):
    """Turns coefficients of cosines over time (orthonormal DCT-II) into plans.

    A network errs by about as much in each number that it puts out. Where the numbers are states, neighbours err as much as states
    far apart, so that plans of concepts which pretraining did not show are jagged. Here a coefficient is put out in units of its
    spread in pretraining: fast cosines, which hardly occur in smooth behaviour, err little.

    Args:
        horizon: states in a plan.
        state_dim: columns of a state.

    Attributes:
        mean, scale: of the coefficients ``(horizon, state)``, on the plans' normalised scale; 0 and 1 until :meth:`fit`.
    """

    basis: Tensor
    mean: Tensor
    scale: Tensor

    def __init__(self, horizon: int, state_dim: int) -> None:
        super().__init__()
        self.register_buffer("basis", cosines(horizon).float(), persistent=False)
        self.register_buffer("mean", torch.zeros(horizon, state_dim))
        self.register_buffer("scale", torch.ones(horizon, state_dim))

    @torch.no_grad()
    def fit(self, plans: Tensor) -> None:
        """Take means and scales from plans of pretraining ``(plan, horizon, state)``, normalised."""
        coefficients = torch.einsum("ct,pts->pcs", self.basis, plans)
        spread = coefficients.std(dim=0, correction=0)
        varies = spread > LEAST * spread.max()
        self.mean.copy_(coefficients.mean(dim=0))
        self.scale.copy_(torch.where(varies, spread, 0))

    def forward(self, out: Tensor) -> Tensor:
        """Plans ``(batch, horizon, state)`` of what a network puts out, a number for each cosine and column."""
        return torch.einsum("ct,bcs->bts", self.basis, self.mean + self.scale * out)
