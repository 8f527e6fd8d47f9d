"""Pretraining of the denoiser: Eq. 1 of the paper, with coarse codes of behaviour, for concepts that vary over a plan."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.igm.diffusion import LARGEST_POWER, LOSSES, MOST_STEPS, Prediction, denoising_loss, loss_weights, timesteps
from ftl_lightning.methods.ftl_igm.model import DiffusionConfig, GenerativeModel
from ftl_lightning.networks import PAPER_SIZE
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.randomness import drawn, generator, mean
from ftl_lightning.services.validation import MOST_TOGETHER, check_count, check_factor, check_range, flat, groups_of
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.pretraining import Pretraining

WINDOWS = 4096
"""Maximum number of windows for fitting the scales of cosines."""
PRETRAINING: Mapping[str, str] = {
    "condition_dropout": "loss.condition_dropout",
    "loss": "loss.kind",
    "timestep_power": "loss.timestep_power",
    "loss_discount": "loss.discount",
    "code_share": "codes.share",
    "code_knots": "codes.knots",
    "code_size": "codes.size",
    "code_noise": "codes.noise",
    "code_relative": "codes.relative",
}
"""Grouped option, ``'group.option'``, by its flat name in model records."""


@dataclass(frozen=True, kw_only=True)
class LossOptions:
    """Options of the pretraining loss.

    Attributes:
        kind: quantity of the squared error, ``'epsilon'`` (Eq. 1), ``'v'`` or ``'clean'``. ``'v'`` and ``'clean'`` give more weight
            to noisy timesteps, at which the concept matters: factors 1 / abar_t and (1 - abar_t) / abar_t.
        timestep_power: see :func:`ftl_lightning.igm.diffusion.timesteps`; 1 is the paper's.
        discount: state k of a window has weight ``discount ** k``; use values below 1 with replanning.
        condition_dropout: probability p of replacing a sample's concept by the unconditional embedding; drawn per sample
            (the published code draws per batch).
    """

    kind: str = "epsilon"
    timestep_power: float = 1.0
    discount: float = 1.0
    condition_dropout: float = 0.1

    def __post_init__(self) -> None:
        if self.kind not in LOSSES:
            raise UserError(f"model.loss.kind: expected one of {', '.join(LOSSES)}, found {short(self.kind)!r}")
        check_range("model.loss.condition_dropout", self.condition_dropout, 0, 1)
        check_factor("model.loss.timestep_power", self.timestep_power, 1, LARGEST_POWER)
        check_range("model.loss.discount", self.discount, 0, 1)


@dataclass(frozen=True)
class Codes:
    """Coarse codes of behaviour, added to the text embeddings of some samples in pretraining.

    A code is a random linear projection of the plan's states at several knots, with noise. Its average length is that of a text
    embedding, and half of the samples with a code have no text.

    Attributes:
        share: share of samples with a code, excluding samples with dropped text, which stay unconditional. 0 is the paper's form.
        knots: number of times.
        size: number of values per knot.
        noise: standard deviation of the noise added to the values, which have unit variance.
        relative: encode displacements from the first state; otherwise positions. Concepts of positions lead to the same places
            from any initial state.
    """

    share: float = 0.0
    knots: int = 8
    size: int = 16
    noise: float = 0.3
    relative: bool = True

    def __post_init__(self) -> None:
        check_range("model.codes.share", self.share, 0, 1)
        check_range("model.codes.noise", self.noise, 0)
        check_count("model.codes.knots", self.knots, 1, MOST_STEPS)
        check_count("model.codes.size", self.size, 1, MOST_STEPS)

    def __call__(self, texts: Tensor, removed: Tensor, clean: Tensor, draw: torch.Generator) -> Tensor:
        """Add codes to text embeddings; returns concepts ``(batch, knots, n)``.

        Args:
            texts: ``(batch, n)``, unconditional where removed.
            removed: mask of removed texts ``(batch,)``.
            clean: plans ``(batch, horizon, state)``, normalised.
        """
        count, width, device = *texts.shape, clean.device
        times = torch.linspace(0, clean.shape[1] - 1, self.knots, device=device).round().long()
        fixed = generator("cpu", zlib.crc32(b"codes"))
        mixing = torch.randn(clean.shape[2], self.size, generator=fixed).to(device)
        directions = torch.randn(self.size, width, generator=fixed).to(device) / self.size**0.5
        states = clean[:, times] - clean[:, :1] if self.relative else clean[:, times]
        path = states @ mixing  # (batch, knot, size)
        numbers = path / mean(path.square().mean()).sqrt().clamp(min=1e-6)
        numbers = numbers + self.noise * drawn(count, lambda n: torch.randn((n, *path.shape[1:]), generator=draw, device=device))
        coded = (drawn(count, lambda n: torch.rand(n, generator=draw, device=device)) < self.share) & ~removed
        alone = coded & (drawn(count, lambda n: torch.rand(n, generator=draw, device=device)) < 0.5)
        text = torch.where(alone[:, None], 0, texts)  # 0 is the mean of the training concepts
        return text[:, None] + coded[:, None, None] * (numbers @ directions)


_LOSS, _CODES = LossOptions(), Codes()


class PretrainingModule(Pretraining[GenerativeModel]):
    """Trains a denoiser on a domain's pairs of behaviour and concept.

    Args:
        denoiser: name of a class of :mod:`ftl_lightning.networks`.
        denoiser_args: arguments of the denoiser other than the sizes.
        paper_size: override the arguments by the paper's full size (:data:`ftl_lightning.networks.PAPER_SIZE`).
        diffusion_steps: T.
        draws: number of timesteps and noises per window and step; the observation is encoded once for all draws.
        prediction: parametrisation of the output: ``'epsilon'`` (the paper's), ``'v'``, ``'clean'``, ``'displacement'`` or
            ``'cosines'`` (:class:`ftl_lightning.igm.diffusion.Prediction`).
        loss: options of the loss.
        codes: coarse codes of behaviour for some samples, which prepare the network for concepts that vary over a plan and for
            concepts without a text.
        compile: compile the denoiser for training (worth it on GPUs).
        learning_rate: learning rate of AdamW.
        guidance: guidance weight omega for training concepts in evaluation.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.
    """

    flat = PRETRAINING
    framed = True
    network: type[GenerativeModel] = GenerativeModel

    def __init__(
        self,
        denoiser: str = "MLPDenoiser",
        denoiser_args: Mapping[str, Any] | None = None,
        paper_size: bool = False,
        diffusion_steps: int = 100,
        draws: int = 1,
        prediction: str = "epsilon",
        loss: LossOptions = _LOSS,
        codes: Codes = _CODES,
        compile: bool = False,
        learning_rate: float = 1e-3,
        guidance: float = 1.2,
        **options: Any,
    ) -> None:
        super().__init__(learning_rate=learning_rate, guidance=guidance, **options)
        self.save_hyperparameters(ignore=groups_of(PRETRAINING))
        self.save_hyperparameters(flat({"loss": loss, "codes": codes}, PRETRAINING))
        self.denoiser_args = dict(denoiser_args or {}) | (PAPER_SIZE.get(denoiser, {}) if paper_size else {})
        check_count("model.diffusion_steps", diffusion_steps, 1, MOST_STEPS)
        check_count("model.draws", draws, 1, MOST_TOGETHER)
        self.loss, self.codes, self.draws = loss, codes, draws

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> GenerativeModel:
        named = {name: self.hparams[name] for name in ("denoiser", "diffusion_steps", "prediction")}
        model = self.network(prepared.configured(DiffusionConfig, denoiser_args=self.denoiser_args, **named))
        if isinstance(model.denoiser, Prediction) and model.denoiser.spectrum is not None:
            windows = data.some_windows(WINDOWS)
            frames = None if model.frames is None else model.frames[windows.concepts]
            model.denoiser.spectrum.fit(model.encode(windows.states, windows.observed, frames))
        if self.codes.share and self.codes.knots > 1 and not model.over_time:
            reason = f"whose concepts do not vary over a plan, found {self.codes.knots}"
            raise UserError(f"model.codes.knots: expected 1 for {model.config.denoiser}, {reason}")
        return model

    def configure_model(self) -> None:
        super().configure_model()
        if self.hparams["compile"]:
            self.raw.denoiser.compile()

    def losses(self, model: GenerativeModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Loss of Eq. 1, with condition dropout in training."""
        states, seen = batch.states, batch.observed
        clean = model.encode(states, seen, None if model.frames is None else model.frames[batch.concepts])
        context, concept = model.observe(seen), batch.concepts
        if (draws := self.draws) > 1:
            clean, concept = clean.repeat(draws, 1, 1), concept.repeat(draws)
            context = tuple(part.repeat(draws, *(1,) * (part.dim() - 1)) for part in context)
        count = len(clean)
        dropout = self.loss.condition_dropout if model.training else 0.0
        removed = drawn(count, lambda n: torch.rand(n, generator=draw, device=self.device)) < dropout
        concepts = torch.cat((model.empty[None], model.training_embeddings))
        index = torch.where(removed, 0, concept + 1)
        if self.codes.share and model.training:
            concepts, index = self.codes(concepts[index], removed, clean, draw), torch.arange(count, device=self.device)
        else:
            concepts = concepts[:, None]  # single knot
        total, power = self.hparams["diffusion_steps"], self.loss.timestep_power
        if power == 1:
            t = drawn(count, lambda n: torch.randint(total, (n,), generator=draw, device=self.device))
        else:
            t = timesteps(drawn(count, lambda n: torch.rand(n, generator=draw, device=self.device)), total, power)
        noise = drawn(count, lambda n: torch.randn((n, *clean.shape[1:]), generator=draw, device=self.device))
        losses = denoising_loss(
            lambda x, t: model.denoiser(x, t, concepts, index, context), clean, noise, t, model.alpha_bar, self.loss.discount
        )
        return losses * loss_weights(self.loss.kind, model.alpha_bar)[t]
