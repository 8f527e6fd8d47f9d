"""Learned concepts of the Python API."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.few_shot.shared_concept import upload, write_folder
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.explanation import Explanation, explain
from ftl_lightning.igm.library import kept_file
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.validation import check_whole
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.quality import Inspection, inspected, judging_domain


@dataclass(frozen=True)
class Learning:
    """State of learning, for callbacks.

    Attributes:
        step: number of completed steps.
        loss: mean loss of the last step.
        so_far: returns the current concept, a single set of embeddings whatever the final form.
    """

    step: int
    loss: float
    so_far: Callable[[], "LearnedConcept"]


@dataclass(frozen=True, repr=False)
class LearnedConcept(Composition):
    """A learned concept, which composes like any composition.

    Attributes:
        concept: embeddings, weights and origin.
        model: the concept's model.
        tuned: the model's settings, for sampling its film.
        known_as: public name of the model: a shipped model or ``'owner/name'`` on the Hub; empty for none.
        demonstrations: its demonstrations, if it was learned in this process.
        examples: demonstrations with which its samples are compared in data of a user.
    """

    concept: Concept
    model: ConceptModel
    tuned: ModelSettings
    known_as: str = ""
    demonstrations: Demonstrations | None = None
    examples: tuple[Demonstrations, ...] = ()

    def _words(self) -> Iterator[str]:
        return self.concept._words()

    @functools.cached_property
    def quality(self) -> Inspection:
        """Quality of samples relative to the demonstrations: success rate, spread, novelty, roughness, and a figure.

        Raises:
            UserError: for a concept that was not learned in this process from two demonstrations or more.
        """
        if self.inspection is None:
            raise UserError("quality: expected a concept that was learned here from two demonstrations or more, found another")
        return self.inspection

    @functools.cached_property
    @usual_modes()
    def inspection(self) -> Inspection | None:
        """:attr:`quality`; ``None`` where it cannot be measured."""
        if self.demonstrations is None:
            return None
        return inspected(self.model, judging_domain(self.model, self.examples), self.demonstrations, self.concept)

    @usual_modes()
    def explain(self, nearest: int = 3) -> Explanation:
        """Explain the weighted sum, averaged over knots, by training concepts.

        Args:
            nearest: number of nearest training concepts, 1 or more.

        Raises:
            UserError: for another number.
        """
        check_whole("nearest", nearest, 1)
        embedding = self.concept.weighted_sum.mean(dim=0)
        return explain(embedding, self.model.config.training_concepts, self.model.training_embeddings.cpu(), nearest)

    def save(self, path: str | Path, quality: bool = False) -> None:
        """Write the concept to a file that every command reads.

        Args:
            path: path of the file.
            quality: also write :attr:`quality`, with the success rate, for libraries. It is an additional key of the file's header,
                which older versions ignore; without it the file has the bytes that ``invert`` writes.

        Raises:
            UserError: if ``quality`` is requested and cannot be measured.
        """
        (replace(self.concept, quality=self.quality.record) if quality else self.concept).save(path)

    def keep(self) -> Path:
        """Save the concept to your library, with its quality if measurable, so that compositions find it by name.

        An earlier concept of the same name and model is replaced.

        Returns:
            The file.
        """
        path = kept_file(self.model.hash, self.concept.origin.name)
        self._judged.save(path)
        return path

    @property
    def _judged(self) -> Concept:
        """The concept with its quality, if measurable."""
        return self.concept if self.inspection is None else replace(self.concept, quality=self.inspection.record)

    def save_pretrained(self, folder: str | Path, demonstrations: bool = False) -> None:
        """Write a folder to share: ``concept.safetensors`` with its quality, a film or picture of new samples, and a
        ``README.md`` unless it exists.

        Args:
            folder: folder to write.
            demonstrations: also write ``demonstrations.safetensors``; otherwise demonstrations stay private.

        Raises:
            UserError: if demonstrations are requested for a concept that was not learned in this process.
        """
        if demonstrations and self.demonstrations is None:
            raise UserError("demonstrations: expected a concept that was learned here, found a concept from a file; leave them out")
        shared = self.demonstrations if demonstrations else None
        write_folder(Path(folder), self.model, self._judged, self.tuned, self.known_as, shared)

    def push_to_hub(self, repository: str, private: bool = False, demonstrations: bool = False) -> str:
        """Upload the folder of :meth:`save_pretrained` to the Hugging Face Hub as ``owner/name``; needs a network and a login.

        Args:
            repository: name of the repository.
            private: whether a new repository is private.
            demonstrations: also upload the demonstrations.

        Returns:
            The address.

        Raises:
            UserError: for an invalid name or a failed upload.
        """
        return upload(lambda folder: self.save_pretrained(folder, demonstrations), repository, private)
