"""Adaptation of a frozen pretrained model to new concepts from a few demonstrations, for any method."""

import functools
import operator
from abc import ABC, abstractmethod
from pathlib import Path

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept, file_name
from ftl_lightning.igm.point import NEW_COMPONENT, Point
from ftl_lightning.services import log_folder
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.files import check_writable_file
from ftl_lightning.services.text import say
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.demonstration_check import warnings_of
from ftl_lightning.training.judging import judging_domain
from ftl_lightning.training.longer import longer_than_plans
from ftl_lightning.training.methods import adapts, kinds_for
from ftl_lightning.training.pretrained import load_model
from ftl_lightning.training.quality import inspected


class Adaptation(pl.LightningModule, ABC):
    """Base module of ``invert``: learn the concepts of an :class:`InversionData` and compose evaluation tasks.

    The pretrained model is frozen and stays in evaluation mode. Learned concepts are written to files.

    Args:
        pretrained: folder of the pretrained model.
        omega: guidance weight of training concepts, alone or composed with a learned concept.
        output: folder for the learned concepts; ``None`` for ``concepts`` in the log folder.

    Raises:
        UserError: for a folder without a model, or with a model of an unsupported kind.
    """

    learns = False
    """Whether concepts are learned by gradient descent, in training steps."""

    def __init__(self, pretrained: str, omega: float, output: str | None) -> None:
        super().__init__()
        self.model: ConceptModel = load_model(pretrained)
        kind = self.model.method.kind
        if not adapts(type(self), kind):
            expected = " or ".join(kinds_for(type(self))) or "another"
            message = f"expected a model of kind {expected}, found {kind} in {pretrained}"
            module = self.model.method.adaptation.replace(":", ".")
            raise UserError(f"model.pretrained: {message}, which model.class_path {module} adapts")
        self.domain = self.model.domain
        self._omega, self._output = omega, output
        self.concepts: tuple[str, ...] = ()
        self._found: dict[str, Concept] = {}
        self._own = False  # whether the demonstrations are a user's, not a domain's tasks

    @property
    def method(self) -> str:
        """The method's name in tables."""
        return self.model.method.name

    @property
    def form(self) -> str:
        """Suffix of the method's name in tables; empty for its default form."""
        return ""

    @property
    def variant(self) -> str:
        """Variant of the method in tables; may be empty."""
        return ""

    @abstractmethod
    def learned(self) -> dict[str, Concept]:
        """Learned concepts by name."""

    def configure_model(self) -> None:
        """Set the demonstrations and check that they fit the model.

        Raises:
            UserError: with the option, if they do not fit or concepts cannot be written.
        """
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, InversionData):
            raise UserError(f"data.class_path: expected InversionData, found {type(data).__name__}")
        mine = self.model.config.domain
        if data.domain_name != mine and (OWN in (mine, data.domain_name) or load_domain(data.domain_name) is not self.model.domain):
            raise UserError(f"data.domain: expected {mine!r} (the pretrained model's), found {data.domain_name!r}")
        self.concepts = data.concepts
        if len({file_name(name) for name in self.concepts}) < len(self.concepts):
            raise UserError(f"concepts: expected names that differ in their letters, found {short(', '.join(self.concepts), 150)}")
        for name in self.concepts:
            check_writable_file(self._file(name), "concepts")
        self._found = {}
        expected, columns = len(self.domain.plans.columns), data.demonstrations.states.shape[2]
        if columns != expected:
            raise UserError(f"data.demonstrations: expected states of {expected} columns (the pretrained model's), found {columns}")
        try:
            self.demonstrations: Demonstrations = data.demonstrations.fitted(self.domain.observed)
        except UserError as error:
            raise UserError(f"data.demonstrations: {error}") from None
        self._own = data.own
        if self.model.examples is not None:  # a user's data: new concepts are judged by their demonstrations
            self.domain = judging_domain(self.model, [self.model.examples, self.demonstrations])
        if note := longer_than_plans(self.demonstrations, self.model):
            say(f"note: {note}", error=True)
        for text in self.concepts if self._own else ():
            for note in warnings_of(self.model, self.demonstrations.select(text)):
                say(f"note: {text}: {note}", error=True)

    # Validation and test log the learned concepts' loss on common noise; the evaluator judges behaviour.
    def validation_step(self, step: int) -> None:
        self._log_loss("val/loss")

    def test_step(self, step: int) -> None:
        self._log_loss("test/loss")

    def _log_loss(self, name: str) -> None:
        self.log(name, sum(concept.origin.loss for concept in self._found.values()) / len(self._found), batch_size=1)

    def train(self, mode: bool = True) -> "Adaptation":
        """Switch modes; the pretrained model stays in evaluation mode."""
        super().train(mode)
        self.model.eval()
        return self

    @property
    def processes(self) -> int:
        """Number of learning processes; 1 with a plain Lightning trainer."""
        return int(getattr(self.trainer, "processes", 1))

    @property
    def folder(self) -> Path:
        """Folder of the learned concepts."""
        return Path(self._output or Path(self.trainer.log_dir or self.trainer.default_root_dir) / "concepts")

    def _file(self, concept: str) -> Path:
        return self.folder / f"{file_name(concept)}.safetensors"

    def find(self) -> None:
        """Learn the concepts and write each to a file."""
        self._found = self.learned()
        log_folder.keep()  # also without training
        for name, concept in self._found.items():
            path = self._file(name)
            concept.save(path)
            weights = ", ".join(f"{weight:.2f}" for weight in concept.weights.tolist())
            say(f"{path}: loss {concept.origin.loss:.3f}, weights {weights}")
            if concept.choice is not None:
                say(f"  form: {concept.choice}")
            if self._own:
                self._show_quality(name, concept)

    def _show_quality(self, name: str, concept: Concept) -> None:
        """Print the quality of a concept's samples, and draw them into TensorBoard."""
        demonstrations = self.demonstrations.select(name)
        if len(demonstrations) < 2 or self.model.config.horizon != self.domain.plans.horizon:  # some methods plan a step at a time
            return
        seen = inspected(self.model, self.domain, demonstrations, concept, self.hparams["seed"])
        say(f"  quality: {seen}")
        for logger in self.trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                tag = f"quality/{file_name(name)}"
                logger.experiment.add_figure(tag, seen.figure(), self.trainer.global_step)
                logger.experiment.add_text(tag, str(seen), self.trainer.global_step)

    def on_train_end(self) -> None:
        self.find()

    def on_validation_start(self) -> None:
        self._found = self.learned()

    def on_test_start(self) -> None:
        if self._found:  # training in the same process has just ended
            return
        if self.learns and self.processes == 1:
            self._found = self.learned()
        else:
            self.find()

    def training_weight(self, task: EvaluationTask) -> float:
        """Guidance weight of a task's training concepts."""
        return self._omega

    def composition(self, task: EvaluationTask) -> Composition | None:
        """Composition for a task; ``None`` if it needs a concept that was not learned here.

        The modes of a learned concept are used if it is not composed.
        """
        if len(task.learned) == 1 and task.component is None and not (task.texts or task.without):
            concept = self._found.get(task.learned[0])
            return None if concept is None else concept.composition.to(self.device)
        weights = [self.training_weight(task)] * len(task.texts) + [WITHOUT_WEIGHT] * len(task.without)
        embeddings = [self.model.concept(text)[None, None] for text in (*task.texts, *task.without)]
        parts = [Composition(text, text.new_tensor([weight])) for text, weight in zip(embeddings, weights, strict=True)]
        names = [*task.texts, *task.without, *task.learned]
        for name in task.learned:
            concept = self._found.get(name)
            if concept is None or (task.component or 0) > len(concept.weights):
                return None
            parts.append((concept.composition if task.component is None else concept.component(task.component)).to(self.device))
        plans, on = self.domain.plans, dict(task.on)
        parts = [
            part.on(plans.grouped(on[name]), len(plans.columns)) if name in on else part
            for name, part in zip(names, parts, strict=True)
        ]
        return functools.reduce(operator.add, parts)

    def demonstrated(self, concept: str) -> Demonstrations | None:
        """Demonstrations of a learned concept."""
        return self.demonstrations.select(concept)

    def concept_points(self) -> list[Point]:
        """All embeddings, for the projector: training concepts and learned components."""
        learned = [
            Point(name, NEW_COMPONENT, part.embedding, part)
            for name, concept in self._found.items()
            for part in concept.parts().values()
        ]
        return self.model.points() + learned
