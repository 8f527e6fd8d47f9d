"""Models whose concept space is the text encoder's."""

import torch
from torch import Tensor

from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_config import ModelConfig
from ftl_lightning.training.prepared import Prepared


class TextConceptModel(ConceptModel):
    """A model whose concept space is the text encoder's.

    Embeddings are centred on the training concepts and scaled to unit mean square, since language models' embeddings share a
    large common part, which hides differences.

    Args:
        prepared: inputs with the encoder's embeddings.
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, prepared: Prepared[ModelConfig]) -> None:
        embeddings = prepared.embeddings
        if embeddings.is_meta:  # sizes alone: arithmetic on meta tensors imports torch's compiler, which takes a second
            centre, spread = embeddings.new_empty(embeddings.shape[1]), embeddings.new_empty(())
        else:
            centre = embeddings[1:].mean(dim=0)
            spread = (embeddings[1:] - centre).square().mean().sqrt()
            spread = torch.where(spread > 0, spread, 1)  # 0 for a single training concept
            embeddings = (embeddings - centre) / spread
        super().__init__(prepared.embedded(embeddings))
        self.register_buffer("centre", centre)
        self.register_buffer("spread", spread)

    def standardise(self, embeddings: Tensor) -> Tensor:
        """Map the encoder's embeddings ``(..., n)`` to the model's concept space."""
        return (embeddings - self.centre) / self.spread
