"""Conditional VAE (paper, 'Baselines'): a concept space learned from behaviour alone, without the paired concepts."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.bases import AdditiveModel, added
from ftl_lightning.training.model_config import ModelConfig, Prepared


@dataclass(frozen=True, kw_only=True)
class VAEConfig(ModelConfig):
    """Configuration of the networks; ``concept_dim`` is the size of z.

    Attributes:
        hidden_dim: width of the hidden layer in encoder and decoder.
    """

    hidden_dim: int = 512


class VAEModel(AdditiveModel):
    """VAE of behaviour, conditioned on the initial state. A concept is a value of the latent z; composing adds concepts."""

    kind = "cvae"
    Config = VAEConfig
    config: VAEConfig

    def __init__(self, prepared: Prepared[VAEConfig]) -> None:
        super().__init__(prepared)
        config = prepared.config
        plan, condition, z = config.horizon * config.state_dim, config.vector_dim, config.concept_dim
        self.encoder = nn.Sequential(nn.Linear(plan + condition, config.hidden_dim), nn.ReLU(), nn.Linear(config.hidden_dim, 2 * z))
        self.decoder = nn.Sequential(nn.Linear(z + condition, config.hidden_dim), nn.ReLU(), nn.Linear(config.hidden_dim, plan))

    def posterior(self, states: Tensor, observed: Observed) -> tuple[Tensor, Tensor]:
        """Mean and log variance of z, ``(batch, z)`` each, given behaviour ``(batch, horizon, state)``."""
        vector = self.vector(observed)
        plan = self.encode(states, observed).flatten(1)
        mean, log_variance = self.encoder(plan if vector is None else torch.cat((plan, vector), dim=-1)).chunk(2, dim=-1)
        return mean, log_variance

    def plans(self, z: Tensor, observed: Observed) -> Tensor:
        """Decode ``z (batch, z)`` to normalised behaviour ``(batch, horizon, state)``."""
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
        """Sample plans. The temperature is the variance of the noise added to z; sampler and steps are ignored."""
        shape, (together, row) = (count, self.config.concept_dim), batched(compositions, count, generators)
        noise = torch.cat([torch.randn(shape, generator=draw, device=draw.device) for draw in generators]).to(self.device)
        z = added(together)[row] + sampling.temperature**0.5 * noise
        features = observed or {}
        return self.decode(self.plans(z, features), features).unflatten(0, (len(compositions), count))
