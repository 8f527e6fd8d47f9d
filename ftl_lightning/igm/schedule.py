"""Forward process: schedule, adding noise, clean data from a noise estimate, denoising loss."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

LARGEST_POWER = 100.0
"""Maximum power of :func:`timesteps`: with more, all timesteps would be T - 1."""
MOST_STEPS = 100_000
"""Maximum length T of a schedule."""


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
    epsilon: Callable[[Tensor, Tensor], Tensor],
    clean: Tensor,
    noise: Tensor,
    t: Tensor,
    alpha_bar: Tensor,
    discount: float = 1.0,
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
