"""Evaluation as a callback: generates every task of a suite in one batch, judges it, and tells TensorBoard and the results file.

It works the same while fitting, in ``validate``, in ``test`` and after ``invert``; all it asks of a module is its generative
model and :class:`Generates`.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torchmetrics import MeanMetric

from ftl_lightning import __version__
from ftl_lightning.diffusion.samplers import SAMPLERS
from ftl_lightning.domains.domain import Domain, EvaluationTask, Suite, load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.results import Row, append_rows
from ftl_lightning.evaluation.tensorboard import log_hparams, log_projector
from ftl_lightning.learning.generative_model import GenerativeModel
from ftl_lightning.seeding import generator
from ftl_lightning.tensor_file import content_hash, file_hash

OWN = "own demonstrations"
"""The setting of learned concepts that no suite asks for."""


@runtime_checkable
class Generates(Protocol):
    """What an evaluated module offers: the model, names of the method and of learned concepts, and embeddings."""

    model: GenerativeModel
    hparams: Any

    @property
    def method(self) -> str: ...

    @property
    def concepts(self) -> tuple[str, ...]: ...

    def composition(self, task: EvaluationTask) -> tuple[Tensor, Tensor] | None: ...

    def concept_embeddings(self) -> dict[str, Tensor]: ...


@dataclass(frozen=True)
class Judged:
    """Generated behaviour of one task: states ``(sample, horizon, state)`` and whether each is right ``(sample,)``."""

    task: EvaluationTask
    states: Tensor
    right: Tensor

    @classmethod
    def of(cls, task: EvaluationTask, states: Tensor, domain: Domain) -> Self:
        """Judge states by the task's goal."""
        return cls(task, states, domain.succeeded(task.goal, states))

    @property
    def accuracy(self) -> float:
        """Share of right samples."""
        metric = MeanMetric()
        metric.update(self.right.float())
        return float(metric.compute())


def standard_error(values: Sequence[float]) -> float:
    """Standard error of the mean over tasks; 0 for a single one."""
    count = len(values)
    return float(torch.tensor(values).std() / count**0.5) if count > 1 else 0.0


class Evaluator(pl.Callback):
    """Accuracy of generated behaviour.

    Args:
        suites: names of suites of the domain. Tasks whose concept was not learned are left out; learned concepts that no suite
            asks for are judged by their own name, if the domain can read it.
        samples: generated for each task; the paper's number is 50.
        sampler: ``'ddpm'`` (the paper's), ``'ddim'`` or ``'dpm_solver'``.
        steps: of the sampler, at most the model's T.
        temperature: the paper's alpha.
        figures: how many samples of a task a TensorBoard figure shows; 0 for no figures.
        results: file to which rows are added when testing (``test``, ``invert``); ``None`` for ``results.csv`` in the log folder.
        seed: of the samples.
    """

    def __init__(
        self,
        suites: Sequence[str] = ("training",),
        samples: int = 50,
        sampler: str = "ddpm",
        steps: int = 100,
        temperature: float = 0.1,
        figures: int = 16,
        results: str | None = None,
        seed: int = 0,
    ) -> None:
        if sampler not in SAMPLERS:
            raise UserError(f"sampler: expected one of {', '.join(SAMPLERS)}, found {sampler!r}")
        self.suites = tuple(suites)
        # The suites too: the size of a batch decides how its numbers are rounded.
        self.settings = {
            "suites": ", ".join(suites),
            "samples": samples,
            "sampler": sampler,
            "steps": steps,
            "temperature": temperature,
            "sample_seed": seed,
        }
        self.samples, self.sampler, self.steps, self.temperature = samples, SAMPLERS[sampler], steps, temperature
        self.figures = figures
        self.results = results
        self.seed = seed
        self.judged: list[Judged] = []
        self._projected = False

    def _tasks(self, domain: Domain, module: Generates) -> Suite:
        for name in self.suites:
            if name not in domain.suites:
                raise UserError(f"suites: expected some of {', '.join(domain.suites)}, found {name!r}")
        tasks = [task for name in self.suites for task in domain.suites[name].tasks]
        asked = {task.learned for task in tasks}
        tasks += [EvaluationTask(OWN, name, learned=name) for name in module.concepts if name not in asked and domain.reads(name)]
        return Suite(tuple(task for task in tasks if module.composition(task)))

    @torch.no_grad()
    def evaluate(self, module: Generates) -> list[Judged]:
        """Generate and judge every task in one batch of the network."""
        model = module.model
        domain = load_domain(model.config.domain)
        tasks = self._tasks(domain, module).tasks
        compositions = [composition for task in tasks if (composition := module.composition(task))]
        if not compositions:
            return []
        states = model.sample(
            [embeddings for embeddings, _ in compositions],
            [weights for _, weights in compositions],
            self.samples,
            self.sampler,
            self.steps,
            self.temperature,
            [generator("cpu", self.seed, zlib.crc32(task.name.encode())) for task in tasks],
        ).cpu()
        return [Judged.of(task, own, domain) for task, own in zip(tasks, states, strict=True)]

    def _run(self, trainer: pl.Trainer, module: pl.LightningModule, stage: str) -> None:
        if trainer.sanity_checking:
            return
        if not isinstance(module, Generates):
            raise UserError(f"model.class_path: expected a module that generates behaviour, found {type(module).__name__}")
        self.judged = self.evaluate(module)
        domain = load_domain(module.model.config.domain)
        metrics: dict[str, float] = {}
        for setting in Suite(tuple(one.task for one in self.judged)).settings:
            values = [one.accuracy for one in self.judged if one.task.setting == setting]
            metrics[f"{stage}/accuracy/{setting}"] = sum(values) / len(values)
            metrics[f"{stage}/standard error/{setting}"] = standard_error(values)
        each = {f"{stage}/accuracy/{one.task.setting}/{one.task.name}": one.accuracy for one in self.judged}
        module.log_dict(metrics | each, batch_size=1)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                self._draw(logger, domain, trainer.global_step)
                if not self._projected:  # training embeddings do not change while fitting
                    log_projector(logger, module.concept_embeddings(), trainer.global_step)
                    self._projected = True
                if stage == "test":
                    log_hparams(logger, self._configuration(module, trainer.datamodule), metrics)  # type: ignore[attr-defined]
        if stage == "test" and self.judged:
            path = self.results or Path(trainer.log_dir or trainer.default_root_dir) / "results.csv"
            append_rows(path, self._rows(module, trainer.datamodule))  # type: ignore[attr-defined]

    def _draw(self, logger: TensorBoardLogger, domain: Domain, step: int) -> None:
        for one in self.judged if self.figures else ():
            shown = slice(0, self.figures)
            figure = domain.render(one.states[shown], one.right[shown].tolist(), f"{one.task.name}: {one.accuracy:.2f}")
            logger.experiment.add_figure(f"{one.task.setting}/{one.task.name}", figure, step)

    def config_hash(self, module: Generates, data: pl.LightningDataModule) -> str:
        """16 hexadecimal digits that everything configured decides: model, data, evaluation and the pretrained weights."""
        return content_hash([__version__, self._configuration(module, data)])

    def _configuration(self, module: Generates, data: pl.LightningDataModule) -> dict[str, Any]:
        own = data.hparams.get("demonstrations")
        return {
            **{f"model/{key}": value for key, value in dict(module.hparams).items() if key not in ("pretrained", "output")},
            **{f"data/{key}": value for key, value in dict(data.hparams).items() if key != "demonstrations"},
            **{f"evaluation/{key}": value for key, value in self.settings.items()},
            "model/pretrained": module.model.hash,
            **({"data/demonstrations": file_hash(own)} if own else {}),
        }

    def _rows(self, module: Generates, data: pl.LightningDataModule) -> list[Row]:
        hparams = module.hparams
        model_hash, config_hash = module.model.hash, self.config_hash(module, data)
        domain = load_domain(module.model.config.domain)

        def row(task: EvaluationTask, method: str, components: int, omega: str, value: float) -> Row:
            return Row(
                domain=domain.name,
                setting=task.setting,
                task=task.name,
                method=method,
                K=components,
                omega=omega,
                seed=hparams["seed"],
                n=self.samples,
                metric="accuracy",
                value=round(value, 6),
                model_hash=model_hash,
                config_hash=config_hash,
            )

        omega = str(hparams.get("omega", hparams.get("guidance")))
        ours = [row(one.task, module.method, hparams.get("components", 0), omega, one.accuracy) for one in self.judged]
        references = [
            row(one.task, name, 0, "", Judged.of(one.task, policy(one.task.goal, self.samples, self.seed), domain).accuracy)
            for name, policy in domain.references.items()
            for one in self.judged
        ]
        return ours + references

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``."""
        self._run(trainer, pl_module, "val")

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate in ``test`` and at the end of ``invert``."""
        self._run(trainer, pl_module, "test")
