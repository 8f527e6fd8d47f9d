"""Adapting an in-context model: its concepts are the demonstrations themselves."""

import torch

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.learning.adaptation import Adaptation
from ftl_lightning.learning.baselines.in_context import InContextModel
from ftl_lightning.learning.inversion import origin


class InContextAdaptation(Adaptation):
    """A concept is its demonstrations, which the transformer reads; nothing is learned.

    Args:
        pretrained: folder of the pretrained model.
        output: folder for the concepts; ``None`` for ``concepts`` in the log folder.
        seed: of the evaluation's rows.
    """

    adapts = (InContextModel,)
    method = "in-context"

    def __init__(self, pretrained: str, output: str | None = None, seed: int = 0) -> None:
        super().__init__(pretrained, 1.0, output)
        self.save_hyperparameters()

    def learned(self) -> dict[str, Concept]:
        found = {}
        assert isinstance(self.model, InContextModel)
        for name in self.concepts:
            prompts = self.model.prompts(self.demonstrations.select(name))
            found[name] = Concept(
                prompts[:, None], torch.ones(len(prompts)), origin(self.model, self.demonstrations, name, "fixed", 0.0)
            )
        return found
