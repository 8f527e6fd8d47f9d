"""Evaluation callback: generates and judges behaviour, logs it and writes results.

It works the same in ``fit``, ``validate``, ``test`` and after ``invert``, for any module that implements :class:`Evaluable`.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.evaluation.diversity import lines, real_behaviour
from ftl_lightning.evaluation.drawing import draw
from ftl_lightning.evaluation.evaluable import Evaluable, is_evaluable
from ftl_lightning.evaluation.films import write_films
from ftl_lightning.evaluation.generation import Generation, execute, generate, tasks_of
from ftl_lightning.evaluation.judged import TaskResult
from ftl_lightning.evaluation.references import references
from ftl_lightning.evaluation.results import config_hash, configuration, rows
from ftl_lightning.evaluation.summary import hparams_of, record
from ftl_lightning.evaluation.tensorboard import log_projector, log_test, own_rows, setting_means
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.printing import say
from ftl_lightning.services.ranges import check_count
from ftl_lightning.training.checkpoint import Random
from ftl_lightning.training.data import InversionData, PretrainingData

_LOG = logging.getLogger(__name__)


class Evaluator(pl.Callback):
    """Evaluates generated behaviour.

    Args:
        suites: names of suites of the domain; ``None`` for the training concepts while fitting, for ``training`` and ``paper`` when
            testing concepts of the domain, and for no suite with user demonstrations. Tasks whose concept was not learned are
            skipped; learned concepts outside all suites are judged by their name, if the domain can read it.
        closed_loop: execute plans when testing (``test``, ``invert``), in domains with an environment.
        figures: number of samples per task in a TensorBoard figure; 0 for no figures.
        results: file to which rows are added when testing (``test``, ``invert``); ``None`` for ``results.csv`` in the log folder.
        references: measure reference policies when testing. The rows are equal for all methods, so a single run per seed suffices.
            ``None`` for all data except user demonstrations.
        diversity: measure novelty and coverage when testing, see :mod:`ftl_lightning.evaluation.diversity`; only adds rows.
        films: JSON file for films of the first :data:`~ftl_lightning.evaluation.films.FILMED` samples or episodes of each task,
            written when testing, for ``report --html``; ``None`` for none.
        variant: label of this run in tables; ``None`` for the method's label.
        **generation: attributes of :class:`~ftl_lightning.evaluation.generation.Generation`, as keys of the same configuration.
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
        check_count("evaluation.figures", figures, 0, 1000)
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

    def _suite_names(self, data: pl.LightningDataModule) -> tuple[str, ...]:
        """Names of the evaluated suites."""
        if self.suites is not None:
            return self.suites
        if not isinstance(data, InversionData):
            return ("training",)
        return () if data.own else ("training", "paper")

    def settings(self, data: pl.LightningDataModule) -> dict[str, Any]:
        """Evaluation settings by name."""
        generation = self.generation
        # Suites are included because batch sizes affect rounding.
        return {
            "suites": ", ".join(self._suite_names(data)),
            "samples": generation.samples,
            "sampler": generation.sampler,
            "steps": generation.steps,
            "temperature": generation.temperature,
            "sample_seed": generation.seed,
            "replan": generation.replan if self.closed_loop else None,
            "environments": list(generation.environments),
        }

    def config_hash(self, module: Evaluable, data: pl.LightningDataModule, trainer: pl.Trainer) -> str:
        """Hash of the configuration in the results file."""
        return config_hash(configuration(module, data, self.settings(data), trainer))

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Validate the settings before training starts."""
        module = _evaluable(pl_module)
        total = module.model.max_steps
        if total is not None and self.generation.steps > total:
            raise UserError(f"evaluation.steps: expected 1 to {total} (the model's T), found {self.generation.steps}")
        loop = module.domain.closed_loop
        if self.closed_loop and loop is not None:
            loop.expect()
        others = () if loop is None else tuple(loop.others)
        if unknown := [name for name in self.generation.environments if name not in others]:
            expected = f"one of {', '.join(others)}" if others else f"none, as {module.domain.name} has no other"
            raise UserError(f"evaluation.environments: expected {expected}, found {short(unknown[0])!r}")
        tasks_of(module.domain, self._suite_names(_data(trainer)), module.concepts)

    on_fit_start = on_validation_start = on_test_start = _check

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``."""
        if trainer.sanity_checking:
            return
        module = _evaluable(pl_module)
        means: dict[str, float] = {}
        if trainer.is_global_zero:  # rank 0 evaluates, the other ranks wait
            self._generate(module, _data(trainer))
            means = setting_means({(result.task.setting, result.task.name): result.values for result in self.judged})
        # Synchronise the global generators, from which a domain's evaluation may draw.
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
        line_results = self._compare(module, data) if self.judged else {}
        measured = rows(module, module.domain, self.judged, line_results, configured, self.variant)
        record(measured, self.results, trainer.log_dir or trainer.default_root_dir)  # before drawing, which may fail
        if self.films and trainer.is_global_zero:
            count = write_films(self.films, module.domain, self.judged, line_results, measured)
            say(f"{self.films}: {count} films")
        method_rows = own_rows(measured)
        for logger in _boards(trainer):
            self._draw(logger, module, trainer.global_step)
            self._project(logger, module, trainer.global_step)
            if method_rows:
                log_test(logger, hparams_of(module, data, self.settings(data), trainer, method_rows), measured, trainer.global_step)

    def _generate(self, module: Evaluable, data: PretrainingData | InversionData) -> None:
        tasks = tasks_of(module.domain, self._suite_names(data), module.concepts)
        self.judged = generate(module, tasks, self.generation, data.root)

    def _compare(self, module: Evaluable, data: PretrainingData | InversionData) -> Mapping[str, Sequence[TaskResult]]:
        """Measure novelty and coverage, and return the reference lines by name."""
        domain, seed = module.domain, self.generation.seed
        compared = self.references if self.references is not None else not getattr(data, "own", False)
        line_results = references(self.judged, domain, module.demonstrated, seed, self.generation.environments) if compared else {}
        if self.diversity:
            real = real_behaviour(self.judged, domain, module.demonstrated, data.root, seed)
            self.judged = [known.added(generated) for known, generated in zip(real, self.judged, strict=True)]
            line_results |= lines(real) if compared else {}
        return line_results

    def _draw(self, logger: TensorBoardLogger, module: Evaluable, step: int) -> None:
        try:
            if self.figures:
                draw(logger, self.judged, module.domain, module.demonstrated, self.figures, step)
        except Exception as error:  # any error of a domain's pictures: results are already saved
            _LOG.warning("domain %s: its pictures cannot be drawn: %r", module.domain.name, error)

    def _project(self, logger: TensorBoardLogger, module: Evaluable, step: int) -> None:
        log_projector(logger, module.concept_points(), step)
        self._projected = True


def _evaluable(module: pl.LightningModule) -> Evaluable:
    """Check that a module can be evaluated.

    Raises:
        UserError: for a module that generates no behaviour.
    """
    if not is_evaluable(module):
        raise UserError(f"model.class_path: expected a module that generates behaviour, found {type(module).__name__}")
    return module


def _data(trainer: pl.Trainer) -> PretrainingData | InversionData:
    """The trainer's data module."""
    data: PretrainingData | InversionData = trainer.datamodule  # type: ignore[attr-defined]
    return data


def _boards(trainer: pl.Trainer) -> list[TensorBoardLogger]:
    return [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
