"""Parametrisations of a denoiser: the network's output is the noise or a quantity that implies it."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ftl_lightning.igm.branches import Context
from ftl_lightning.igm.schedule import cosine_alpha_bar
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.spectrum import Spectrum

PREDICTIONS = ("epsilon", "v", "clean", "displacement", "cosines")
LOSSES = PREDICTIONS[:3]


class Prediction(nn.Module):
    """Denoiser whose network predicts another quantity than the noise.

    ``'v'`` is the velocity ``sqrt(abar) eps - sqrt(1 - abar) x_0`` (Salimans & Ho, 2022), ``'clean'`` is ``x_0``,
    ``'displacement'`` is ``x_0`` minus the plan's initial state. Clean plans are smooth, noise is not: a network that downsamples
    its input learns clean plans in a fraction of the steps. With displacements the network need not copy the initial state, which
    it would blur: the first states, executed in closed loop, are the most exact. ``'cosines'`` are the coefficients of ``x_0`` over
    time, see :class:`~ftl_lightning.services.spectrum.Spectrum`.

    Args:
        net: network.
        kind: ``'v'``, ``'clean'``, ``'displacement'`` or ``'cosines'``.
        diffusion_steps: T.
        state_columns: columns of the observed vectors with the plan's initial state, on the plan's scale.
        spectrum: spectrum of plans, for cosines; ``None`` otherwise.

    Raises:
        UserError: for displacements without ``state_columns``.
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
        """Context of the network; for displacements the initial state comes first."""
        context: Context = self.net.observe(vector)  # type: ignore[operator]
        if self.kind != "displacement":
            return context
        assert vector is not None
        return (vector[:, self.state_columns], *context)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context = ()) -> Tensor:
        """Estimated noise, see :data:`ftl_lightning.igm.branches.Denoiser`."""
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
    """Timestep weights ``(T,)`` that convert the squared error of the noise into the squared error of ``kind``.

    Raises:
        UserError: if ``kind`` is not in :data:`LOSSES`.
    """
    if kind not in LOSSES:
        raise UserError(f"loss: expected one of {', '.join(LOSSES)}, found {kind!r}")
    if kind == "epsilon":
        return torch.ones_like(alpha_bar)
    return 1 / alpha_bar if kind == "v" else (1 - alpha_bar) / alpha_bar
