"""Flow matching (Lipman et al., 2023; rectified flow, Liu et al., 2023) as a method of ftl-lightning: no diffusion process."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.diffusion import Context
from ftl_lightning.igm.guidance import composed_epsilon
from ftl_lightning.igm.model import Draws
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import Loss
from ftl_lightning.networks import MLPDenoiser
from ftl_lightning.training.concept_model import TextConceptModel
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.method import Method
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.pretraining import Pretraining

METHOD = Method("flow matching", kind="flow", model=lambda: FlowModel, pretraining=lambda: FlowPretraining)
Velocity = Callable[[Tensor, Tensor], Tensor]  # (x (batch, horizon, state), t (batch,)) -> like x
TIMES = 1000
"""Times from noise (0) to behaviour, as the network's embedding of time reads them."""


@dataclass(frozen=True, kw_only=True)
class FlowConfig(ModelConfig):
    """What the network needs to be built: arguments of the MLP."""

    network: Mapping[str, Any] = field(default_factory=dict)


class FlowModel(TextConceptModel):
    """A velocity field from noise to behaviour, given a concept; concepts are composed by Eq. 2 of the paper."""

    kind, Config, invertible = METHOD.kind, FlowConfig, True

    def __init__(self, prepared: Prepared[FlowConfig]) -> None:
        super().__init__(prepared)
        self.network = MLPDenoiser(prepared.config, **prepared.config.network)

    def errors(self, velocity: Velocity, clean: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """Squared error of a velocity field on the straight ways from noise to ``clean (batch, horizon, state)``: ``(batch,)``."""
        way = (t / TIMES)[:, None, None]
        return (velocity((1 - way) * noise + way * clean, t) - (clean - noise)).square().mean(dim=(1, 2))

    def draws(self, samples: int, timestep_power: float, draw: torch.Generator) -> Draws:
        noise = torch.randn((samples, self.config.horizon, self.config.state_dim), generator=draw, device=draw.device)
        return Draws(torch.randint(TIMES, (samples,), generator=draw, device=draw.device), noise)

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: Loss) -> Tensor:
        runs, (t, noise) = len(composition.weights), draws or self.draws(len(states), 1, torch.Generator())
        velocity = self.composed(composition, self.network.observe(self.vector(observed)))
        clean = self.encode(states, observed)
        return self.errors(velocity, clean, t.repeat(runs), noise.repeat(runs, 1, 1)).unflatten(0, (runs, -1))

    def composed(self, composition: Composition, context: Context, rows: Tensor | None = None) -> Velocity:
        """The velocity field of some compositions."""
        return lambda x, t: composed_epsilon(self.network, x, t, composition, self.empty, context, rows)

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Euler steps along the field; the sampler's name does not matter, and the temperature is the variance of the noise."""
        (together, rows), given, shape = batched(compositions, count, generators), observed or {}, self.config
        velocity = self.composed(together, self.network.observe(self.vector(given)), rows)
        noise = [torch.randn((count, shape.horizon, shape.state_dim), generator=draw, device=draw.device) for draw in generators]
        x = sampling.temperature**0.5 * torch.cat(noise).to(self.device)
        for step in range(sampling.steps):
            x = x + velocity(x, torch.full((len(x),), step * TIMES // sampling.steps, device=x.device)) / sampling.steps
        return self.decode(x, given).unflatten(0, (len(compositions), count))


class FlowPretraining(Pretraining[FlowModel]):
    """Fits the velocity field; a tenth of the samples are told the empty concept."""

    def __init__(self, network: Mapping[str, Any] | None = None, condition_dropout: float = 0.1, **options: Any) -> None:
        super().__init__(**options)
        self.save_hyperparameters()

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> FlowModel:
        return FlowModel(prepared.configured(FlowConfig, network=dict(self.hparams["network"] or {})))

    def losses(self, model: FlowModel, batch: Batch, draw: torch.Generator) -> Tensor:
        states, observed = model.perturbed(batch.states, batch.observed, draw)
        t, noise = model.draws(len(states), 1, draw)
        empty = model.training & (torch.rand(len(t), generator=draw, device=t.device) < self.hparams["condition_dropout"])
        concepts = torch.cat((model.empty[None], model.training_embeddings))[:, None]  # of one knot
        told, context = torch.where(empty, 0, batch.concepts + 1), model.network.observe(model.vector(observed))
        return model.errors(lambda x, t: model.network(x, t, concepts, told, context), model.encode(states, observed), t, noise)
