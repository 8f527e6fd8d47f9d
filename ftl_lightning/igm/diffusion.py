"""Diffusion: schedule, forward process, denoising loss (Eq. 1), and what a denoiser's network predicts."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from ftl_lightning.services.errors import require
from ftl_lightning.services.spectrum import Spectrum

Context = tuple[Tensor, ...]
"""Output of a condition encoder's ``observe``, each ``(batch, ...)``; empty without observed features."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, knots, n), index (batch,), context) -> noise like x``, where
``index`` is each sample's row of ``concepts``."""

LARGEST_POWER = 100.0
"""Maximum power of :func:`timesteps`: with more, all timesteps would be T - 1."""
MOST_STEPS = 100_000
"""Maximum length T of a schedule."""
PREDICTIONS = ("epsilon", "v", "clean", "displacement", "cosines")
LOSSES = PREDICTIONS[:3]


def cosine_alpha_bar(steps: int, offset: float = 0.008, beta_max: float = 0.999) -> Tensor:
    """Cosine schedule (Nichol & Dhariwal, 2021).

    Args:
        steps: T.
        offset: s in the source.
        beta_max: maximum variance of a single step.

    Returns:
        ``(T,)`` float32, the cumulative product of ``1 - beta``; index 0 is the least noisy.
    """
    # Explicit CPU: arithmetic on the meta device makes torch import its compiler.
    share = torch.arange(steps + 1, dtype=torch.float64, device="cpu") / steps
    edges = torch.cos((share + offset) / (1 + offset) * math.pi / 2) ** 2
    beta = (1 - edges[1:] / edges[:-1]).clamp(max=beta_max)
    return torch.cumprod(1 - beta, dim=0).float()


def timesteps(spread: Tensor, steps: int, power: float) -> Tensor:
    """Timesteps ``T (1 - u^power)``; a higher power gives noisier timesteps.

    Args:
        spread: u, uniform in [0, 1).
        steps: T.
        power: 1 for uniform timesteps (the paper's); with 3 half of the timesteps are in the noisiest eighth, with 10 in the
            noisiest fifteenth.

    Returns:
        int64, in the shape of ``spread``.
    """
    if power != 1:
        spread = 1 - spread**power
    return (spread * steps).long().clamp(max=steps - 1)


def _per_sample(values: Tensor, like: Tensor) -> Tensor:
    return values.reshape(-1, *(1,) * (like.dim() - 1))


def add_noise(clean: Tensor, noise: Tensor, alpha_bar: Tensor) -> Tensor:
    """``x_t = sqrt(abar_t) x_0 + sqrt(1 - abar_t) eps`` (section 3.1).

    Args:
        clean, noise: ``(batch, horizon, state)``.
        alpha_bar: ``(batch,)`` or scalar.
    """
    alpha_bar = _per_sample(alpha_bar, clean)
    return alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * noise


def clean_from_epsilon(noisy: Tensor, epsilon: Tensor, alpha_bar: Tensor, clip: float | None = 1.0) -> Tensor:
    """Clean data implied by a noise estimate; the inverse of :func:`add_noise` in its first argument.

    Args:
        noisy, epsilon: ``(batch, horizon, state)``.
        alpha_bar: ``(batch,)`` or scalar.
        clip: bound on the absolute value (data are normalised to [-1, 1]); ``None`` for no bound.
    """
    alpha_bar = _per_sample(alpha_bar, noisy)
    clean = (noisy - (1 - alpha_bar).sqrt() * epsilon) / alpha_bar.sqrt()
    return clean if clip is None else clean.clamp(-clip, clip)


def denoising_loss(
    epsilon: Callable[[Tensor, Tensor], Tensor], clean: Tensor, noise: Tensor, t: Tensor, alpha_bar: Tensor, discount: float = 1.0
) -> Tensor:
    """Squared error of the noise estimate, the integrand of Eq. 1 or, with composed noise, Eq. 2.

    Args:
        epsilon: ``(x, t) -> noise``.
        clean, noise: ``(batch, horizon, state)``.
        t: ``(batch,)`` int64.
        alpha_bar: schedule ``(T,)``.
        discount: state k of the window has weight ``discount ** k``, normalised to mean 1 (Janner et al., 2022).

    Returns:
        ``(batch,)``, the mean over horizon and state.
    """
    squared = (epsilon(add_noise(clean, noise, alpha_bar[t]), t) - noise).square()
    if discount != 1:
        weights = discount ** torch.arange(clean.shape[1], device=clean.device)
        squared = squared * (weights / weights.mean())[:, None]
    return squared.mean(dim=(1, 2))


def loss_weights(kind: str, alpha_bar: Tensor) -> Tensor:
    """Timestep weights ``(T,)`` that convert the squared error of the noise into the squared error of ``kind``.

    Raises:
        UserError: if ``kind`` is not in :data:`LOSSES`.
    """
    require(kind in LOSSES, "loss", f"one of {', '.join(LOSSES)}", repr(kind))
    if kind == "epsilon":
        return torch.ones_like(alpha_bar)
    return 1 / alpha_bar if kind == "v" else (1 - alpha_bar) / alpha_bar


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
        unknown = kind == "displacement" and not state_columns
        require(not unknown, "prediction", "clean", "displacement: what this domain observes holds no state")
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
        """Estimated noise, see :data:`Denoiser`."""
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
