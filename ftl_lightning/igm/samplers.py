"""Samplers: functions of a noise estimate with a common signature.

``epsilon(x, t)`` maps ``x (batch, horizon, state)`` and ``t (batch,)`` int64 to the estimated noise; usually it is
:func:`ftl_lightning.igm.guidance.composed_epsilon`. ``alpha_bar (T,)`` is the schedule of pretraining. ``steps <= T`` are
evenly spaced on it. ``temperature`` is the paper's alpha, a factor of the variance of the initial noise and of all noise added
later. ``noise()`` draws standard normal noise ``(batch, horizon, state)`` and is the only source of randomness.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ftl_lightning.igm.diffusion import clean_from_epsilon
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.validation import check_count, check_factor

Epsilon = Callable[[Tensor, Tensor], Tensor]
Noise = Callable[[], Tensor]


class Sampler(Protocol):
    """Common signature; returns ``(batch, horizon, state)`` in normalised units."""

    def __call__(self, epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float) -> Tensor: ...


def timesteps(total: int, steps: int) -> list[int]:
    """``steps`` evenly spaced timesteps from ``total - 1`` down to 0.

    Raises:
        ValueError: unless ``1 <= steps <= total``.
    """
    if not 1 <= steps <= total:
        raise ValueError(f"steps: expected 1 to {total} (the schedule's length), found {steps}")
    return [round(float(t)) for t in torch.linspace(total - 1, 0, steps, dtype=torch.float64)]


def _clean(epsilon: Epsilon, x: Tensor, t: int, alpha_bar: Tensor) -> Tensor:
    return clean_from_epsilon(x, epsilon(x, torch.full((len(x),), t, device=x.device)), alpha_bar[t])


@torch.no_grad()
def ddpm(epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float) -> Tensor:
    """Ancestral sampling (Ho et al., 2020) on a subset of the timesteps; the paper's sampler for ``steps = T``."""
    x = temperature**0.5 * noise()
    visited = timesteps(len(alpha_bar), steps)
    for t, before in zip(visited, [*visited[1:], None], strict=True):
        clean = _clean(epsilon, x, t, alpha_bar)
        if before is None:
            return clean
        ratio = alpha_bar[t] / alpha_bar[before]
        spread = 1 - alpha_bar[t]
        mean = (alpha_bar[before].sqrt() * (1 - ratio) * clean + ratio.sqrt() * (1 - alpha_bar[before]) * x) / spread
        variance = (1 - ratio) * (1 - alpha_bar[before]) / spread
        x = mean + (temperature * variance).sqrt() * noise()
    raise AssertionError("timesteps is never empty")


@torch.no_grad()
def ddim(epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float) -> Tensor:
    """DDIM (Song et al., 2021, eta = 0): deterministic given the initial noise."""
    x = temperature**0.5 * noise()
    visited = timesteps(len(alpha_bar), steps)
    for t, before in itertools.pairwise(visited):
        clean = _clean(epsilon, x, t, alpha_bar)
        implied = (x - alpha_bar[t].sqrt() * clean) / (1 - alpha_bar[t]).sqrt()
        x = alpha_bar[before].sqrt() * clean + (1 - alpha_bar[before]).sqrt() * implied
    return _clean(epsilon, x, visited[-1], alpha_bar)


@torch.no_grad()
def dpm_solver(epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float) -> Tensor:
    """DPM-Solver++ (2M) (Lu et al., 2022): second order, data prediction, deterministic given the initial noise."""
    x = temperature**0.5 * noise()
    visited = timesteps(len(alpha_bar), steps)
    scale, sigma = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
    half_log_snr = scale.log() - sigma.log()
    previous: tuple[Tensor, Tensor] | None = None  # clean estimate and length in half log-SNR of the last step
    for t, before in itertools.pairwise(visited):
        clean = _clean(epsilon, x, t, alpha_bar)
        step = half_log_snr[before] - half_log_snr[t]
        estimate = clean
        if previous is not None:
            estimate = clean + step / (2 * previous[1]) * (clean - previous[0])
        x = sigma[before] / sigma[t] * x - scale[before] * torch.expm1(-step) * estimate
        previous = clean, step
    return _clean(epsilon, x, visited[-1], alpha_bar)


SAMPLERS: dict[str, Sampler] = {"ddpm": ddpm, "ddim": ddim, "dpm_solver": dpm_solver}


@dataclass(frozen=True)
class Sampling:
    """Sampler settings.

    Attributes:
        sampler: key of :data:`SAMPLERS`.
        steps: number of sampler steps, from 1 to the model's T.
        temperature: the paper's alpha, 0 or more; lower is more accurate and less diverse.

    Raises:
        UserError: at construction, for an invalid value.
    """

    sampler: str = "ddpm"
    steps: int = 100
    temperature: float = 0.1

    def __post_init__(self) -> None:
        if self.sampler not in SAMPLERS:
            raise UserError(f"sampler: expected one of {', '.join(SAMPLERS)}, found {self.sampler!r}")
        if self.steps < 1:
            raise UserError(f"steps: expected 1 or more, found {self.steps}")
        if not 0 <= self.temperature < math.inf:
            raise UserError(f"temperature: expected 0 or more, found {self.temperature}")
        check_factor("temperature", self.temperature, 0)
        check_count("steps", self.steps, 1)

    def run(self, epsilon: Epsilon, noise: Noise, alpha_bar: Tensor) -> Tensor:
        """Sample clean normalised plans ``(batch, horizon, state)``; arguments as in :class:`Sampler`."""
        return SAMPLERS[self.sampler](epsilon, noise, alpha_bar, self.steps, self.temperature)
