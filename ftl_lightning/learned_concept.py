"""A learned concept as a user of the Python API holds it."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ftl_lightning.arguments import expect_whole
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.concepts.explanation import Explanation, explain
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError, short, shown
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.hub import upload
from ftl_lightning.learning.library import kept_file
from ftl_lightning.learning.quality import Inspection, inspected
from ftl_lightning.shared_concept import write_folder
from ftl_lightning.tuned import ModelSettings


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
        tuned: settings that go with the model, which its film is sampled with.
        known_as: under which name others find the model: one that ships or ``'owner/name'`` on the Hub; empty where there is none.
        demonstrations: that it was learned from, where this happened here.
        judging: the domain that judges its samples, then.
    """

    concept: Concept
    model: ConceptModel
    tuned: ModelSettings
    known_as: str = ""
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
        """What its weighted sum is made of, in words of the training concepts; of several knots, their mean.

        Args:
            nearest: how many of the nearest training concepts are told, 1 or more.

        Raises:
            UserError: for another number.
        """
        expect_whole("nearest", nearest, 1)
        embedding = self.concept.weighted_sum.mean(dim=0)
        return explain(embedding, self.model.config.training_concepts, self.model.training_embeddings.cpu(), nearest)

    def save(self, path: str | Path, quality: bool = False) -> None:
        """Write it to a file that every command reads.

        Args:
            path: of the file.
            quality: also write what :attr:`quality` measures, with the share of right samples, so that a library can tell it. It is
                one more key of the file's header: versions that do not know it read the file all the same, and without it a file
                has the bytes that ``invert`` writes.

        Raises:
            UserError: where ``quality`` is asked for and cannot be measured.
        """
        (replace(self.concept, quality=self.quality.record) if quality else self.concept).save(path)

    def keep(self) -> Path:
        """Write it to your own library, with its quality where that can be measured, so that compositions know it by its name.

        A concept of the same name and model that was kept before is replaced.

        Returns:
            Its file.
        """
        path = kept_file(self.model.hash, self.concept.origin.name)
        self._judged.save(path)
        return path

    @property
    def _judged(self) -> Concept:
        """With its quality, where it can be measured here."""
        measurable = self.demonstrations is not None and self.judging is not None and len(self.demonstrations) > 1
        return replace(self.concept, quality=self.quality.record) if measurable else self.concept

    def save_pretrained(self, folder: str | Path, demonstrations: bool = False) -> None:
        """Write a folder that others can load: ``concept.safetensors`` with its quality, a film or picture of new samples, and, if
        there is none yet, a ``README.md``.

        Args:
            folder: to write.
            demonstrations: also write what it was learned from, ``demonstrations.safetensors``; otherwise nothing shows them.

        Raises:
            UserError: where demonstrations are asked for of a concept that was not learned here.
        """
        if demonstrations and self.demonstrations is None:
            raise UserError("demonstrations: expected a concept that was learned here, found one from a file; leave them out")
        shared = self.demonstrations if demonstrations else None
        write_folder(Path(folder), self.model, self._judged, self.tuned, self.known_as, shared)

    def push_to_hub(self, repository: str, private: bool = False, demonstrations: bool = False) -> str:
        """Upload the folder of :meth:`save_pretrained` to the Hugging Face Hub as ``owner/name``; needs a network and a login.

        Args:
            repository: its name.
            private: whether only you see it, if it is new.
            demonstrations: also upload what it was learned from.

        Returns:
            Where it is.

        Raises:
            UserError: for a name that is none, or a place that cannot be written to.
        """
        return upload(lambda folder: self.save_pretrained(folder, demonstrations), repository, private)


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
