"""What a denoiser's network puts out: the noise itself, or the velocity or the clean plan, from which the noise follows."""

import torch
from torch import Tensor, nn

from ftl_lightning.diffusion.schedule import cosine_alpha_bar
from ftl_lightning.errors import UserError

PREDICTIONS = ("epsilon", "v", "clean")


class Prediction(nn.Module):
    """A denoiser whose network does not estimate the noise; the noise is computed from what it estimates.

    ``'v'`` is the velocity ``sqrt(abar) eps - sqrt(1 - abar) x_0`` (Salimans & Ho, 2022), ``'clean'`` is ``x_0``. Clean plans are
    smooth, noise is not: a network that halves its input several times learns the one in a fraction of the steps.

    Args:
        net: a denoiser.
        kind: ``'v'`` or ``'clean'``.
        diffusion_steps: T.
    """

    alpha_bar: Tensor

    def __init__(self, net: nn.Module, kind: str, diffusion_steps: int) -> None:
        super().__init__()
        self.net, self.kind = net, kind
        self.register_buffer("alpha_bar", cosine_alpha_bar(diffusion_steps), persistent=False)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, initial_state: Tensor | None = None) -> Tensor:
        """Estimated noise, as :data:`ftl_lightning.concepts.composition.Denoiser` says."""
        alpha_bar = self.alpha_bar[t][:, None, None]
        out: Tensor = self.net(x, t, concepts, index, initial_state)
        if self.kind == "v":
            return alpha_bar.sqrt() * out + (1 - alpha_bar).sqrt() * x
        return (x - alpha_bar.sqrt() * out) / (1 - alpha_bar).sqrt()


def loss_weights(kind: str, alpha_bar: Tensor) -> Tensor:
    """Weights of the timesteps ``(T,)`` that turn the squared error of the noise into that of what ``kind`` names.

    Raises:
        UserError: for a kind that is none of :data:`PREDICTIONS`.
    """
    if kind not in PREDICTIONS:
        raise UserError(f"prediction, loss: expected one of {', '.join(PREDICTIONS)}, found {kind!r}")
    if kind == "epsilon":
        return torch.ones_like(alpha_bar)
    return 1 / alpha_bar if kind == "v" else (1 - alpha_bar) / alpha_bar
