"""Cosine transform of plans over time with a scale per coefficient, which keeps plans of learned concepts smooth."""

import math
from functools import cache

import torch
from torch import Tensor, nn

from ftl_lightning.services.errors import require

LEAST = 1e-6
"""Minimum standard deviation relative to the largest; coefficients below are constant."""


MOST_COSINES = 2048
"""Maximum number of states in a plan that is transformed; the transform's matrix has its square."""


def check_cosines(horizon: int, user: str) -> None:
    """Refuse plans that are too long for a cosine transform; ``user`` names what needs it in the ``UserError``."""
    require(horizon <= MOST_COSINES, "horizon", f"at most {MOST_COSINES} states for {user}", f"{horizon}; set data.horizon")


@cache
def cosines(count: int) -> Tensor:
    """Orthonormal discrete cosine transform (type II), ``(cosine, time)`` in double precision; its inverse is its transpose."""
    number = torch.arange(count, dtype=torch.float64, device="cpu")  # explicit CPU, as the result is cached
    basis = torch.cos(math.pi / count * number[:, None] * (number + 0.5)) * (2 / count) ** 0.5
    basis[0] /= 2**0.5
    return basis


class Spectrum(nn.Module):
    """Inverse cosine transform over time (orthonormal DCT-II), from coefficients to plans.

    The network's error is about equal for every output. If the outputs are states, plans of new concepts are jagged. Here the
    outputs are coefficients in units of their standard deviation in pretraining: high frequencies, which are rare in smooth
    behaviour, have small errors.

    Args:
        horizon: number of states in a plan.
        state_dim: columns of a state.

    Attributes:
        mean, scale: mean and scale of the coefficients ``(horizon, state)`` of normalised plans; 0 and 1 until :meth:`fit`.
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
        """Fit means and scales to normalised plans of pretraining ``(plan, horizon, state)``."""
        coefficients = torch.einsum("ct,pts->pcs", self.basis, plans)
        spread = coefficients.std(dim=0, correction=0)
        varies = spread > LEAST * spread.max()
        self.mean.copy_(coefficients.mean(dim=0))
        self.scale.copy_(torch.where(varies, spread, 0))

    def forward(self, out: Tensor) -> Tensor:
        """Map outputs (a coefficient per cosine and column) to plans ``(batch, horizon, state)``."""
        return torch.einsum("ct,bcs->bts", self.basis, self.mean + self.scale * out)
