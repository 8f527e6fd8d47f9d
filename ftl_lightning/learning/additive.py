"""What methods have in common that compose concepts by adding them (paper, 'Implementation Details')."""

from abc import abstractmethod

import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.features import Observed
from ftl_lightning.errors import UserError
from ftl_lightning.learning.concept_model import ConceptModel, Draws


class AdditiveModel(ConceptModel):
    """A model to which a composition is one concept: the weighted sum of its parts."""

    invertible = True

    @abstractmethod
    def errors(self, states: Tensor, observed: Observed, concepts: Tensor) -> Tensor:
        """Squared error of behaviour ``(batch,)``.

        Args:
            states: ``(batch, window, state)`` in the domain's units.
            observed: features ``(batch, *shape)`` by name.
            concepts: ``(batch, n)``.
        """

    def losses(self, states: Tensor, observed: Observed, composition: Composition, draws: Draws | None, loss: str) -> Tensor:
        runs, each = len(composition.weights), added(composition)
        return self.errors(states, observed, each.repeat_interleave(len(states) // runs, dim=0)).unflatten(0, (runs, -1))


def added(composition: Composition) -> Tensor:
    """Weighted sums ``(row, n)`` of the concepts of a composition ``(row, K, 1, n)``.

    Raises:
        UserError: for a concept whose weight is on some columns alone: one sum acts on all of them.
    """
    if composition.columns is not None:
        raise UserError("compose: expected concepts without '@' for a model that adds them up, found groups of columns")
    rows = zip(composition.weights, composition.embeddings, strict=True)
    return torch.stack([weights @ embeddings.flatten(1) for weights, embeddings in rows])
