"""Diffusion (section 4.1 of the paper): schedule, forward process, denoising loss (Eq. 1), and prediction targets of a network."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from ftl_lightning.services.errors import require
from ftl_lightning.services.spectrum import Spectrum

Context = tuple[Tensor, ...]
"""Encoded observed features, such as the initial state ``s_0``: tensors ``(batch, ...)``; empty without observed features."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""Noise estimate ``(x (batch, horizon, state), t (batch,), concepts (concept, knots, n), index (batch,), context) -> noise`` in
the shape of ``x``, where ``index`` is each sample's row of ``concepts``."""

LARGEST_POWER = 100.0
"""Maximum power of :func:`timesteps`; a larger power gives almost only timestep T - 1."""
MOST_STEPS = 100_000
"""Maximum length T of a schedule."""
PREDICTIONS = ("epsilon", "v", "clean", "displacement", "cosines")
"""Prediction targets of a network, see :class:`Prediction`; ``'epsilon'``, the noise, is the paper's."""
LOSSES = PREDICTIONS[:3]
"""Quantities whose squared error is the loss, see :func:`loss_weights`; ``'epsilon'`` is the paper's."""


def cosine_alpha_bar(steps: int, offset: float = 0.008, beta_max: float = 0.999) -> Tensor:
    """Cosine schedule ``abar_t = cos^2(pi/2 (t/T + s) / (1 + s))``, up to a factor (Nichol & Dhariwal, 2021).

    Args:
        steps: number T of diffusion steps.
        offset: s.
        beta_max: maximum variance beta of a single step.

    Returns:
        ``abar (T,)`` float32, the cumulative product of ``1 - beta``; index 0 is the least noisy timestep.
    """
    # Explicit CPU: arithmetic on the meta device makes torch import its compiler.
    time = torch.arange(steps + 1, dtype=torch.float64, device="cpu") / steps
    unclipped = torch.cos((time + offset) / (1 + offset) * math.pi / 2) ** 2
    beta = (1 - unclipped[1:] / unclipped[:-1]).clamp(max=beta_max)
    return torch.cumprod(1 - beta, dim=0).float()


def timesteps(u: Tensor, steps: int, power: float) -> Tensor:
    """Timesteps ``T u`` for power 1, uniform as in the paper, else ``T (1 - u^power)``; a higher power gives noisier timesteps.

    Args:
        u: random numbers, uniform in [0, 1).
        steps: number T of diffusion steps.
        power: 1 or more; with 3 half of the timesteps are in the noisiest eighth, with 10 in the noisiest fifteenth.

    Returns:
        int64 from 0 to T - 1, in the shape of ``u``.
    """
    if power != 1:
        u = 1 - u**power
    return (u * steps).long().clamp(max=steps - 1)


def _per_sample(values: Tensor, like: Tensor) -> Tensor:
    """Reshape ``(batch,)`` to broadcast against ``like (batch, ...)``."""
    return values.reshape(-1, *(1,) * (like.dim() - 1))


def add_noise(clean: Tensor, noise: Tensor, alpha_bar: Tensor) -> Tensor:
    """Forward process ``x_t = sqrt(abar_t) x_0 + sqrt(1 - abar_t) eps`` (section 4.1).

    Args:
        clean, noise: ``x_0`` and eps ``(batch, horizon, state)``.
        alpha_bar: ``(batch,)`` or scalar.
    """
    alpha_bar = _per_sample(alpha_bar, clean)
    return alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * noise


def clean_from_epsilon(noisy: Tensor, epsilon: Tensor, alpha_bar: Tensor, clip: float | None = 1.0) -> Tensor:
    """Clean data ``x_0 = (x_t - sqrt(1 - abar_t) eps) / sqrt(abar_t)`` from a noise estimate.

    Args:
        noisy, epsilon: ``x_t`` and eps ``(batch, horizon, state)``.
        alpha_bar: ``(batch,)`` or scalar.
        clip: bound on the absolute value (data are normalised to [-1, 1]); ``None`` for no bound.
    """
    alpha_bar = _per_sample(alpha_bar, noisy)
    clean = (noisy - (1 - alpha_bar).sqrt() * epsilon) / alpha_bar.sqrt()
    return clean if clip is None else clean.clamp(-clip, clip)


def denoising_loss(
    epsilon: Callable[[Tensor, Tensor], Tensor], clean: Tensor, noise: Tensor, t: Tensor, alpha_bar: Tensor, discount: float = 1.0
) -> Tensor:
    """Denoising loss ``|eps - eps_theta(x_t, t)|^2`` of each sample (Eq. 1; with the composed noise estimate, Eq. 2).

    Args:
        epsilon: noise estimate ``(x, t) -> noise``.
        clean, noise: ``x_0`` and eps ``(batch, horizon, state)``.
        t: timesteps ``(batch,)`` int64.
        alpha_bar: schedule ``(T,)``.
        discount: see :func:`state_weights` (Janner et al., 2022).

    Returns:
        ``(batch,)``, the mean over the states of a plan and their columns.
    """
    squared = (epsilon(add_noise(clean, noise, alpha_bar[t]), t) - noise).square()
    return (squared * state_weights(discount, clean)).mean(dim=(1, 2))


def state_weights(discount: float, clean: Tensor) -> Tensor:
    """Weights ``discount ** k`` of the states of plans ``(batch, horizon, state)``, with mean 1: ``(horizon, 1)``."""
    weights = float(discount) ** torch.arange(clean.shape[1], device=clean.device)[:, None]
    return weights / weights.mean()


def loss_weights(kind: str, alpha_bar: Tensor) -> Tensor:
    """Timestep weights ``(T,)`` that convert the squared error of the noise into that of ``kind``, see :class:`Prediction`.

    An error d of the noise is an error ``d sqrt((1 - abar_t) / abar_t)`` of ``'clean'`` and ``d / sqrt(abar_t)`` of ``'v'``.

    Raises:
        UserError: if ``kind`` is not in :data:`LOSSES`.
    """
    require(kind in LOSSES, "loss", f"one of {', '.join(LOSSES)}", repr(kind))
    if kind == "epsilon":
        return torch.ones_like(alpha_bar)
    return 1 / alpha_bar if kind == "v" else (1 - alpha_bar) / alpha_bar


class Prediction(nn.Module):
    """Denoiser whose network predicts another quantity than the noise; the prediction is converted into a noise estimate.

    ``'v'`` is the velocity ``sqrt(abar_t) eps - sqrt(1 - abar_t) x_0`` (Salimans & Ho, 2022), ``'clean'`` is ``x_0``,
    ``'displacement'`` is ``x_0`` minus the plan's initial state, and ``'cosines'`` are the coefficients of a cosine transform of
    ``x_0`` over time, see :class:`~ftl_lightning.services.spectrum.Spectrum`. Clean plans are smooth and noise is not: a network
    that downsamples its input learns clean plans in a fraction of the steps. Displacements make the first states of a plan, which
    are executed in closed loop, the most exact: the network need not copy the initial state.

    Args:
        net: network.
        kind: ``'v'``, ``'clean'``, ``'displacement'`` or ``'cosines'``.
        diffusion_steps: number T of diffusion steps.
        state_columns: columns of the observed vector that hold the plan's initial state, on the plan's scale.
        spectrum: cosine transform for ``'cosines'``; ``None`` for the other kinds.

    Raises:
        UserError: for ``'displacement'`` without ``state_columns``.
    """

    alpha_bar: Tensor

    def __init__(
        self, net: nn.Module, kind: str, diffusion_steps: int, state_columns: Sequence[int] = (), spectrum: Spectrum | None = None
    ) -> None:
        super().__init__()
        known = kind != "displacement" or state_columns
        require(known, "prediction", "clean", "displacement: what this domain observes holds no state")
        self.net, self.kind, self.state_columns, self.spectrum = net, kind, list(state_columns), spectrum
        self.register_buffer("alpha_bar", cosine_alpha_bar(diffusion_steps), persistent=False)

    def observe(self, vector: Tensor | None) -> Context:
        """Encode observed vectors ``(batch, feature)``; for ``'displacement'`` the initial state comes first."""
        context: Context = self.net.observe(vector)  # type: ignore[operator]
        if self.kind != "displacement":
            return context
        assert vector is not None
        return (vector[:, self.state_columns], *context)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context = ()) -> Tensor:
        """Estimate the noise, see :data:`Denoiser`."""
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
