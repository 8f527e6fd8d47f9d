"""Adaptation of a frozen pretrained model to new concepts from a few demonstrations, for any method."""

import functools
import operator
from abc import ABC, abstractmethod
from pathlib import Path
from typing import NamedTuple

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import OWN
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import WITHOUT_WEIGHT, EvaluationTask
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import NEW_COMPONENT, Concept, Point, file_name
from ftl_lightning.igm.library import concept_files, write_concept
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.services import log_folder
from ftl_lightning.services.errors import UserError, note, require
from ftl_lightning.services.modes import usual_modes
from ftl_lightning.services.store import is_url
from ftl_lightning.training.checks import longer_than_plans, notes_of
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import kinds_for, load_model
from ftl_lightning.training.quality import Inspection, inspected, judging_domain


class Labels(NamedTuple):
    """Labels of an adaptation's rows in tables.

    Attributes:
        method: name of the method.
        form: form of the concepts; empty for the paper's form, a single set of embeddings constant over time.
        variant: parametrisation of the embeddings and other options, separated by commas.
    """

    method: str
    form: str = ""
    variant: str = ""


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
    """Whether concepts are learned by gradient descent."""
    automatic_optimization = False

    def __init__(self, pretrained: str, omega: float, output: str | None) -> None:
        super().__init__()
        require(output is None or not is_url(output), "model.output", "a folder on this machine", output)
        self.model: ConceptModel = load_model(pretrained)
        if not self.adapts(type(self.model)):
            expected = f"a model of kind {' or '.join(kinds_for(self.adapts)) or 'another'}"
            other = "inversion_module.InversionModule" if self.model.invertible else "adaptation.LearnerAdaptation"
            hint = f"which model.class_path ftl_lightning.training.{other} adapts"
            raise UserError(f"model.pretrained: expected {expected}, found {self.model.kind} in {pretrained}, {hint}")
        self.domain = self.model.domain
        self._omega, self._output = omega, output
        self.concepts: tuple[str, ...] = ()
        self._learned: dict[str, Concept] = {}
        self._of_user = False  # whether the demonstrations are a user's, not of a domain's tasks

    @property
    def labels(self) -> Labels:
        """Labels of the rows in tables; by default the method's name alone."""
        return Labels(self.model.method.name)

    @classmethod
    @abstractmethod
    def adapts(cls, model: type[ConceptModel]) -> bool:
        """Whether the module adapts models of this class."""

    @property
    def method(self) -> str:
        """The method's name in tables."""
        return self.labels.method

    @property
    def form(self) -> str:
        """Suffix of the method's name in tables; empty for its default form."""
        return self.labels.form

    @property
    def variant(self) -> str:
        """Variant of the method in tables; may be empty."""
        return self.labels.variant

    @abstractmethod
    def learn(self) -> dict[str, Concept]:
        """Learn the concepts of :attr:`demonstrations`."""

    def learned(self) -> dict[str, Concept]:
        """Concepts by name, which are learned once."""
        self._learned = self._learned or self.learn()
        return self._learned

    def configure_model(self) -> None:
        """Set the demonstrations and check that they fit the model.

        Raises:
            UserError: with the option, if they do not fit or concepts cannot be written.
        """
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, InversionData):
            raise UserError(f"data.class_path: expected InversionData, found {type(data).__name__}")
        trained = self.model.config.domain
        names = trained, data.domain_name
        if len(set(names)) > 1 and (OWN in names or load_domain(data.domain_name) is not self.model.domain):
            raise UserError(f"data.domain: expected {trained!r} (the pretrained model's), found {data.domain_name!r}")
        self.concepts = data.concepts
        self.files = concept_files(self.concepts, self.folder, "concepts")
        self._learned = {}
        try:
            self.demonstrations: Demonstrations = self.domain.fitted(data.demonstrations)
        except UserError as error:
            raise UserError(f"data.demonstrations: {error}") from None
        self._of_user = data.of_user
        if self.model.examples is not None:  # a user's data: new concepts are judged by their demonstrations
            self.domain = judging_domain(self.model, [self.model.examples, self.demonstrations])
        longer = longer_than_plans(self.demonstrations, self.model)
        for text in notes_of(self.model, self.demonstrations) if self._of_user and data.check else [longer] if longer else []:
            note(f"{data.hparams['demonstrations']}: {text}" if self._of_user else text)

    def training_step(self, batch: int) -> None:
        """Learn all concepts."""
        self.find()

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """None: :meth:`learn` makes all gradient steps."""
        return []

    def test_step(self, batch: int) -> None:
        """Log the loss of the learned concepts on common noise; the evaluator judges behaviour."""
        losses = [concept.origin.loss for concept in self._learned.values()]
        self.log("test/loss", sum(losses) / len(losses), batch_size=1)

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

    @usual_modes()
    def find(self) -> None:
        """Learn the concepts and write each to a file."""
        log_folder.keep()  # also without training
        for name, concept in self.learned().items():
            write_concept(concept, self.files[name], self._quality(name, concept) if self._of_user else None)

    def _quality(self, name: str, concept: Concept) -> Inspection | None:
        """Quality of the samples of a user's concept, or ``None`` if it cannot be measured; TensorBoard has quality and skills."""
        inspection = inspected(self.model, self.domain, self.demonstrations.select(name), concept)
        for logger in self.trainer.loggers if inspection else ():
            if inspection and isinstance(logger, TensorBoardLogger):
                tag = f"quality/{file_name(name)}"
                logger.experiment.add_figure(tag, inspection.figure(), self.trainer.global_step)
                logger.experiment.add_text(tag, str(inspection), self.trainer.global_step)
                for form, skill in (concept.choice.skills if concept.choice else {}).items():
                    logger.experiment.add_scalar(f"skill/{file_name(name)}/{form}", skill, self.trainer.global_step)
        return inspection

    def on_test_start(self) -> None:
        if not self._learned:  # else training in the same process has just ended
            self.find()

    def training_weight(self, task: EvaluationTask) -> float:
        """Guidance weight of a task's training concepts."""
        return self._omega

    def composition(self, task: EvaluationTask) -> Composition | None:
        """Composition for a task; ``None`` if it needs a concept that was not learned here.

        The modes of a learned concept are used if it is not composed.
        """
        if len(task.learned) == 1 and task.component is None and not (task.texts or task.without):
            concept = self._learned.get(task.learned[0])
            return None if concept is None else concept.composition.to(self.device)
        weights = [self.training_weight(task)] * len(task.texts) + [WITHOUT_WEIGHT] * len(task.without)
        texts = (*task.texts, *task.without)
        parts = [weight * self.model[text] for text, weight in zip(texts, weights, strict=True)]
        names = [*task.texts, *task.without, *task.learned]
        for name in task.learned:
            concept = self._learned.get(name)
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
            for name, concept in self._learned.items()
            for part in concept.parts().values()
        ]
        return self.model.points() + learned


class LearnerAdaptation(Adaptation):
    """Read concepts from demonstrations, without gradient descent.

    Args:
        pretrained: folder of the pretrained model.
        output: folder for the concepts; ``None`` for ``concepts`` in the log folder.
        seed: seed of the evaluation's rows.
    """

    def __init__(self, pretrained: str, output: str | None = None, seed: int = 0) -> None:
        super().__init__(pretrained, 1.0, output)
        self.save_hyperparameters()

    @classmethod
    def adapts(cls, model: type[ConceptModel]) -> bool:
        return not model.invertible

    def learn(self) -> dict[str, Concept]:
        return self.model.learn_concepts(self.demonstrations, InversionSettings(), steps=0)
