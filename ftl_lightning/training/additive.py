"""Base of methods that compose concepts by addition (paper, 'Implementation Details')."""

from abc import abstractmethod

import torch
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.concept_model import ConceptModel, Draws


class AdditiveModel(ConceptModel):
    """A model conditioned on the weighted sum of a composition's parts."""

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
        UserError: for a concept restricted to some columns: a sum acts on all columns.
    """
    if composition.columns is not None:
        raise UserError("compose: expected concepts without '@' for a model that adds them up, found groups of columns")
    rows = zip(composition.weights, composition.embeddings, strict=True)
    return torch.stack([weights @ embeddings.flatten(1) for weights, embeddings in rows])
