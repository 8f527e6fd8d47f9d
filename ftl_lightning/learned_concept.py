"""A learned concept as a user of the Python API holds it."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.arguments import expect_whole
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.concepts.explanation import Explanation, explain
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError, short, shown
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.quality import Inspection, inspected


@dataclass(frozen=True)
class Learning:
    """A concept while it is learned.

    Attributes:
        step: how many were made.
        loss: mean of the last one.
        so_far: gives the concept as it is now, of one set of embeddings, whatever form it is to have.
    """

    step: int
    loss: float
    so_far: Callable[[], "LearnedConcept"]


@dataclass(frozen=True, repr=False)
class LearnedConcept(Composition):
    """A learned concept; it composes with others like any composition.

    Attributes:
        concept: embeddings, weights and where they come from.
        model: it was learned through.
        demonstrations: that it was learned from, where this happened here.
        judging: the domain that judges its samples, then.
    """

    concept: Concept
    model: ConceptModel
    demonstrations: Demonstrations | None = None
    judging: Domain | None = None

    def _words(self) -> Iterator[str]:
        return self.concept._words()

    @functools.cached_property
    def quality(self) -> Inspection:
        """What samples of it are like beside the demonstrations: recognised, spread, novelty, roughness, and both to look at.

        Raises:
            UserError: for a concept that was not learned here from two demonstrations or more.
        """
        if self.demonstrations is None or self.judging is None or len(self.demonstrations) < 2:
            raise UserError("quality: expected a concept that was learned here from two demonstrations or more, found another")
        return inspected(self.model, self.judging, self.demonstrations, self.concept, 0)

    def explain(self, nearest: int = 3) -> Explanation:
        """What its weighted sum is made of, in words of the training concepts; of several knots, their mean."""
        expect_whole("nearest", nearest, 1)
        embedding = self.concept.weighted_sum.mean(dim=0)
        return explain(embedding, self.model.config.training_concepts, self.model.training_embeddings.cpu(), nearest)

    def save(self, path: str | Path) -> None:
        """Write it to a file that every command reads."""
        self.concept.save(path)


def concept_of(model: ConceptModel, space: str, call: str, concept: object) -> Composition:
    """A concept of a model, on the model's device.

    Args:
        model: that is to use it.
        space: whose concepts the model's are, see :func:`~ftl_lightning.concepts.composition.space_of`.
        call: what it is given to, such as ``'sample'``.
        concept: what was given.

    Raises:
        UserError: for one of another model, or what is no concept.
    """
    if not isinstance(concept, Composition):
        text = short(model.config.training_concepts[0], 40)
        raise UserError(
            f"{call}: expected a concept, such as model[{text!r}], model.compose(text), model.load(path) or what model.learn "
            f"returns, found {shown(concept)}"
        )
    if concept.space not in ("", space):
        raise UserError(
            f"{call}: expected a concept of this model, {space}, found one of {concept.space}; learn it with this model"
        )
    n = model.config.concept_dim
    if concept.embeddings.dim() != 3 or concept.embeddings.shape[2] != n:
        raise UserError(
            f"{call}: expected a concept of this model, {space}, with embeddings (K, knots, {n}), "
            f"found {tuple(concept.embeddings.shape)}"
        )
    return concept if concept.weights.device == model.device else concept.to(model.device)
