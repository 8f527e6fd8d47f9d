"""Pretraining of our model, a denoiser: Eq. 1 of the paper."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.diffusion import PAPER_SIZE
from ftl_lightning.diffusion.prediction import LOSSES, loss_weights
from ftl_lightning.diffusion.schedule import LARGEST_POWER, MOST_STEPS, denoising_loss, timesteps
from ftl_lightning.domains.data import Batch, PretrainingData
from ftl_lightning.domains.paper import OURS
from ftl_lightning.errors import UserError, short
from ftl_lightning.learning.codes import Codes
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.generative_model import DiffusionConfig, GenerativeModel
from ftl_lightning.learning.pretraining import Pretraining
from ftl_lightning.ranges import expect_count, expect_factor, expect_range


class PretrainingModule(Pretraining):
    """Trains a denoiser on a domain's pairs of behaviour and concept.

    Args:
        denoiser: name of a class of :mod:`ftl_lightning.diffusion`.
        denoiser_args: its arguments other than the sizes.
        paper_size: override them by the paper's full size (:data:`ftl_lightning.diffusion.PAPER_SIZE`).
        diffusion_steps: T.
        condition_dropout: probability p with which a sample's concept is replaced by the empty one; drawn per sample
            (the published code draws once a batch).
        learning_rate, warmup_steps, weight_decay, ema_decay, guidance, view, perturb, output, seed: see :class:`Pretraining`.
        image_encoder, feature_dropout: likewise.
        prediction: what the network puts out: ``'epsilon'`` (the paper's), or ``'v'``, ``'clean'`` or ``'displacement'``, from
            which the noise follows (:class:`ftl_lightning.diffusion.prediction.Prediction`).
        loss: whose squared error is minimised, ``'epsilon'``, ``'v'`` or ``'clean'``; ``'epsilon'`` is Eq. 1. The others
            weigh noisy timesteps, at which the concept decides, by 1 / abar_t and (1 - abar_t) / abar_t.
        timestep_power: see :func:`ftl_lightning.diffusion.schedule.timesteps`; 1 is the paper's.
        loss_discount: state k of a window weighs so much to the power of k: below 1 for plans that are made anew before they end.
        code_share: of the samples are also told a rough code of their own behaviour, which varies over the window, see
            :class:`~ftl_lightning.learning.codes.Codes`: so the network has seen concepts that do, and concepts that no text
            names. 0 is the paper's form.
        code_knots, code_size, code_noise: see there.
        compile: compile the denoiser for training (worth it on GPUs).
    """

    method = OURS

    def __init__(
        self,
        denoiser: str = "MLPDenoiser",
        denoiser_args: Mapping[str, Any] | None = None,
        paper_size: bool = False,
        diffusion_steps: int = 100,
        condition_dropout: float = 0.1,
        learning_rate: float = 1e-3,
        warmup_steps: int = 200,
        weight_decay: float = 0.01,
        ema_decay: float = 0.999,
        guidance: float = 1.2,
        prediction: str = "epsilon",
        loss: str = "epsilon",
        timestep_power: float = 1.0,
        loss_discount: float = 1.0,
        view: str = "",
        perturb: bool = False,
        code_share: float = 0.0,
        code_knots: int = 8,
        code_size: int = 16,
        code_noise: float = 0.3,
        compile: bool = False,
        output: str | None = None,
        seed: int = 0,
        image_encoder: Mapping[str, Any] | None = None,
        feature_dropout: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(
            learning_rate,
            warmup_steps,
            weight_decay,
            ema_decay,
            guidance,
            view,
            perturb,
            output,
            seed,
            image_encoder,
            feature_dropout,
        )
        self.save_hyperparameters()
        self.denoiser_args = dict(denoiser_args or {}) | (PAPER_SIZE.get(denoiser, {}) if paper_size else {})
        if not 0 <= code_share <= 1:
            raise UserError(f"model.code_share: expected a share from 0 to 1, found {code_share}")
        if loss not in LOSSES:
            raise UserError(f"model.loss: expected one of {', '.join(LOSSES)}, found {short(loss)!r}")
        expect_range("model.condition_dropout", condition_dropout, 0, 1)
        expect_factor("model.timestep_power", timestep_power, 1, LARGEST_POWER)
        expect_range("model.loss_discount", loss_discount, 0, 1)
        expect_range("model.code_noise", code_noise, 0)
        for name, count in (("diffusion_steps", diffusion_steps), ("code_knots", code_knots), ("code_size", code_size)):
            expect_count(f"model.{name}", count, 1, MOST_STEPS)
        self.codes = Codes(code_share, code_knots, code_size, code_noise) if code_share else None

    def build(
        self,
        shared: Mapping[str, Any],
        data: PretrainingData,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None,
    ) -> GenerativeModel:
        names = ("denoiser", "diffusion_steps", "prediction")
        config = DiffusionConfig(**shared, denoiser_args=self.denoiser_args, **{name: self.hparams[name] for name in names})
        model = GenerativeModel(config, data.domain, normalization, embeddings, initial_normalization)
        if self.codes is not None and self.codes.knots > 1 and not model.over_time:
            told = f"whose concepts do not vary over a plan, found {self.codes.knots}"
            raise UserError(f"model.code_knots: expected 1 for {config.denoiser}, {told}")
        return model

    def configure_model(self) -> None:
        super().configure_model()
        if self.hparams["compile"] and isinstance(self.raw, GenerativeModel):
            self.raw.denoiser.compile()

    def losses(self, model: ConceptModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Eq. 1; while fitting, concepts are dropped."""
        assert isinstance(model, GenerativeModel)
        states, seen = model.perturbed(batch.states, batch.observed, draw)
        clean = model.encode(states, seen)
        context = model.observe(seen)
        count = len(clean)
        dropout = self.hparams["condition_dropout"] if model.training else 0.0
        removed = torch.rand(count, generator=draw, device=self.device) < dropout
        concepts = torch.cat((model.empty[None], model.training_embeddings))
        index = torch.where(removed, 0, batch.concepts + 1)
        if self.codes is not None and model.training:
            concepts, index = self.codes(concepts[index], removed, clean, draw), torch.arange(count, device=self.device)
        else:
            concepts = concepts[:, None]  # one knot
        total, power = self.hparams["diffusion_steps"], self.hparams["timestep_power"]
        if power == 1:
            t = torch.randint(total, (count,), generator=draw, device=self.device)
        else:
            t = timesteps(torch.rand(count, generator=draw, device=self.device), total, power)
        noise = torch.randn(clean.shape, generator=draw, device=self.device)
        losses = denoising_loss(
            lambda x, t: model.denoiser(x, t, concepts, index, context),
            clean,
            noise,
            t,
            model.alpha_bar,
            self.hparams["loss_discount"],
        )
        return losses * loss_weights(self.hparams["loss"], model.alpha_bar)[t]
