"""A conditional VAE (paper, 'Baselines'): a concept space learned from behaviour alone, without the concepts it is paired with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning.concepts.composition import Composition, batched
from ftl_lightning.demonstrations.features import Observed, moved
from ftl_lightning.demonstrations.normalization import Normalization
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.data import Batch, PretrainingData
from ftl_lightning.domains.domain import Domain
from ftl_lightning.learning.baselines.additive import AdditiveModel, added
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.model_config import ModelConfig
from ftl_lightning.learning.pretraining import Pretraining, expect_shown
from ftl_lightning.ranges import expect_range


@dataclass(frozen=True, kw_only=True)
class VAEConfig(ModelConfig):
    """What the networks need to be built; ``concept_dim`` is the size of z.

    Attributes:
        hidden_dim: width of the encoder's and of the decoder's hidden layer.
    """

    hidden_dim: int = 512


class VAEModel(AdditiveModel):
    """Behaviour from an initial state and z, a normal variable in which a concept is a point; composing adds points.

    Args:
        config, domain, normalization, embeddings, initial_normalization: see :class:`ConceptModel`.
    """

    kind = "cvae"
    name = "CVAE"
    Config = VAEConfig
    config: VAEConfig

    def __init__(
        self,
        config: VAEConfig,
        domain: Domain,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None = None,
    ) -> None:
        super().__init__(config, domain, normalization, embeddings, initial_normalization)
        plan, beside, z = config.horizon * config.state_dim, config.vector_dim, config.concept_dim
        self.encoder = nn.Sequential(nn.Linear(plan + beside, config.hidden_dim), nn.ReLU(), nn.Linear(config.hidden_dim, 2 * z))
        self.decoder = nn.Sequential(nn.Linear(z + beside, config.hidden_dim), nn.ReLU(), nn.Linear(config.hidden_dim, plan))

    def posterior(self, states: Tensor, observed: Observed) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the variance of z, ``(batch, z)`` each, of behaviour ``(batch, horizon, state)``."""
        vector = self.vector(observed)
        plan = self.encode(states, observed).flatten(1)
        mean, log_variance = self.encoder(plan if vector is None else torch.cat((plan, vector), dim=-1)).chunk(2, dim=-1)
        return mean, log_variance

    def plans(self, z: Tensor, observed: Observed) -> Tensor:
        """Behaviour ``(batch, horizon, state)``, normalised, of ``z (batch, z)``."""
        vector = self.vector(observed)
        out: Tensor = self.decoder(z if vector is None else torch.cat((z, vector), dim=-1))
        return out.unflatten(-1, (self.config.horizon, self.config.state_dim))

    def errors(self, states: Tensor, observed: Observed, concepts: Tensor) -> Tensor:
        """Squared error of the reconstruction ``(batch,)``."""
        return (self.plans(concepts, observed) - self.encode(states, observed)).square().mean(dim=(1, 2))

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """The temperature is the variance of the noise that is added to z; sampler and steps do not matter."""
        shape, (together, own) = (count, self.config.concept_dim), batched(compositions, count, generators)
        noise = torch.cat([torch.randn(shape, generator=one, device=one.device) for one in generators]).to(self.device)
        z = added(together)[own] + sampling.temperature**0.5 * noise
        seen = observed or {}
        return self.decode(self.plans(z, seen), seen).unflatten(0, (len(compositions), count))


class VAEPretraining(Pretraining):
    """Fits encoder and decoder to a domain's behaviour; a training concept is the encoding of its first demonstration.

    Args:
        latent_dim: size of z.
        hidden_dim: see :class:`VAEConfig`.
        beta: weight of the divergence from the prior, per number of the behaviour, beside the squared error.
        options: see :class:`~ftl_lightning.learning.pretraining.Pretraining`.
    """

    method = "CVAE"

    def __init__(self, latent_dim: int = 20, hidden_dim: int = 512, beta: float = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.save_hyperparameters()
        expect_range("model.latent_dim", latent_dim, 1)
        expect_range("model.hidden_dim", hidden_dim, 1)
        expect_range("model.beta", beta, 0)

    def build(
        self,
        shared: Mapping[str, Any],
        data: PretrainingData,
        normalization: Normalization,
        embeddings: Tensor,
        initial_normalization: Normalization | None,
    ) -> VAEModel:
        latent = self.hparams["latent_dim"]
        config = VAEConfig(**dict(shared) | {"concept_dim": latent, "hidden_dim": self.hparams["hidden_dim"]})
        expect_shown(config.training_concepts, data.training.concepts)
        self._first = data.first_windows()
        return VAEModel(config, data.domain, normalization, torch.zeros(len(embeddings), latent), initial_normalization)

    def losses(self, model: ConceptModel, batch: Batch, draw: torch.Generator) -> Tensor:
        """The negative evidence lower bound, per number of the behaviour (Kingma & Welling, 2014)."""
        assert isinstance(model, VAEModel)
        states, seen = model.perturbed(batch.states, batch.observed, draw)
        mean, log_variance = model.posterior(states, seen)
        noise = torch.randn(mean.shape, generator=draw, device=mean.device)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        numbers = model.config.horizon * model.config.state_dim
        errors = model.errors(states, seen, mean + (0.5 * log_variance).exp() * noise)
        return errors + self.hparams["beta"] * divergence / numbers

    def _represent(self) -> None:
        model = self.model
        assert isinstance(model, VAEModel)
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
