"""What a denoiser's network puts out: the noise itself, or something from which the noise follows."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ftl_lightning.concepts.branches import Context
from ftl_lightning.diffusion.schedule import cosine_alpha_bar
from ftl_lightning.diffusion.spectrum import Spectrum
from ftl_lightning.errors import UserError

PREDICTIONS = ("epsilon", "v", "clean", "displacement", "cosines")
LOSSES = PREDICTIONS[:3]


class Prediction(nn.Module):
    """A denoiser whose network does not estimate the noise; the noise is computed from what it estimates.

    ``'v'`` is the velocity ``sqrt(abar) eps - sqrt(1 - abar) x_0`` (Salimans & Ho, 2022), ``'clean'`` is ``x_0``,
    ``'displacement'`` is ``x_0`` less the state that the plan starts from. Clean plans are smooth, noise is not: a network that
    halves its input several times learns the one in a fraction of the steps. The displacement needs no copy of where the plan
    starts, which a network blurs: the first states, which are those executed in closed loop, are the most exact. ``'cosines'`` are
    those that ``x_0`` consists of over time, see :class:`~ftl_lightning.diffusion.spectrum.Spectrum`.

    Args:
        net: a denoiser.
        kind: ``'v'``, ``'clean'``, ``'displacement'`` or ``'cosines'``.
        diffusion_steps: T.
        state_columns: columns of the observed vectors that hold the state a plan starts from, on the plan's scale.
        spectrum: of plans, for cosines; ``None`` for all others.

    Raises:
        UserError: for a displacement where they hold no state.
    """

    alpha_bar: Tensor

    def __init__(
        self, net: nn.Module, kind: str, diffusion_steps: int, state_columns: Sequence[int] = (), spectrum: Spectrum | None = None
    ) -> None:
        super().__init__()
        if kind == "displacement" and not state_columns:
            raise UserError("prediction: expected clean, found displacement: what this domain observes holds no state")
        self.net, self.kind, self.state_columns, self.spectrum = net, kind, list(state_columns), spectrum
        self.register_buffer("alpha_bar", cosine_alpha_bar(diffusion_steps), persistent=False)

    def observe(self, vector: Tensor | None) -> Context:
        """As the network, with the state that plans start from before it, if they are displacements."""
        context: Context = self.net.observe(vector)  # type: ignore[operator]
        if self.kind != "displacement":
            return context
        assert vector is not None
        return (vector[:, self.state_columns], *context)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context = ()) -> Tensor:
        """Estimated noise, as :data:`ftl_lightning.concepts.branches.Denoiser` says."""
        alpha_bar = self.alpha_bar[t][:, None, None]
        start, context = (context[0], context[1:]) if self.kind == "displacement" else (None, context)
        out: Tensor = self.net(x, t, concepts, index, context)
        if self.kind == "v":
            return alpha_bar.sqrt() * out + (1 - alpha_bar).sqrt() * x
        if self.spectrum is not None:
            out = self.spectrum(out)
        if start is not None:
            out = out + start[:, None]
        return (x - alpha_bar.sqrt() * out) / (1 - alpha_bar).sqrt()


def loss_weights(kind: str, alpha_bar: Tensor) -> Tensor:
    """Weights of the timesteps ``(T,)`` that turn the squared error of the noise into that of what ``kind`` names.

    Raises:
        UserError: for a kind that is none of :data:`LOSSES`.
    """
    if kind not in LOSSES:
        raise UserError(f"loss: expected one of {', '.join(LOSSES)}, found {kind!r}")
    if kind == "epsilon":
        return torch.ones_like(alpha_bar)
    return 1 / alpha_bar if kind == "v" else (1 - alpha_bar) / alpha_bar
