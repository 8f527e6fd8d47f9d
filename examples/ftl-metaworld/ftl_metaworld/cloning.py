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
from ftl_lightning.domains.comparison import OURS
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.diffusion import Context
from ftl_lightning.igm.forms.adapter import LowRank, adaptable, adapted
from ftl_lightning.igm.model import Draws
from ftl_lightning.igm.optimizer import Adam
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import Loss
from ftl_lightning.methods.bases import added
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
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

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: Loss) -> Tensor:
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


class AllWeights(Adaptation):
    """Learns all weights of the network, and the concept's embedding, from a concept's demonstrations.

    Of our model the encoder of the observation stays as it is, and so do biases: an adapter changes neither.

    Args:
        pretrained: folder of a pretrained model.
        scratch: whether to begin with random weights; normalisation is the pretrained model's.
        learning_rate, embedding_learning_rate: rates of Adam, which decay to 0 by a cosine; the embedding starts at the mean of the
            training concepts.
        samples: windows of a gradient step.
        loss: quantity of a diffusion model's squared error.
        output: folder for the concepts; ``None`` for ``concepts`` in the log folder.
        seed: seed of weights, windows and the evaluation's rows.

    Raises:
        UserError: for ``scratch`` with our model.
    """

    learns = True

    def __init__(
        self,
        pretrained: str,
        scratch: bool = False,
        learning_rate: float = 1e-3,
        embedding_learning_rate: float = 0.1,
        samples: int = 64,
        loss: str = "clean",
        output: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(pretrained, 1.0, output)
        own = isinstance(self.model, ChunkModel)
        require(own or not scratch, "model.scratch", f"false for a model of {self.model.method.name}", scratch)
        self.save_hyperparameters()

    @property
    def labels(self) -> Labels:
        name = "full fine-tuning" if self.model.method.name == OURS else f"{self.model.method.name}, full fine-tuning"
        return Labels("BC from scratch" if self.hparams["scratch"] else name, variant=f"rate {self.hparams['learning_rate']:g}")

    @classmethod
    def adapts(cls, model: type[ConceptModel]) -> bool:
        return issubclass(model, ChunkModel | GenerativeModel)

    def learn(self) -> dict[str, Concept]:
        return {name: self._learn(name) for name in self.concepts}

    def _learn(self, name: str) -> Concept:
        options, steps = self.hparams, int(self.trainer.datamodule.hparams["steps"])  # type: ignore[attr-defined]
        shown, model = self.demonstrations.select(name), copy.copy(self.model)
        key = "network" if isinstance(model, ChunkModel) else "denoiser"
        before, network = self.model.get_submodule(key), copy.deepcopy(self.model.get_submodule(key)).requires_grad_(True)
        if options["scratch"]:
            assert isinstance(model, ChunkModel)
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(options["seed"])
                network = Regressor(model.config)
        model._modules = {**self.model._modules, key: network}  # a model of its own, which shares all else
        every = isinstance(model, ChunkModel)
        weights = {
            key: weight for key, weight in network.named_parameters() if every or (weight.dim() > 1 and "initial" not in key)
        }
        embedding = nn.Parameter(torch.zeros(1, 1, 1, model.config.concept_dim))  # the mean of the training concepts
        rates = {embedding: options["embedding_learning_rate"]} | dict.fromkeys(weights.values(), options["learning_rate"])
        optimizers, loss = [Adam(parameter, rate) for parameter, rate in rates.items()], 0.0
        for step in range(steps):
            draw = generator("cpu", options["seed"], step, task_key(name))
            rows = torch.randint(len(shown), (options["samples"],), generator=draw)
            states, observed = model.windows(shown, rows, torch.rand(len(rows), generator=draw), draw)
            composition = Composition(embedding, torch.ones(1, 1))
            mean = model.losses(states, observed, composition, model.draws(len(rows), 1.0, draw), Loss(kind=options["loss"])).mean()
            for optimizer, gradient in zip(optimizers, torch.autograd.grad(mean, list(rates), materialize_grads=True), strict=True):
                optimizer.step(gradient, step, steps)
            loss = mean.item()
        old = dict(before.named_parameters())
        changes = {key: (weight.detach() - old[key]).reshape(len(weight), -1) for key, weight in weights.items()}
        adapter = LowRank({key: (change, torch.eye(change.shape[1])) for key, change in changes.items()}, everywhere=True)
        origin = self.model.origin(self.demonstrations, name, "fixed", loss)
        return Concept(embedding.detach()[0], torch.ones(1), origin, adapter=adapter)
