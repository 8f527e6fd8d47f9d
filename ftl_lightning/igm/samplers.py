"""Samplers: the reverse process from noise ``x_T`` to a plan ``x_0``, for any noise estimate (section 4.3 of the paper).

Each sampler has the arguments ``epsilon``, noise estimate ``(x (batch, horizon, state), t (batch,) int64) -> noise``, usually
:func:`~ftl_lightning.igm.guidance.composed_epsilon`; ``noise``, which draws standard normal noise ``(batch, horizon, state)`` and
is the only source of randomness; ``alpha_bar (T,)``, the schedule of pretraining; ``steps``, the number of timesteps visited,
from 1 to T; ``temperature``, the paper's alpha, a factor of the variance of the initial noise and of all later noise; ``pinned``,
states that a plan has to pass, see :class:`~ftl_lightning.data.deformation.Pinned`.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ftl_lightning.data.deformation import Pinned
from ftl_lightning.igm.diffusion import clean_from_epsilon
from ftl_lightning.services.errors import require
from ftl_lightning.services.validation import check_count, check_factor

Epsilon = Callable[[Tensor, Tensor], Tensor]
Noise = Callable[[], Tensor]


class Sampler(Protocol):
    """Signature of a sampler; returns normalised plans ``x_0 (batch, horizon, state)``."""

    def __call__(
        self, epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float, pinned: Pinned | None = None
    ) -> Tensor: ...


def sampler_timesteps(total: int, steps: int) -> list[int]:
    """Timesteps visited by a sampler: ``steps`` evenly spaced ones from ``total - 1`` down to 0; a single one is ``total - 1``.

    Raises:
        ValueError: unless ``1 <= steps <= total``.
    """
    if not 1 <= steps <= total:
        raise ValueError(f"steps: expected 1 to {total} (the schedule's length), found {steps}")
    return [round(float(t)) for t in torch.linspace(total - 1, 0, steps, dtype=torch.float64)]


def _clean(epsilon: Epsilon, x: Tensor, t: int, alpha_bar: Tensor, pinned: Pinned | None) -> Tensor:
    """Estimate of the clean plans ``x_0`` at timestep ``t``, clipped to [-1, 1] and conditioned on the pinned states."""
    clean = clean_from_epsilon(x, epsilon(x, torch.full((len(x),), t, device=x.device)), alpha_bar[t])
    return clean if pinned is None else pinned(clean)


@torch.no_grad()
def ddpm(epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float, pinned: Pinned | None = None) -> Tensor:
    """Ancestral sampling (Ho et al., 2020, Eq. 7) on a subset of the timesteps; the paper's sampler for ``steps = T``."""
    x = temperature**0.5 * noise()
    visited = sampler_timesteps(len(alpha_bar), steps)
    for t, following in itertools.pairwise(visited):
        clean = _clean(epsilon, x, t, alpha_bar, pinned)
        alpha = alpha_bar[t] / alpha_bar[following]  # 1 - beta of the step
        beta_bar = 1 - alpha_bar[t]
        mean = (alpha_bar[following].sqrt() * (1 - alpha) * clean + alpha.sqrt() * (1 - alpha_bar[following]) * x) / beta_bar
        variance = (1 - alpha) * (1 - alpha_bar[following]) / beta_bar
        x = mean + (temperature * variance).sqrt() * noise()
    return _clean(epsilon, x, visited[-1], alpha_bar, pinned)


@torch.no_grad()
def ddim(epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float, pinned: Pinned | None = None) -> Tensor:
    """DDIM (Song et al., 2021, Eq. 12 with eta = 0): deterministic given the initial noise."""
    x = temperature**0.5 * noise()
    visited = sampler_timesteps(len(alpha_bar), steps)
    for t, following in itertools.pairwise(visited):
        clean = _clean(epsilon, x, t, alpha_bar, pinned)
        predicted_noise = (x - alpha_bar[t].sqrt() * clean) / (1 - alpha_bar[t]).sqrt()  # of the clipped clean plan
        x = alpha_bar[following].sqrt() * clean + (1 - alpha_bar[following]).sqrt() * predicted_noise
    return _clean(epsilon, x, visited[-1], alpha_bar, pinned)


@torch.no_grad()
def dpm_solver(
    epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, steps: int, temperature: float, pinned: Pinned | None = None
) -> Tensor:
    """DPM-Solver++(2M) (Lu et al., 2022): second-order multistep solver, deterministic given the initial noise."""
    x = temperature**0.5 * noise()
    visited = sampler_timesteps(len(alpha_bar), steps)
    scale, sigma = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
    half_log_snr = scale.log() - sigma.log()
    previous: tuple[Tensor, Tensor] | None = None  # clean plans and length in half log-SNR of the last step
    for t, following in itertools.pairwise(visited):
        clean = _clean(epsilon, x, t, alpha_bar, pinned)
        step = half_log_snr[following] - half_log_snr[t]
        estimate = clean
        if previous is not None:
            estimate = clean + step / (2 * previous[1]) * (clean - previous[0])
        x = sigma[following] / sigma[t] * x - scale[following] * torch.expm1(-step) * estimate
        previous = clean, step
    return _clean(epsilon, x, visited[-1], alpha_bar, pinned)


SAMPLERS: dict[str, Sampler] = {"ddpm": ddpm, "ddim": ddim, "dpm_solver": dpm_solver}


@dataclass(frozen=True)
class Sampling:
    """Sampler settings.

    Attributes:
        sampler: key of :data:`SAMPLERS`.
        steps: number of sampler steps, from 1 to the model's T.
        temperature: the paper's alpha, 0 or more; lower gives more accurate and less diverse plans.

    Raises:
        UserError: at construction, for an invalid value.
    """

    sampler: str = "ddpm"
    steps: int = 100
    temperature: float = 0.1

    def __post_init__(self) -> None:
        require(self.sampler in SAMPLERS, "sampler", f"one of {', '.join(SAMPLERS)}", repr(self.sampler))
        require(self.steps >= 1, "steps", "1 or more", self.steps)
        require(0 <= self.temperature < math.inf, "temperature", "0 or more", self.temperature)
        check_factor("temperature", self.temperature, 0)
        check_count("steps", self.steps, 1)

    def run(self, epsilon: Epsilon, noise: Noise, alpha_bar: Tensor, pinned: Pinned | None = None) -> Tensor:
        """Sample normalised plans ``(batch, horizon, state)``; the arguments are those of a :class:`Sampler`."""
        return SAMPLERS[self.sampler](epsilon, noise, alpha_bar, self.steps, self.temperature, pinned)
