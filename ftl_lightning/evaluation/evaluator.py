"""Evaluation callback: generates and judges behaviour, logs it and writes results.

It works the same in ``fit``, ``validate``, ``test`` and after ``invert``, for any module that implements :class:`Evaluable`.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.generation import Evaluable, Generation, TaskResult, evaluable, execute, generate, tasks_of
from ftl_lightning.evaluation.pictures import write_films
from ftl_lightning.evaluation.references import lines, real_behaviour, references
from ftl_lightning.evaluation.results import config_hash, configuration, rows
from ftl_lightning.evaluation.rollout import Place, environment_of, played
from ftl_lightning.evaluation.summary import hparams_of, own_rows, record
from ftl_lightning.evaluation.tensorboard import draw, log_projector, log_test, setting_means
from ftl_lightning.services.errors import require, shown
from ftl_lightning.services.text import say
from ftl_lightning.services.validation import check_count
from ftl_lightning.training.checkpoint import Random
from ftl_lightning.training.data import InversionData, PretrainingData

FIRST = 100
"""Steps of ``fit`` after which behaviour is evaluated first."""
_LOG = logging.getLogger(__name__)


class Evaluator(pl.Callback):
    """Evaluates generated behaviour.

    Args:
        suites: names of suites of the domain; ``None`` for the training concepts while fitting, for ``training`` and ``paper`` when
            testing concepts of the domain, and for no suite with user demonstrations. Tasks whose concept was not learned are
            skipped; learned concepts outside all suites are judged by their name, if the domain can read it.
        closed_loop: execute plans when testing (``test``, ``invert``), in domains with an environment.
        fit_episodes: number of episodes of each task that are executed at each evaluation of ``fit``, as curves; 0 for none.
        environment: for a user's data, the environment in which policies of the concepts act, see
            :func:`~ftl_lightning.evaluation.rollout.environment_of`; ``None`` for none.
        success: ``'info.KEY'`` of the environment's success, see :meth:`FewShot.rollout
            <ftl_lightning.few_shot.learner.FewShot.rollout>`.
        figures: number of samples per task in a TensorBoard figure; 0 for no figures.
        results: file to which rows are added when testing (``test``, ``invert``); ``None`` for ``results.csv`` in the log folder.
        references: measure reference policies when testing. The rows are equal for all methods, so a single run per seed suffices.
            ``None`` for all data except user demonstrations.
        diversity: measure novelty and coverage when testing, see :mod:`ftl_lightning.evaluation.references`; only adds rows.
        films: JSON file for films of the first :data:`~ftl_lightning.evaluation.pictures.FILMED` samples or episodes of each task,
            written when testing, for ``report --html``; ``None`` for none.
        variant: label of this run in tables; ``None`` for the method's label.
        **generation: attributes of :class:`~ftl_lightning.evaluation.generation.Generation`, as keys of the same configuration.
    """

    def __init__(
        self,
        suites: Sequence[str] | None = None,
        closed_loop: bool = False,
        fit_episodes: int = 0,
        environment: str | None = None,
        success: str | None = None,
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
        check_count("evaluation.fit_episodes", fit_episodes, 0)
        self.suites = None if suites is None else tuple(suites)
        self.closed_loop, self.figures, self.results, self.references = closed_loop, figures, results, references
        self.diversity, self.films, self.variant = diversity, films, variant
        self.fit_episodes, self.environment, self.success = fit_episodes, environment, success
        self.judged: list[TaskResult] = []
        self._drawn = self._began = False

    def _suite_names(self, data: pl.LightningDataModule) -> tuple[str, ...]:
        """Names of the evaluated suites."""
        if self.suites is not None:
            return self.suites
        if not isinstance(data, InversionData):
            return ("training",)
        return () if data.of_user else ("training", "paper")

    def settings(self, data: pl.LightningDataModule) -> dict[str, Any]:
        """Evaluation settings by name."""
        generation = self.generation
        # Suites are included because batch sizes affect rounding.
        acted = {} if self.environment is None else {"environment": self.environment, "success": self.success}
        return acted | {
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

    def _tasks(self, module: Evaluable, data: PretrainingData | InversionData) -> list[EvaluationTask]:
        return tasks_of(module.domain, self._suite_names(data), module.concepts)

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Validate the settings before training starts."""
        module = evaluable(pl_module)
        total, steps = module.model.max_steps, self.generation.steps
        require(total is None or steps <= total, "evaluation.steps", f"1 to {total} (the model's T)", steps)
        loop = module.domain.closed_loop
        if self.closed_loop and loop is not None:
            loop.expect()
        others = () if loop is None else tuple(loop.others)
        expected = f"one of {', '.join(others)}" if others else f"none, as {module.domain.name} has no other"
        for name in self.generation.environments:
            require(name in others, "evaluation.environments", expected, shown(name))
        if self.environment is not None:
            own = loop is None and module.model.examples is not None
            require(own, "evaluation.environment", f"none, as {module.domain.name} has its own", self.environment)
            environment_of(self.environment, "evaluation.environment")
        self._tasks(module, _data(trainer))

    def _acted(self, module: Evaluable, judged: Sequence[TaskResult], episodes: int) -> list[TaskResult]:
        """The first ``episodes`` of each task, executed, in the domain's environment or in that of the user."""
        if not judged:
            return []
        if self.environment is not None:
            compositions = [known for behaviour in judged if (known := module.composition(behaviour.task)) is not None]
            place = Place(self.environment, self.success, episodes)
            return played(module.model, judged, compositions, place, self.generation)
        if not self.closed_loop or module.domain.closed_loop is None:
            return list(judged)
        return execute(module, [behaviour.first(episodes) for behaviour in judged], self.generation)

    on_fit_start = on_validation_start = on_test_start = _check

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Evaluate after :data:`FIRST` steps of ``fit``, if no validation comes earlier, without pictures.

        The model does not depend on it.
        """
        pretrains = isinstance(_data(trainer), PretrainingData) and trainer.enable_validation
        if pretrains and not self._began and trainer.global_step == FIRST < (trainer.val_check_batch or torch.inf):
            self._began = True
            random = Random.now(pl_module.device, 0)
            with torch.no_grad():
                means = self._evaluate(trainer, pl_module)
            random.restore(pl_module.device)
            for logger in trainer.loggers:
                logger.log_metrics(means, trainer.global_step)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``; while fitting, draw at the first and the last validation."""
        if trainer.sanity_checking:
            return
        means = self._evaluate(trainer, pl_module)
        pl_module.log_dict(means, batch_size=1, sync_dist=True)
        ended = trainer.state.fn != "fit" or trainer.global_step >= trainer.max_steps
        if trainer.is_global_zero and (ended or not self._drawn):  # pictures take several times as long as sampling them
            self._draw(trainer, evaluable(pl_module), project=not self._drawn, film=ended)  # training embeddings do not change

    def _evaluate(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, float]:
        """Generate and judge the behaviour of all tasks; return the means over each setting."""
        module, data = evaluable(pl_module), _data(trainer)
        means: dict[str, float] = {}
        if trainer.is_global_zero:  # rank 0 evaluates, the other ranks wait
            self.judged = generate(module, self._tasks(module, data), self.generation, data.root)
            if self.fit_episodes and trainer.state.fn == "fit":
                acted = self._acted(module, self.judged, self.fit_episodes)
                self.judged = [replace(full, outcomes=some.outcomes) for full, some in zip(self.judged, acted, strict=True)]
            means = setting_means((done.task.setting, *measured) for done in self.judged for measured in done.values.items())
        # Synchronise the global generators, from which a domain's evaluation may draw.
        means, random = trainer.strategy.broadcast((means, Random.now(pl_module.device, 0)))
        if not trainer.is_global_zero:
            random.restore(pl_module.device)
        return {f"val/{name}": value for name, value in means.items()}

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate in ``test`` and at the end of ``invert``."""
        module, data = evaluable(pl_module), _data(trainer)
        domain, settings = module.domain, self.settings(data)
        self.judged = generate(module, self._tasks(module, data), self.generation, data.root)
        self.judged = self._acted(module, self.judged, self.generation.samples)
        reference_lines = self._compare(domain, data) if self.judged else {}
        configured = configuration(module, data, settings, trainer)
        measured = rows(module, domain, self.judged, reference_lines, configured, self.variant)
        record(measured, self.results, trainer.log_dir or trainer.default_root_dir)  # before drawing, which may fail
        if self.films and trainer.is_global_zero:
            say(f"{self.films}: {write_films(self.films, domain, self.judged, reference_lines, measured)} films")
        self._draw(trainer, module)
        if method_rows := own_rows(measured):
            hparams = hparams_of(module, data, settings, trainer, method_rows)
            for logger in _boards(trainer):
                log_test(logger, hparams, measured, trainer.global_step)

    def _compare(self, domain: Domain, data: PretrainingData | InversionData) -> Mapping[str, Sequence[TaskResult]]:
        """Measure novelty and coverage, and return the references by name."""
        seed, environments = self.generation.seed, self.generation.environments
        compared = self.references if self.references is not None else not getattr(data, "of_user", False)
        reference_lines = references(self.judged, domain, seed, environments) if compared else {}
        if self.diversity:
            real = real_behaviour(self.judged, domain, data.root, seed)
            self.judged = [known.added(generated) for known, generated in zip(real, self.judged, strict=True)]
            reference_lines |= lines(real) if compared else {}
        return reference_lines

    def _draw(self, trainer: pl.Trainer, module: Evaluable, project: bool = True, film: bool = True) -> None:
        """Log pictures, films and concept embeddings to TensorBoard."""
        for logger in _boards(trainer):
            try:
                if self.figures:
                    draw(logger, self.judged, module.domain, self.figures, trainer.global_step, film)
            except Exception as error:  # any error of a domain's pictures: results are already saved
                _LOG.warning("domain %s: its pictures cannot be drawn: %r", module.domain.name, error)
            if project:
                log_projector(logger, module.concept_points(), trainer.global_step)
        self._drawn = True


def _data(trainer: pl.Trainer) -> PretrainingData | InversionData:
    data: PretrainingData | InversionData = trainer.datamodule  # type: ignore[attr-defined]
    return data


def _boards(trainer: pl.Trainer) -> list[TensorBoardLogger]:
    return [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
