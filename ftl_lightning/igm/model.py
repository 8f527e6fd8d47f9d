"""The conditional diffusion model of the paper, and the interface through which concepts are learned."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Origin
from ftl_lightning.igm.diffusion import Context, denoising_loss, loss_weights, timesteps
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import InversionSettings


class Draws(NamedTuple):
    """Timesteps ``(sample,)`` int64 and noise ``(sample, horizon, state)`` of diffusion."""

    t: Tensor
    noise: Tensor


class Invertible(Protocol):
    """A frozen model through which concepts are learned, see :class:`~ftl_lightning.training.concept_model.ConceptModel`.

    Attributes:
        training_embeddings: ``(training concept, n)``; their mean is the origin of the concept space.
    """

    training_embeddings: Tensor

    @property
    def device(self) -> torch.device:
        """Device of the model."""

    @property
    def hash(self) -> str:
        """Hash of the weights."""

    @property
    def window(self) -> int:
        """Number of states in a training window."""

    @property
    def horizon(self) -> int:
        """Number of states in a plan."""

    @property
    def max_steps(self) -> int | None:
        """Maximum number of sampler steps; ``None`` for any number."""

    @property
    def text_space(self) -> bool:
        """Whether the concept space is a text encoder's."""

    def check_settings(self, settings: InversionSettings) -> None:
        """Refuse settings that the model does not support."""

    def adaptable(self) -> Mapping[str, tuple[int, int]]:
        """Sizes ``(outputs, inputs)`` of the weights that an adapter can change, by name."""

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws | None:
        """Random numbers of :meth:`losses`, shared by all runs; ``None`` for a deterministic loss."""

    def windows(
        self, demonstrations: Demonstrations, rows: Tensor, share: Tensor, draw: torch.Generator
    ) -> tuple[Tensor, Observed]:
        """Training windows ``(row, window, state)`` and their observed features, on the model's device."""

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: str) -> Tensor:
        """Loss of Eq. 2 ``(run, sample)``."""

    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Behaviour ``(composition, count, horizon, state)``."""

    def encode(self, states: Tensor, observed: Observed) -> Tensor:
        """Normalised plans."""

    def origin(self, demonstrations: Demonstrations, name: str, weights: str, loss: float, pretrained: str = "") -> Origin:
        """Provenance of a concept learned through the model."""


class DiffusionModel(nn.Module):
    """Losses (Eq. 2) and samples of a conditional diffusion model, of normalised plans.

    Attributes:
        denoiser: noise estimate with a single concept per sample, an ``nn.Module`` with ``observe``.
        alpha_bar: schedule ``(T,)``.
        empty: unconditional embedding ``(n,)``.
        plan: shape ``(horizon, state)`` of a plan.
    """

    denoiser: nn.Module
    alpha_bar: Tensor
    empty: Tensor
    plan: tuple[int, int]

    @property
    def max_steps(self) -> int:
        """T, the maximum number of sampler steps."""
        return len(self.alpha_bar)

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws:
        """Draw noise and stratified timesteps ``T (1 - u^power)``, u uniform in [0, 1)."""
        device = draw.device
        spread = (torch.arange(samples, device=device) + torch.rand(samples, generator=draw, device=device)) / samples
        t = timesteps(spread, len(self.alpha_bar), timestep_power)[torch.randperm(samples, generator=draw, device=device)]
        return Draws(t, torch.randn((samples, *self.plan), generator=draw, device=device))

    def composed_losses(self, clean: Tensor, context: Context, composition: Composition, draws: Draws, loss: str) -> Tensor:
        """Loss of Eq. 2 ``(run, sample)``.

        Args:
            clean: plans ``(run * sample, horizon, state)``.
            context: encoded observed features of each plan.
            composition: ``(run, K, ...)``.
            draws: timesteps and noise of the samples, shared by all runs.
            loss: target of the squared error, see :func:`~ftl_lightning.igm.diffusion.loss_weights`.
        """
        runs = len(composition.embeddings)
        losses = denoising_loss(
            lambda x, t: composed_epsilon(self.denoiser, x, t, composition, self.empty, context),
            clean,
            draws.noise.repeat(runs, 1, 1),
            draws.t.repeat(runs),
            self.alpha_bar,
        )
        return losses.unflatten(0, (runs, -1)) * loss_weights(loss, self.alpha_bar)[draws.t]

    def composed_plans(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        context: Context,
    ) -> Tensor:
        """Sample plans ``(composition * count, horizon, state)`` with the composed denoiser.

        Args:
            compositions: ``(K, ...)`` each; K may differ.
            count: samples for each composition.
            generators: a noise generator for each composition.
            context: encoded observed features of each plan.
        """
        together, row = batched(compositions, count, generators)

        def epsilon(x: Tensor, t: Tensor) -> Tensor:
            return composed_epsilon(self.denoiser, x, t, together, self.empty, context, row)

        def noise() -> Tensor:
            # Draw on the generators' device: a seed gives the same samples on every device.
            drawn = [torch.randn((count, *self.plan), generator=draw, device=draw.device) for draw in generators]
            return torch.cat(drawn).to(self.alpha_bar.device)

        return sampling.run(epsilon, noise, self.alpha_bar)
