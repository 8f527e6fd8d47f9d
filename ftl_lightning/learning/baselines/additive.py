"""What methods have in common that compose concepts by adding them (paper, 'Implementation Details')."""

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from ftl_lightning.learning.concept_model import ConceptModel, Noise


class AdditiveModel(ConceptModel):
    """A model to which a composition is one concept: the weighted sum of its parts."""

    @abstractmethod
    def errors(self, states: Tensor, initial_states: Tensor | None, concepts: Tensor) -> Tensor:
        """Squared error of behaviour ``(batch,)``.

        Args:
            states: ``(batch, window, state)`` in the domain's units.
            initial_states: ``(batch, initial state)`` or ``None``.
            concepts: ``(batch, n)``.
        """

    def losses(
        self,
        states: Tensor,
        initial_states: Tensor | None,
        embeddings: Tensor,
        weights: Tensor,
        noise: Noise | None,
        loss: str,
    ) -> Tensor:
        runs = len(embeddings)
        each = added(embeddings, weights).repeat_interleave(len(states) // runs, dim=0)
        return self.errors(states, initial_states, each).unflatten(0, (runs, -1))


def added(concepts: Sequence[Tensor] | Tensor, weights: Sequence[Tensor] | Tensor) -> Tensor:
    """Weighted sums ``(composition, n)`` of concepts ``(K, n)`` and weights ``(K,)`` each; K may differ between them."""
    return torch.stack([omega @ own for own, omega in zip(concepts, weights, strict=True)])
