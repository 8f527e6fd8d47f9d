"""Adaptation of our model by language: a concept is the embedding of its description."""

import torch
from torch import Tensor

from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.methods.language import METHOD
from ftl_lightning.networks.text_encoder import load_encoder
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.adaptation import Adaptation
from ftl_lightning.training.inversion import origin
from ftl_lightning.training.text_concept_model import TextConceptModel


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
        if not isinstance(self.model, TextConceptModel):
            raise UserError(
                f"model.pretrained: expected a model whose concepts are texts, found {self.model.method.kind} in {pretrained}"
            )
        self._standardise = self.model.standardise
        self._encoder = load_encoder(encoder, self.model.domain.concepts.table, revision)
        if (name := self._encoder.identity) != self.model.config.encoder:
            raise UserError(f"model.encoder: expected {self.model.config.encoder!r} (the pretrained model's), found {name!r}")

    @property
    def method(self) -> str:
        return METHOD.name

    def _embedding(self, goal: str) -> Tensor:
        """Embed a task's description, ``(1, 1, n)``."""
        return self._standardise(self._encoder([self.domain.concepts.sentence(goal)]).to(self.device))[None]

    def learned(self) -> dict[str, Concept]:
        weights = torch.tensor([self._omega])
        return {
            name: Concept(self._embedding(name).cpu(), weights, origin(self.model, self.demonstrations, name, "fixed", 0.0))
            for name in self.concepts
        }

    def composition(self, task: EvaluationTask) -> Composition | None:
        """The description of the whole task with its weight."""
        if task.component is not None or not set(task.learned) <= set(self._found):
            return None
        return Composition(self._embedding(task.goal), torch.tensor([self._omega], device=self.device))
