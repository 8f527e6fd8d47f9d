"""Pretraining of the conditional VAE."""

from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.features import moved
from ftl_lightning.methods.cvae.model import VAEConfig, VAEModel
from ftl_lightning.services.randomness import drawn
from ftl_lightning.services.validation import check_range
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.pretraining import Pretraining, check_shown


class VAEPretraining(Pretraining[VAEModel]):
    """Fits encoder and decoder to a domain's behaviour; a training concept is the encoding of its first demonstration.

    Args:
        latent_dim: size of z.
        hidden_dim: see :class:`VAEConfig`.
        beta: weight of the divergence from the prior, per value of the behaviour, relative to the squared error.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.
    """

    def __init__(self, latent_dim: int = 20, hidden_dim: int = 512, beta: float = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        check_range("model.latent_dim", latent_dim, 1)
        check_range("model.hidden_dim", hidden_dim, 1)
        check_range("model.beta", beta, 0)

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> VAEModel:
        latent = self.hparams["latent_dim"]
        check_shown(prepared.config.training_concepts, data.training.concepts)
        self._first = data.first_windows()
        networks = prepared.configured(VAEConfig, concept_dim=latent, hidden_dim=self.hparams["hidden_dim"])
        return VAEModel(networks.embedded(torch.zeros(len(prepared.embeddings), latent)))

    def losses(self, model: VAEModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """Negative evidence lower bound per value of the behaviour (Kingma & Welling, 2014)."""
        states, seen = batch.states, batch.observed
        mean, log_variance = model.posterior(states, seen)
        noise = drawn(len(mean), lambda n: torch.randn((n, *mean.shape[1:]), generator=draw, device=mean.device))
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        numbers = model.config.horizon * model.config.state_dim
        errors = model.errors(states, seen, mean + (0.5 * log_variance).exp() * noise)
        return errors + self.hparams["beta"] * divergence / numbers

    def _represent(self) -> None:
        model = self.model
        states, _, seen = self._first
        with torch.no_grad():
            mean, _ = model.posterior(states.to(self.device), moved(seen, self.device))
        model.training_embeddings.copy_(mean)

    def on_validation_start(self) -> None:
        super().on_validation_start()
        self._represent()

    def on_test_start(self) -> None:
        self._represent()

    def on_fit_end(self) -> None:
        self._represent()
        super().on_fit_end()
