"""Evaluation as a callback: it says when behaviour is generated and judged, and who is told.

It works the same while fitting, in ``validate``, in ``test`` and after ``invert``; all it asks of a module is its generative
model and :class:`Evaluable`.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.domains.data import InversionData, PretrainingData
from ftl_lightning.errors import UserError, short
from ftl_lightning.evaluation.chosen import chosen
from ftl_lightning.evaluation.diversity import lines, real_behaviour
from ftl_lightning.evaluation.drawing import draw
from ftl_lightning.evaluation.evaluable import Evaluable, is_evaluable
from ftl_lightning.evaluation.films import write_films
from ftl_lightning.evaluation.generation import Generation, execute, generate, tasks_of
from ftl_lightning.evaluation.judged import TaskResult
from ftl_lightning.evaluation.record import record
from ftl_lightning.evaluation.references import references
from ftl_lightning.evaluation.rows import config_hash, configuration, rows
from ftl_lightning.evaluation.tensorboard import log_projector, log_test, own_rows, setting_means
from ftl_lightning.learning.checkpoint import Random
from ftl_lightning.printing import say
from ftl_lightning.ranges import expect_count

_LOG = logging.getLogger(__name__)


class Evaluator(pl.Callback):
    """Accuracy of generated behaviour.

    Args:
        suites: names of suites of the domain; ``None`` for the training concepts while fitting, for ``training`` and ``paper`` of
            concepts that a suite asks for, and for none of the user's own demonstrations. Tasks whose concept was not learned are
            left out; learned concepts that no suite asks for are judged by their own name, if the domain can read it.
        closed_loop: also execute plans, in domains that can, when testing (``test``, ``invert``).
        figures: how many samples of a task a TensorBoard figure shows; 0 for no figures.
        results: file to which rows are added when testing (``test``, ``invert``); ``None`` for ``results.csv`` in the log folder.
        references: also measure reference policies when testing; the same for every method, they are needed once a seed. ``None``
            for all but the user's own demonstrations.
        diversity: also measure novelty and coverage when testing, see :mod:`ftl_lightning.evaluation.diversity`; adds rows and
            changes none.
        films: JSON file to which films of the first :data:`~ftl_lightning.evaluation.films.FILMED` samples or episodes of each task
            are written when testing, for ``report --html``; ``None`` for none.
        variant: what tables tell of this run beside the method's name, in place of the method's own words.
        **generation: how behaviour is generated: the attributes of :class:`~ftl_lightning.evaluation.generation.Generation`, which
            are keys of a configuration beside the others.
    """

    def __init__(
        self,
        suites: Sequence[str] | None = None,
        closed_loop: bool = False,
        figures: int = 16,
        results: str | None = None,
        references: bool | None = None,
        diversity: bool = True,
        films: str | None = None,
        variant: str | None = None,
        **generation: Any,
    ) -> None:
        self.generation = Generation(**generation)
        expect_count("evaluation.figures", figures, 0, 1000)
        self.suites = None if suites is None else tuple(suites)
        self.closed_loop = closed_loop
        self.figures = figures
        self.results = results
        self.references = references
        self.diversity = diversity
        self.films = films
        self.variant = variant
        self.judged: list[TaskResult] = []
        self._projected = False

    def _asked(self, data: pl.LightningDataModule) -> tuple[str, ...]:
        """The suites that are evaluated, given what is learned from."""
        if self.suites is not None:
            return self.suites
        if not isinstance(data, InversionData):
            return ("training",)
        return () if data.own else ("training", "paper")

    def settings(self, data: pl.LightningDataModule) -> dict[str, Any]:
        """What is configured here, given what is learned from."""
        generation = self.generation
        # The suites too: the size of a batch decides how its numbers are rounded.
        return {
            "suites": ", ".join(self._asked(data)),
            "samples": generation.samples,
            "sampler": generation.sampler,
            "steps": generation.steps,
            "temperature": generation.temperature,
            "sample_seed": generation.seed,
            **({"replan": generation.replan} if self.closed_loop else {}),
            **({"environments": list(generation.environments)} if generation.environments else {}),
        }

    def config_hash(self, module: Evaluable, data: pl.LightningDataModule, trainer: pl.Trainer) -> str:
        """What the results file knows this evaluation by."""
        return config_hash(configuration(module, data, self.settings(data), trainer))

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Tell mistakes before hours of training, not after."""
        module = _evaluable(pl_module)
        total = module.model.max_steps
        if total is not None and self.generation.steps > total:
            raise UserError(f"evaluation.steps: expected 1 to {total} (the model's T), found {self.generation.steps}")
        loop = module.domain.closed_loop
        if self.closed_loop and loop is not None:
            loop.expect()
        others = () if loop is None else tuple(loop.others)
        if unknown := [name for name in self.generation.environments if name not in others]:
            told = f"one of {', '.join(others)}" if others else f"none, as {module.domain.name} has no other"
            raise UserError(f"evaluation.environments: expected {told}, found {short(unknown[0])!r}")
        tasks_of(module.domain, self._asked(_data(trainer)), module.concepts)

    on_fit_start = on_validation_start = on_test_start = _check

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``."""
        if trainer.sanity_checking:
            return
        module = _evaluable(pl_module)
        means: dict[str, float] = {}
        if trainer.is_global_zero:  # of several processes the first evaluates, and the others wait
            self._generate(module, _data(trainer))
            means = setting_means({(one.task.setting, one.task.name): one.values for one in self.judged})
        # Others go on with its global generators too, from which a domain's evaluation may draw.
        means, random = trainer.strategy.broadcast((means, Random.now(pl_module.device, 0)))
        if not trainer.is_global_zero:
            random.restore(pl_module.device)
        pl_module.log_dict({f"val/{name}": value for name, value in means.items()}, batch_size=1, sync_dist=True)
        if not trainer.is_global_zero:
            return
        for logger in _boards(trainer):
            self._draw(logger, module, trainer.global_step)
            if not self._projected:  # training embeddings do not change while fitting
                self._project(logger, module, trainer.global_step)

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate in ``test`` and at the end of ``invert``."""
        module, data = _evaluable(pl_module), _data(trainer)
        self._generate(module, data)
        if self.closed_loop and module.domain.closed_loop is not None:
            self.judged = execute(module, self.judged, self.generation)
        configured = configuration(module, data, self.settings(data), trainer)
        beside = self._compare(module, data) if self.judged else {}
        measured = rows(module, module.domain, self.judged, beside, configured, self.variant)
        record(measured, self.results, trainer.log_dir or trainer.default_root_dir)  # before anything is drawn, which may fail
        if self.films and trainer.is_global_zero:
            count = write_films(self.films, module.domain, self.judged, beside, measured)
            say(f"{self.films}: {count} films")
        own = own_rows(measured)
        for logger in _boards(trainer):
            self._draw(logger, module, trainer.global_step)
            self._project(logger, module, trainer.global_step)
            if own:
                log_test(logger, chosen(module, data, self.settings(data), trainer, own), measured, trainer.global_step)

    def _generate(self, module: Evaluable, data: PretrainingData | InversionData) -> None:
        tasks = tasks_of(module.domain, self._asked(data), module.concepts)
        self.judged = generate(module, tasks, self.generation, data.root)

    def _compare(self, module: Evaluable, data: PretrainingData | InversionData) -> Mapping[str, Sequence[TaskResult]]:
        """Measure novelty and coverage, and what stands beside the method's numbers: the reference lines by name."""
        domain, seed = module.domain, self.generation.seed
        compared = self.references if self.references is not None else not getattr(data, "own", False)
        beside = references(self.judged, domain, module.demonstrated, seed, self.generation.environments) if compared else {}
        if self.diversity:
            real = real_behaviour(self.judged, domain, module.demonstrated, data.root, seed)
            self.judged = [known.added(generated) for known, generated in zip(real, self.judged, strict=True)]
            beside |= lines(real) if compared else {}
        return beside

    def _draw(self, logger: TensorBoardLogger, module: Evaluable, step: int) -> None:
        try:
            if self.figures:
                draw(logger, self.judged, module.domain, module.demonstrated, self.figures, step)
        except Exception as error:  # whatever a domain's pictures raise: numbers are there already
            _LOG.warning("domain %s: its pictures cannot be drawn: %r", module.domain.name, error)

    def _project(self, logger: TensorBoardLogger, module: Evaluable, step: int) -> None:
        log_projector(logger, module.concept_points(), step)
        self._projected = True


def _evaluable(module: pl.LightningModule) -> Evaluable:
    """The module, if it can be evaluated.

    Raises:
        UserError: for one that generates no behaviour.
    """
    if not is_evaluable(module):
        raise UserError(f"model.class_path: expected a module that generates behaviour, found {type(module).__name__}")
    return module


def _data(trainer: pl.Trainer) -> PretrainingData | InversionData:
    """What the trainer was given to learn from, or to test on."""
    data: PretrainingData | InversionData = trainer.datamodule  # type: ignore[attr-defined]
    return data


def _boards(trainer: pl.Trainer) -> list[TensorBoardLogger]:
    return [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
