"""A method that learns nothing in pretraining: it memorises, and its concepts are demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition, batched
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.data import Batch, OwnData, PretrainingData
from ftl_lightning.training.method import Method
from ftl_lightning.training.model_config import ModelConfig, Prepared
from ftl_lightning.training.model_folder import read_model
from ftl_lightning.training.pretraining import Pretraining
from ftl_lightning.training.trainer import Trainer

METHOD = Method("memory", kind="memory", model=lambda: Memory)


@pytest.fixture(autouse=True)
def offered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the method as an installed package does."""
    known = {"memory": f"{__name__}:METHOD"}
    monkeypatch.setattr("ftl_lightning.training.method._offered", lambda: known)


@dataclass(frozen=True, kw_only=True)
class MemoryConfig(ModelConfig):
    """Nothing beside what every model has; ``concept_dim`` is the size of a plan."""


class Memory(ConceptModel):
    """Gives back the plans that a concept consists of."""

    kind, Config = METHOD.kind, MemoryConfig

    def sample(
        self,
        compositions: Sequence[Composition],
        count: int,
        sampling: Sampling,
        generators: Sequence[torch.Generator],
        observed: Observed | None = None,
    ) -> Tensor:
        together, rows = batched(compositions, count, generators)
        plans = together.embeddings[rows, 0, 0].unflatten(-1, (self.config.horizon, self.config.state_dim))
        return self.decode(plans, observed or {}).unflatten(0, (len(compositions), count))

    def read_concepts(self, demonstrations: Demonstrations) -> dict[str, Concept]:
        """Every concept is its demonstrations."""
        plans = self.encode(demonstrations.states[:, : self.window], {}).flatten(1)[:, None]
        name = demonstrations.concepts[0]
        width = 3 if name == "short" else plans.shape[2]  # to be refused
        origin = self.origin(demonstrations, name, "fixed", 0.0)
        return {name: Concept(plans[..., :width], torch.ones(len(plans)), origin)}


class MemoryPretraining(Pretraining[Memory]):
    """Keeps the first window of each training concept."""

    def build(self, prepared: Prepared[ModelConfig], data: PretrainingData) -> Memory:
        size = prepared.config.horizon * prepared.config.state_dim
        blank = torch.zeros(len(prepared.embeddings), size)
        model = Memory(prepared.configured(MemoryConfig, concept_dim=size).embedded(blank))
        first = data.first_windows()
        model.training_embeddings.copy_(model.encode(first.states, first.observed).flatten(1))
        return model

    def losses(self, model: Memory, batch: Batch, draw: torch.Generator) -> Tensor:
        return torch.zeros(len(batch.states))


@pytest.fixture
def fitted() -> Path:
    lines = np.linspace(0, 1, 8, dtype=np.float32)[:, None] * np.array([[1.0, 0.5]], dtype=np.float32)
    states = np.stack([lines, 2 * lines, -lines, -2 * lines])
    np.savez("known.npz", states=states, concepts=np.array(["up", "up", "down", "down"]))
    module = MemoryPretraining(output="model")
    trainer = Trainer(max_steps=3, logger=False, enable_checkpointing=False, enable_progress_bar=False, accelerator="cpu")
    trainer.fit(module, datamodule=OwnData("known.npz", encoder="hashing", batch_size=2, steps_per_epoch=3))
    assert trainer.global_step == 3
    assert not [name for name in module.state_dict() if name.startswith(("model.unused", "raw.unused"))]
    return Path("model")


def test_a_model_without_parameters_is_pretrained_written_and_used_from_python(fitted: Path) -> None:
    model = FewShot(read_model(Memory, fitted), ModelSettings.read("conf/own.yaml"))
    five = 3 * np.ones((5, 8, 2), dtype=np.float32)
    concept = model.learn(five)
    assert torch.allclose(model.sample(concept, 2).states, torch.full((2, 8, 2), 3.0), atol=1e-5)
    with pytest.raises(
        UserError, match="expected no settings of an inversion, as memory learns without gradient descent, found components"
    ):
        model.learn(five, components=1)
    with pytest.raises(UserError, match="key 'embeddings': expected 16 numbers each, found 3"):
        model.learn(five, name="short")


def test_a_model_that_neither_learns_nor_reads_concepts_is_one_line(fitted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(Memory, "read_concepts")
    model = FewShot(read_model(Memory, fitted), ModelSettings.read("conf/own.yaml"))
    with pytest.raises(UserError, match=r"expected a model that learns or reads concepts, found one of memory; mend its package"):
        model.learn(3 * np.ones((5, 8, 2), dtype=np.float32))
