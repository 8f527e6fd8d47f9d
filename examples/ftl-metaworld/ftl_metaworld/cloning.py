"""Behaviour cloning with the network of our model: a chunk of actions by regression (Zhao et al., 2023).

The baseline has the same observation, network, training steps and adaptation as our model; only the loss differs.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.diffusion import Context
from ftl_lightning.igm.forms.adapter import LowRank, adaptable, adapted
from ftl_lightning.igm.model import Draws
from ftl_lightning.igm.optimizer import Adam
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.bases import added
from ftl_lightning.networks import MLPDenoiser
from ftl_lightning.services.errors import require
from ftl_lightning.services.randomness import generator, task_key
from ftl_lightning.training.adaptation import Adaptation, Labels
from ftl_lightning.training.concept_model import ConceptModel, TextConceptModel
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.method import Method
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.pretraining import Pretraining

METHOD = Method("BC, same network", kind="bc-chunks", model=lambda: ChunkModel, pretraining=lambda: ChunkPretraining)


@dataclass(frozen=True, kw_only=True)
class ChunkConfig(ModelConfig):
    """Configuration of the model; ``network`` holds the arguments of :class:`~ftl_lightning.networks.MLPDenoiser`."""

    network: Mapping[str, Any] = field(default_factory=dict)


class Regressor(nn.Module):
    """Our denoiser as a regressor: of no noisy plan, at one timestep, with the observation as its context."""

    def __init__(self, config: ChunkConfig) -> None:
        super().__init__()
        self.net = MLPDenoiser(config, **config.network)

    def forward(self, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context) -> Tensor:
        """Plans ``(batch, horizon, state)``, normalised; for the arguments see :class:`~ftl_lightning.networks.MLPDenoiser`."""
        plans: Tensor = self.net(x, t, concepts, index, self.net.observe(*context))
        return plans


class ChunkModel(TextConceptModel):
    """Plans by regression from the observation and the weighted sum of a composition's concepts."""

    kind, Config, invertible = METHOD.kind, ChunkConfig, True
    config: ChunkConfig

    def __init__(self, prepared: Prepared[ChunkConfig]) -> None:
        super().__init__(prepared)
        self.network = Regressor(prepared.config)

    def plans(self, observed: Observed, composition: Composition, row: Tensor) -> Tensor:
        """Normalised plans ``(batch, horizon, state)`` of the rows ``(batch,)`` of a composition ``(row, K, ...)``."""
        network: Any = self.network
        if composition.adapter is not None:
            network = adapted(self.network, composition.adapters, composition.adapter.amax(dim=1)[row])
        x = torch.zeros(len(row), self.config.horizon, self.config.state_dim, device=self.device)
        vector = self.vector(observed)
        assert vector is not None
        return network(x, torch.zeros_like(row), added(composition)[:, None], row, (vector,))

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: str) -> Tensor:
        runs = len(composition.weights)
        row = torch.arange(runs, device=self.device).repeat_interleave(len(states) // runs)
        errors = self.plans(observed, composition, row) - self.encode(states, observed)
        return errors.square().mean(dim=(1, 2)).unflatten(0, (runs, -1))

    @torch.no_grad()
    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        """Plans, deterministic; ``sampling`` is ignored."""
        together, row = batched(compositions, count, generators)
        seen = observed or {}
        return self.decode(self.plans(seen, together, row), seen).unflatten(0, (len(compositions), count))

    def adaptable(self, by_sample: bool = False) -> dict[str, tuple[int, int]]:
        return adaptable(self.network)

    def check_adapter(self, adapter: LowRank) -> None:
        names = dict(self.network.named_parameters())
        for name, (up, down) in adapter.factors.items():
            weight, sizes = names.get(name), (len(up), down.shape[1])
            expected = None if weight is None else (len(weight), weight[0].numel())
            require(sizes == expected, f"key 'adapter/{name}'", f"the sizes {expected}", sizes)


class ChunkPretraining(Pretraining[ChunkModel]):
    """Fits the regressor to a domain's demonstrations.

    Args:
        network: arguments of the network.
        options: see :class:`~ftl_lightning.training.pretraining.Pretraining`.
    """

    def __init__(self, network: Mapping[str, Any] | None = None, **options: Any) -> None:
        super().__init__(**options)
        self.save_hyperparameters()

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> ChunkModel:
        return ChunkModel(prepared.configured(ChunkConfig, network=dict(self.hparams["network"] or {})))

    def losses(self, model: ChunkModel, batch: Batch, draw: torch.Generator) -> Tensor:
        errors = model.plans(batch.observed, model.compositions(), batch.concepts) - model.encode(batch.states, batch.observed)
        return errors.square().mean(dim=(1, 2))


class FromScratch(Adaptation):
    """Learns all weights of the network from a concept's demonstrations alone, from random initial weights.

    Args:
        pretrained: folder of a pretrained model, of which only architecture and normalisation are used.
        learning_rate: learning rate of Adam, which decays to 0 by a cosine.
        samples: windows of a gradient step.
        output: folder for the concepts; ``None`` for ``concepts`` in the log folder.
        seed: seed of weights, windows and the evaluation's rows.
    """

    learns = True
    labels = Labels("BC from scratch")

    def __init__(
        self, pretrained: str, learning_rate: float = 1e-3, samples: int = 256, output: str | None = None, seed: int = 0
    ) -> None:
        super().__init__(pretrained, 1.0, output)
        self.save_hyperparameters()

    @classmethod
    def adapts(cls, model: type[ConceptModel]) -> bool:
        return issubclass(model, ChunkModel)

    def learn(self) -> dict[str, Concept]:
        return {name: self._learn(name) for name in self.concepts}

    def _learn(self, name: str) -> Concept:
        assert isinstance(self.model, ChunkModel)
        steps, seed = int(self.trainer.datamodule.hparams["steps"]), self.hparams["seed"]  # type: ignore[attr-defined]
        shown, model = self.demonstrations.select(name), copy.copy(self.model)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Regressor(self.model.config)
        model._modules = {**self.model._modules, "network": network.requires_grad_(True)}
        optimizers = [Adam(parameter, self.hparams["learning_rate"]) for parameter in network.parameters()]
        alone = Composition(torch.zeros(1, 1, 1, self.model.config.concept_dim), torch.ones(1, 1))
        loss = 0.0
        for step in range(steps):
            draw = generator("cpu", seed, step, task_key(name))
            rows = torch.randint(len(shown), (self.hparams["samples"],), generator=draw)
            states, observed = model.windows(shown, rows, torch.rand(len(rows), generator=draw), draw)
            mean = model.losses(states, observed, alone, None, "").mean()
            gradients = torch.autograd.grad(mean, [optimizer.parameter for optimizer in optimizers], materialize_grads=True)
            for optimizer, gradient in zip(optimizers, gradients, strict=True):
                optimizer.step(gradient, step, steps)
            loss = mean.item()
        before = dict(self.model.network.named_parameters())
        after = {key: parameter.detach() for key, parameter in network.named_parameters()}
        changes = {key: (weight - before[key]).reshape(len(weight), -1) for key, weight in after.items()}
        adapter = LowRank({key: (change, torch.eye(change.shape[1])) for key, change in changes.items()}, everywhere=True)
        origin = self.model.origin(self.demonstrations, name, "fixed", loss)
        return Concept(alone.embeddings[0], alone.weights[0], origin, adapter=adapter)
