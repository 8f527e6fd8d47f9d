"""The samplers against diffusers' schedulers, on an epsilon that is known in closed form.

Tests import diffusers, not the module: it takes seconds, in every process that collects tests.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from ftl_lightning.igm.diffusion import add_noise, clean_from_epsilon, cosine_alpha_bar, denoising_loss
from ftl_lightning.igm.samplers import SAMPLERS, Sampling, ddim, ddpm, dpm_solver, sampler_timesteps
from ftl_lightning.services.errors import UserError

ALPHA_BAR = cosine_alpha_bar(100)
SHAPE = (400, 1, 2)
MEAN, DEVIATION = 0.2, 0.1


def exact(x: Tensor, t: Tensor) -> Tensor:
    """The optimal noise estimate for data from N(MEAN, DEVIATION^2)."""
    alpha_bar = ALPHA_BAR[t][:, None, None]
    variance = alpha_bar * DEVIATION**2 + 1 - alpha_bar
    return (1 - alpha_bar).sqrt() * (x - alpha_bar.sqrt() * MEAN) / variance


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def noise() -> Callable[[], Tensor]:
    return functools.partial(torch.randn, SHAPE, generator=generator())


def theirs(scheduler: Any, steps: list[int], noises: torch.Generator) -> Tensor:
    x = torch.randn(SHAPE, generator=noises)
    for t in steps:
        x = scheduler.step(exact(x, torch.full((len(x),), t)), t, x, generator=noises).prev_sample
    return x


def betas() -> Any:
    alpha = ALPHA_BAR / torch.cat((torch.ones(1), ALPHA_BAR[:-1]))
    return (1 - alpha).numpy()


def test_the_schedule_is_the_cosine_one_and_timesteps_cover_it() -> None:
    from diffusers import DDPMScheduler

    theirs = DDPMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2").alphas_cumprod
    assert torch.allclose(ALPHA_BAR, theirs, atol=1e-5)
    assert sampler_timesteps(100, 100) == list(range(99, -1, -1))
    assert sampler_timesteps(100, 12) == [99, 90, 81, 72, 63, 54, 45, 36, 27, 18, 9, 0]
    with pytest.raises(ValueError, match="expected 1 to 100"):
        sampler_timesteps(100, 101)


def test_ddpm_equals_diffusers() -> None:
    from diffusers import DDPMScheduler

    scheduler = DDPMScheduler(num_train_timesteps=100, trained_betas=betas(), variance_type="fixed_small", clip_sample_range=1.0)
    scheduler.set_timesteps(100)
    ours = ddpm(exact, noise(), ALPHA_BAR, 100, 1.0)
    assert torch.allclose(ours, theirs(scheduler, list(range(99, -1, -1)), generator()), atol=1e-4)


@pytest.mark.parametrize("steps", [10, 25, 100])
def test_ddim_equals_diffusers(steps: int) -> None:
    from diffusers import DDIMScheduler

    # Their spacing of few steps differs from ours at the ends, so each of our steps is given to them as a schedule of two.
    x = torch.randn(SHAPE, generator=generator())
    scheduler = DDIMScheduler(num_train_timesteps=100, trained_betas=betas(), clip_sample_range=1.0)
    scheduler.num_inference_steps = 100
    visited = sampler_timesteps(100, steps)
    for t, before in itertools.pairwise(visited):
        scheduler.alphas_cumprod = ALPHA_BAR[[before, t]]
        x = scheduler.step(exact(x, torch.full((len(x),), t)), 1, x).prev_sample
    x = clean_from_epsilon(x, exact(x, torch.full((len(x),), 0)), ALPHA_BAR[0])
    assert torch.allclose(ddim(exact, noise(), ALPHA_BAR, steps, 1.0), x, atol=1e-4)


@pytest.mark.parametrize("steps", [10, 20])
def test_dpm_solver_equals_diffusers(steps: int) -> None:
    from diffusers import DPMSolverMultistepScheduler

    scheduler = DPMSolverMultistepScheduler(
        num_train_timesteps=100, trained_betas=betas(), solver_order=2, lower_order_final=False, final_sigmas_type="zero"
    )
    scheduler.set_timesteps(steps)
    visited = torch.tensor(sampler_timesteps(100, steps))
    scheduler.timesteps = visited
    scheduler.sigmas = torch.cat((((1 - ALPHA_BAR) / ALPHA_BAR).sqrt()[visited], torch.zeros(1)))
    x = torch.randn(SHAPE, generator=generator())
    for t in visited:
        x = scheduler.step(exact(x, t.expand(len(x))), t, x).prev_sample
    assert torch.allclose(dpm_solver(exact, noise(), ALPHA_BAR, steps, 1.0), x, atol=1e-3)


@pytest.mark.parametrize("name", SAMPLERS)
def test_every_sampler_finds_the_distribution(name: str) -> None:
    samples = SAMPLERS[name](exact, noise(), ALPHA_BAR, 50, 1.0)
    assert samples.mean().item() == pytest.approx(MEAN, abs=0.02)
    assert samples.std().item() == pytest.approx(DEVIATION, abs=0.02)


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_seed_repeats_a_low_temperature_narrows_and_a_sampling_runs_with_its_own(name: str) -> None:
    first, again, cold = (SAMPLERS[name](exact, noise(), ALPHA_BAR, 20, alpha) for alpha in (1.0, 1.0, 0.1))
    assert torch.equal(first, again)
    assert cold.std() < 0.6 * first.std()
    assert torch.equal(Sampling(name, 12, 0.3).run(exact, noise(), ALPHA_BAR), SAMPLERS[name](exact, noise(), ALPHA_BAR, 12, 0.3))


def test_noise_can_be_taken_off_again() -> None:
    clean = torch.rand(5, 2, 3) * 2 - 1
    noise = torch.randn(5, 2, 3)
    alpha_bar = ALPHA_BAR[torch.tensor([0, 10, 50, 70, 80])]
    assert torch.allclose(clean_from_epsilon(add_noise(clean, noise, alpha_bar), noise, alpha_bar), clean, atol=1e-4)


def test_the_loss_of_the_true_noise_is_zero_and_a_discount_weighs_states_by_its_powers() -> None:
    noise = torch.randn(4, 1, 3)
    t = torch.tensor([0, 10, 50, 99])
    assert torch.equal(denoising_loss(lambda x, t: noise, torch.zeros(4, 1, 3), noise, t, ALPHA_BAR), torch.zeros(4))
    noise = torch.randn(2, 3, 2)
    one, t = torch.zeros_like(noise), torch.tensor([0, 50])
    alike = denoising_loss(lambda x, t: one, one, noise, t, ALPHA_BAR)
    half = denoising_loss(lambda x, t: one, one, noise, t, ALPHA_BAR, 0.5)
    each = noise.square().mean(dim=2)
    assert torch.allclose(alike, each.mean(dim=1))
    assert torch.allclose(half, (each * torch.tensor([1, 0.5, 0.25])).sum(dim=1) / 1.75)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sampler": "euler"}, "sampler: expected one of ddpm, ddim, dpm_solver, found 'euler'"),
        ({"steps": 0}, "steps: expected 1 or more, found 0"),
        ({"temperature": -0.1}, "temperature: expected 0 or more, found -0.1"),
        ({"temperature": float("nan")}, "temperature: expected 0 or more, found nan"),
        ({"temperature": float("inf")}, "temperature: expected 0 or more, found inf"),
    ],
)
def test_a_sampling_that_is_none_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Sampling(**options)
