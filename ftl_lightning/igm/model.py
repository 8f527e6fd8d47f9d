"""The conditional diffusion model of the paper, and the interface of models through which concepts are learned."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from ftl_lightning.data.deformation import Deformations, Pinned
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.data.places import Places
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Origin
from ftl_lightning.igm.diffusion import Context, add_noise, denoising_loss, loss_weights, state_weights, timesteps
from ftl_lightning.igm.guidance import branches, composed_epsilon
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import InversionSettings, Loss


class Draws(NamedTuple):
    """Diffusion timesteps ``t (sample,)`` int64 and standard normal noise ``(sample, horizon, state)``."""

    t: Tensor
    noise: Tensor


class Invertible(Protocol):
    """Frozen model through which concepts are learned; see :class:`~ftl_lightning.training.concept_model.ConceptModel`.

    Attributes:
        device, hash, window: device of the parameters, hash of the pretrained model, number of states in a training window.
        training_embeddings: embeddings of the training concepts ``(training concept, n)``, centred: their mean is 0.
        examples: demonstrations of training concepts, for a user's data; else ``None``.
        places: columns of each observed place that plans follow.
        frames: shares of the places in plans ``(training concept, place, horizon)``; ``None`` for a model without places.
    """

    training_embeddings: Tensor
    examples: Demonstrations | None
    places: Places
    frames: Tensor | None

    @property
    def variations(self) -> Deformations | None:
        """How normalised examples vary within training concepts; ``None`` if unknown."""

    @property
    def device(self) -> torch.device: ...

    @property
    def hash(self) -> str: ...

    @property
    def window(self) -> int: ...

    @property
    def horizon(self) -> int:
        """Number of states in a plan."""

    @property
    def max_steps(self) -> int | None:
        """Maximum number of sampler steps; ``None`` for any number."""

    @property
    def text_space(self) -> bool:
        """Whether concepts are embeddings of a text encoder."""

    def compositions(self, rows: slice | Tensor = slice(None)) -> Composition:
        """Training concepts, each with weight 1: ``(row, 1, ...)``."""

    def frames_of(self, demonstrations: Demonstrations) -> Tensor | None:
        """Frames of each concept of the demonstrations ``(concept, place, horizon)``; ``None`` for a model without places."""

    def check_settings(self, settings: InversionSettings) -> None:
        """Raise ``UserError`` for settings that the model does not support."""

    def adaptable(self, by_sample: bool = False) -> Mapping[str, tuple[int, int]]:
        """Sizes of the weights that an adapter can modify, see :func:`~ftl_lightning.igm.forms.adapter.adaptable`."""

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws | None:
        """Draw the timesteps and noise of :meth:`losses` for ``samples`` windows; ``None`` for a loss without noise."""

    def windows(
        self, demonstrations: Demonstrations, rows: Tensor, share: Tensor, draw: torch.Generator
    ) -> tuple[Tensor, Observed]:
        """Windows ``(row, window, state)`` of demonstrations ``rows (row,)`` and their observed features, on the model's device.

        ``share (row,)`` in [0, 1) is the relative start of each window, see ``Demonstrations.starts``.
        """

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: Loss) -> Tensor:
        """Loss of Eq. 2 ``(run, sample)`` of windows ``(run * sample, window, state)`` under compositions ``(run, K, ...)``."""

    def products(self, states: Tensor, observed: Observed, frames: Tensor | None, draws: Draws | None, loss: Loss) -> Tensor | None:
        """Products ``(sample, 1 + N, 1 + N)``, see :meth:`DiffusionModel.branch_products`, for windows ``(sample, window, state)``
        and ``frames (1, place, window)``; ``None`` for a model without a composed denoiser.
        """

    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Sample ``count`` plans of each composition: ``(composition, count, horizon, state)``, in the domain's units."""

    def encode(self, states: Tensor, observed: Observed) -> Tensor:
        """Normalise windows ``(batch, window, state)`` to plans ``(batch, horizon, state)``."""

    def origin(self, demonstrations: Demonstrations, name: str, weights: str, loss: float, pretrained: str = "") -> Origin:
        """Provenance of the learned concept ``name``; ``weights`` is ``'fixed'`` or ``'learned'``."""


class DiffusionModel(nn.Module):
    """Composed losses (Eq. 2) and samples of a conditional diffusion model of normalised plans.

    Attributes:
        denoiser: network ``eps_theta``, a :data:`~ftl_lightning.igm.diffusion.Denoiser` with a method ``observe``.
        alpha_bar: schedule ``(T,)``.
        empty: unconditional embedding ``(n,)``.
        plan: shape ``(horizon, state)`` of a plan.
    """

    denoiser: nn.Module
    alpha_bar: Tensor
    empty: Tensor
    plan: tuple[int, int]

    @property
    def max_steps(self) -> int | None:
        """Number T of diffusion steps."""
        return len(self.alpha_bar)

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws:
        """Draw noise and timesteps, see :func:`~ftl_lightning.igm.diffusion.timesteps`.

        Timesteps are stratified, which lowers the variance of the mean loss: one u in each of ``samples`` equal parts of [0, 1).
        """
        device = draw.device
        u = (torch.arange(samples, device=device) + torch.rand(samples, generator=draw, device=device)) / samples
        t = timesteps(u, len(self.alpha_bar), timestep_power)[torch.randperm(samples, generator=draw, device=device)]
        return Draws(t, torch.randn((samples, *self.plan), generator=draw, device=device))

    def composed_losses(self, clean: Tensor, context: Context, composition: Composition, draws: Draws, loss: Loss) -> Tensor:
        """Loss of Eq. 2 ``(run, sample)``.

        Args:
            clean: normalised plans ``(run * sample, horizon, state)``.
            context: encoded observed features of each plan.
            composition: batch of compositions, one per run: weights ``(run, K)``.
            draws: timesteps and noise of the samples, the same for all runs.
            loss: target of the squared error, and weights of the states.
        """
        runs = len(composition.embeddings)
        losses = denoising_loss(
            lambda x, t: composed_epsilon(self.denoiser, x, t, composition, self.empty, context),
            clean,
            draws.noise.repeat(runs, 1, 1),
            draws.t.repeat(runs),
            self.alpha_bar,
            loss.discount,
        )
        return losses.unflatten(0, (runs, -1)) * loss_weights(loss.kind, self.alpha_bar)[draws.t]

    @torch.no_grad()
    def branch_products(self, clean: Tensor, context: Context, embeddings: Tensor, draws: Draws, loss: Loss) -> Tensor:
        """Inner products of the error of the unconditional branch and of what N embeddings add to that branch (Eq. 2).

        The loss of a combination with weights w is ``|e - sum_k w_k d_k|^2``, where ``e = eps - eps(x, empty)`` and
        ``d_k = eps(x, c_k) - eps(x, empty)``: a quadratic function of w, whose coefficients are these products.

        Args:
            clean: normalised plans ``(sample, horizon, state)``.
            context: encoded observed features of each plan.
            embeddings: ``(N, n)``.
            draws, loss: see :meth:`composed_losses`.

        Returns:
            ``(sample, 1 + N, 1 + N)``: products of ``e, d_1 .. d_N`` with each other, means over the numbers of a plan.
        """
        x = add_noise(clean, draws.noise, self.alpha_bar[draws.t])
        concepts = torch.cat((self.empty[None], embeddings))[:, None]
        index = torch.arange(len(concepts), device=x.device)[:, None].expand(-1, len(x))
        estimates = branches(self.denoiser, x, draws.t, concepts, index, context)
        parts = torch.cat((draws.noise[None], estimates[1:])) - estimates[0]
        flat = (parts * state_weights(loss.discount, clean).sqrt()).flatten(2).transpose(0, 1)  # (sample, 1 + N, number)
        return flat @ flat.mT / flat.shape[2] * loss_weights(loss.kind, self.alpha_bar)[draws.t][:, None, None]

    def composed_plans(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        context: Context,
        pinned: Pinned | None = None,
    ) -> Tensor:
        """Sample normalised plans ``(composition * count, horizon, state)`` with the composed denoiser (section 4.3).

        Args:
            compositions, count: compositions with weights ``(K,)``, where K may differ; number of plans of each.
            sampling, generators: sampler, number of steps and temperature; random generator of each composition.
            context, pinned: encoded observed features, and known normalised states, of each plan; ``None`` for none.
        """
        batch, row = batched(compositions, count, generators)

        def epsilon(x: Tensor, t: Tensor) -> Tensor:
            return composed_epsilon(self.denoiser, x, t, batch, self.empty, context, row)

        def noise() -> Tensor:
            # Draw on the generators' device: a seed gives the same samples on every device.
            drawn = [torch.randn((count, *self.plan), generator=draw, device=draw.device) for draw in generators]
            return torch.cat(drawn).to(self.alpha_bar.device)

        return sampling.run(epsilon, noise, self.alpha_bar, pinned)
