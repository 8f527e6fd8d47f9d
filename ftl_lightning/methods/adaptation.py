"""Other adaptations of our model: by language, where a concept is the embedding of its description, and by fine-tuning."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.settings import AdapterOptions
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.networks.text_encoder import load_encoder
from ftl_lightning.services.errors import require
from ftl_lightning.training.adaptation import Adaptation, Labels
from ftl_lightning.training.concept_model import ConceptModel, TextConceptModel
from ftl_lightning.training.inversion_module import InversionModule


class LanguageAdaptation(Adaptation):
    """Uses the embedding of a description as concept, without learning; demonstrations only name the concepts.

    A composition is described by the domain's sentence for its goal.

    Args:
        pretrained: folder of our pretrained model.
        omega: guidance weight of the description.
        encoder, revision: text encoder, see :func:`ftl_lightning.networks.text_encoder.load_encoder`; as in pretraining.
            The table has no new sentences.
        output: folder for the concepts; ``None`` for ``concepts`` in the log folder.
        seed: seed in the evaluation's rows.

    Raises:
        UserError: for a model of another method or encoder.
    """

    labels = Labels("language")

    def __init__(
        self,
        pretrained: str,
        omega: float = 1.2,
        encoder: str = "minilm",
        revision: str = "main",
        output: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(pretrained, omega, output)
        self.save_hyperparameters()
        assert isinstance(self.model, TextConceptModel)
        self._standardise = self.model.standardise
        self._encoder = load_encoder(encoder, self.model.domain.concepts.table, revision)
        expected, name = self.model.config.encoder, self._encoder.identity
        require(name == expected, "model.encoder", f"{expected!r} (the pretrained model's)", repr(name))

    @classmethod
    def adapts(cls, model: type[ConceptModel]) -> bool:
        return model is GenerativeModel  # of a regression with its network the row would be another method's

    def _embedding(self, goal: str) -> Tensor:
        """Embed a task's description, ``(1, 1, n)``."""
        return self._standardise(self._encoder([self.domain.concepts.sentence(goal)]).to(self.device))[None]

    def learn(self) -> dict[str, Concept]:
        weights, origin = torch.tensor([self._omega]), self.model.origin
        names = self.concepts
        return {
            name: Concept(self._embedding(name).cpu(), weights, origin(self.demonstrations, name, "fixed", 0.0)) for name in names
        }

    def composition(self, task: EvaluationTask) -> Composition | None:
        """The description of the whole task with its weight."""
        if task.component is not None or not set(task.learned) <= set(self.learned()):
            return None
        return Composition(self._embedding(task.goal), torch.tensor([self._omega], device=self.device))


_WHOLE = AdapterOptions(rank=4, scope="all")


class FineTuning(InversionModule):
    """Learns a concept with an adapter of every branch of a composition, including the unconditional.

    Args:
        pretrained: folder of the pretrained model.
        adapter: rank and learning rate; the scope is always ``'all'``.
        options: see :class:`~ftl_lightning.training.inversion_module.InversionModule`.
    """

    def __init__(self, pretrained: str, adapter: AdapterOptions = _WHOLE, **options: Any) -> None:
        super().__init__(pretrained, adapter=replace(adapter, scope="all"), **options)
