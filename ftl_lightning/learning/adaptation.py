"""Adapting a frozen pretrained model to new concepts from a few demonstrations, whatever the method."""

import functools
import operator
from abc import ABC, abstractmethod
from pathlib import Path

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning import log_folder
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept, file_name
from ftl_lightning.concepts.point import NEW_COMPONENT, Point
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.data import InversionData
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.errors import UserError, short
from ftl_lightning.judging import judging_domain
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.demonstration_check import warnings_of
from ftl_lightning.learning.longer import longer_than_plans
from ftl_lightning.learning.methods import adapts, kinds_for
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.learning.quality import inspected
from ftl_lightning.printing import say
from ftl_lightning.targets import expect_writable_file


class Adaptation(pl.LightningModule, ABC):
    """What ``invert`` asks of a method: the concepts of an :class:`InversionData`, and what generates an evaluation task.

    The pretrained model is frozen and stays in evaluation mode. Concepts are written to files when they are found.

    Args:
        pretrained: folder of the pretrained model.
        omega: guidance weight of training concepts that are generated or composed with a learned one.
        output: folder for the learned concepts; ``None`` for ``concepts`` in the log folder.

    Raises:
        UserError: for a folder that holds no model, or one of a kind that this does not adapt.
    """

    learns = False
    """Whether concepts are learned by gradient descent, for which there are training steps."""

    def __init__(self, pretrained: str, omega: float, output: str | None) -> None:
        super().__init__()
        self.model: ConceptModel = load_model(pretrained)
        kind = self.model.method.kind
        if not adapts(type(self), kind):
            expected = " or ".join(kinds_for(type(self))) or "another"
            told = f"expected a model of kind {expected}, found {kind} in {pretrained}"
            module = self.model.method.adaptation.replace(":", ".")
            raise UserError(f"model.pretrained: {told}, which model.class_path {module} adapts")
        self.domain = self.model.domain
        self._omega, self._output = omega, output
        self.concepts: tuple[str, ...] = ()
        self._found: dict[str, Concept] = {}
        self._own = False  # whether somebody's own demonstrations are learned from, not a domain's tasks

    @property
    def method(self) -> str:
        """The method's name in tables."""
        return self.model.method.name

    @property
    def form(self) -> str:
        """How its concepts are otherwise than in the method's usual form, in words behind its name in tables; empty for that."""
        return ""

    @property
    def variant(self) -> str:
        """What tells it apart from others of the same method in tables; may be empty."""
        return ""

    @abstractmethod
    def learned(self) -> dict[str, Concept]:
        """The concepts by name."""

    def configure_model(self) -> None:
        """Take the demonstrations over and check that they fit the model.

        Raises:
            UserError: naming the option, where they do not, or concepts cannot be written.
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
            expect_writable_file(self._file(name), "concepts")
        self._found = {}
        expected, found = len(self.domain.plans.columns), data.demonstrations.states.shape[2]
        if found != expected:
            raise UserError(f"data.demonstrations: expected states of {expected} columns (the pretrained model's), found {found}")
        try:
            self.demonstrations: Demonstrations = data.demonstrations.fitted(self.domain.observed)
        except UserError as error:
            raise UserError(f"data.demonstrations: {error}") from None
        self._own = data.own
        if self.model.examples is not None:  # of a user's own data, whose new concepts are judged by their demonstrations
            self.domain = judging_domain(self.model, [self.model.examples, self.demonstrations])
        if told := longer_than_plans(self.demonstrations, self.model):
            say(f"note: {told}", error=True)
        for text in self.concepts if self._own else ():
            for told in warnings_of(self.model, self.demonstrations.select(text)):
                say(f"note: {text}: {told}", error=True)

    # Validation and test log the learned concepts' loss on common noise; behaviour is judged by the evaluator.
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
        """In which concepts are learned; 1 with a trainer of Lightning's own."""
        return int(getattr(self.trainer, "processes", 1))

    @property
    def folder(self) -> Path:
        """Where the learned concepts are written."""
        return Path(self._output or Path(self.trainer.log_dir or self.trainer.default_root_dir) / "concepts")

    def _file(self, concept: str) -> Path:
        return self.folder / f"{file_name(concept)}.safetensors"

    def find(self) -> None:
        """Write every concept to a file of its own."""
        self._found = self.learned()
        log_folder.keep()  # also where nothing is trained
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
        """Say what samples of a concept are like beside its demonstrations, and draw them into TensorBoard."""
        own = self.demonstrations.select(name)
        if len(own) < 2 or self.model.config.horizon != self.domain.plans.horizon:  # some methods plan a step at a time
            return
        seen = inspected(self.model, self.domain, own, concept, self.hparams["seed"])
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
        """What generates a task, or ``None`` if a concept of it was not learned here.

        The modes of a learned concept are used where it stands alone.
        """
        if len(task.learned) == 1 and task.component is None and not (task.texts or task.without):
            found = self._found.get(task.learned[0])
            return None if found is None else found.composition.to(self.device)
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
        """What a concept was learned from."""
        return self.demonstrations.select(concept)

    def concept_points(self) -> list[Point]:
        """Every embedding, for the projector: training concepts and learned components."""
        learned = [
            Point(name, NEW_COMPONENT, part.embedding, part)
            for name, concept in self._found.items()
            for part in concept.parts().values()
        ]
        return self.model.points() + learned
