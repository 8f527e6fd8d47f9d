"""Replay as a method of ftl-lightning: a concept is its demonstrations, and a sample is one of them with a little noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.data import Batch, PretrainingData
from ftl_lightning.training.method import Method
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.pretraining import Pretraining

METHOD = Method(
    "replay",
    kind="replay",
    model=lambda: ReplayModel,
    pretraining=lambda: ReplayPretraining,
    configurations=str(Path(__file__).parent),  # suites.yaml
)


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(ModelConfig):
    """What every model has, ``concept_dim`` being the numbers of a plan, and the noise in shares of the states' spread."""

    noise: float = 0.05


class ReplayModel(ConceptModel):
    """Draws among the plans that a concept holds."""

    kind, Config = METHOD.kind, ReplayConfig

    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        plans = []
        for composition, draw in zip(compositions, generators, strict=True):
            chosen = torch.randint(len(composition.weights), (count,), generator=draw, device=draw.device).to(self.device)
            plan = composition.embeddings[chosen, 0].unflatten(-1, (self.config.horizon, self.config.state_dim))
            noise = torch.randn(plan.shape, generator=draw, device=draw.device).to(self.device)
            plans.append(plan + self.config.noise * noise)
        return self.decode(torch.cat(plans), observed or {}).unflatten(0, (len(compositions), count))

    def read_concepts(self, demonstrations: Demonstrations) -> dict[str, Concept]:
        """Every concept is the beginning of each of its demonstrations, ``(demonstration, 1, horizon * state)``."""
        concepts = {}
        for name in dict.fromkeys(demonstrations.concepts):
            demonstrated = demonstrations.select(name)
            rows = torch.arange(len(demonstrated))
            states, observed = demonstrated.windows(rows, torch.zeros_like(rows), self.window)
            plans = self.encode(states, observed).flatten(1)[:, None]
            origin = self.origin(demonstrations, name, "fixed", 0.0)
            concepts[name] = Concept(plans, torch.ones(len(plans)), origin)
        return concepts


class ReplayPretraining(Pretraining[ReplayModel]):
    """Keeps a plan of each training concept; there is nothing to fit."""

    def __init__(self, noise: float = 0.05, **options: object) -> None:
        super().__init__(**options)  # type: ignore[arg-type]
        self.save_hyperparameters()

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> ReplayModel:
        size = prepared.config.horizon * prepared.config.state_dim
        blank = torch.zeros(len(prepared.embeddings), size)
        configured = prepared.configured(ReplayConfig, concept_dim=size, noise=self.hparams["noise"])
        model, first = ReplayModel(configured.embedded(blank)), data.first_windows()
        model.training_embeddings.copy_(model.encode(first.states, first.observed).flatten(1))
        return model

    def losses(self, model: ReplayModel, batch: Batch, draw: torch.Generator) -> Tensor:
        return torch.zeros(len(batch.states))
