"""Evaluation as a callback: generates every task of a suite in one batch, judges it, and tells TensorBoard and the results file.

It works the same while fitting, in ``validate``, in ``test`` and after ``invert``; all it asks of a module is its generative
model and :class:`Generates`.
"""

import zlib
from collections.abc import Mapping, Sequence
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


def _public(hparams: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Hyper-parameters without those that Lightning's command line adds for itself."""
    return [(key, value) for key, value in hparams.items() if not key.startswith("_")]


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
            raise UserError(f"evaluation.sampler: expected one of {', '.join(SAMPLERS)}, found {sampler!r}")
        if samples < 1:
            raise UserError(f"evaluation.samples: expected 1 or more, found {samples}")
        if temperature < 0:
            raise UserError(f"evaluation.temperature: expected 0 or more, found {temperature}")
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

    def _tasks(self, domain: Domain, learned: Sequence[str]) -> list[EvaluationTask]:
        for name in self.suites:
            if name not in domain.suites:
                raise UserError(f"evaluation.suites: expected some of {', '.join(domain.suites)}, found {name!r}")
        tasks = [task for name in self.suites for task in domain.suites[name].tasks]
        asked = {task.learned for task in tasks}
        return tasks + [EvaluationTask(OWN, name, learned=name) for name in learned if name not in asked and domain.reads(name)]

    @torch.no_grad()
    def evaluate(self, module: Generates) -> list[Judged]:
        """Generate and judge every task in one batch of the network."""
        model = module.model
        domain = load_domain(model.config.domain)
        asked = self._tasks(domain, module.concepts)
        composed = {task: composition for task in asked if (composition := module.composition(task))}
        if not composed:
            return []
        states = model.sample(
            [embeddings for embeddings, _ in composed.values()],
            [weights for _, weights in composed.values()],
            self.samples,
            self.sampler,
            self.steps,
            self.temperature,
            [generator("cpu", self.seed, zlib.crc32(task.name.encode())) for task in composed],
        ).cpu()
        return [Judged.of(task, own, domain) for task, own in zip(composed, states, strict=True)]

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Tell mistakes before hours of training, not after."""
        if not isinstance(pl_module, Generates):
            raise UserError(f"model.class_path: expected a module that generates behaviour, found {type(pl_module).__name__}")
        total = len(pl_module.model.alpha_bar)
        if not 1 <= self.steps <= total:
            raise UserError(f"evaluation.steps: expected 1 to {total} (the model's T), found {self.steps}")
        self._tasks(load_domain(pl_module.model.config.domain), pl_module.concepts)

    on_fit_start = on_validation_start = on_test_start = _check

    def _run(self, trainer: pl.Trainer, module: pl.LightningModule, stage: str) -> None:
        if trainer.sanity_checking:
            return
        assert isinstance(module, Generates)
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
                if stage == "test" or not self._projected:  # training embeddings do not change while fitting
                    log_projector(logger, module.concept_embeddings(), trainer.global_step)
                    self._projected = True
                if stage == "test":
                    log_hparams(logger, self._configuration(module, trainer.datamodule), metrics)  # type: ignore[attr-defined]
        if stage == "test" and self.judged:
            path = self.results or Path(trainer.log_dir or trainer.default_root_dir) / "results.csv"
            append_rows(path, self._rows(module, trainer.datamodule))  # type: ignore[attr-defined]
            for name, value in metrics.items():
                print(f"{name.removeprefix('test/')}: {value:.2f}")
            print(f"rows written to {path}")

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
            **{f"model/{key}": value for key, value in _public(module.hparams) if key not in ("pretrained", "output")},
            **{f"data/{key}": value for key, value in _public(data.hparams) if key != "demonstrations"},
            **{f"evaluation/{key}": value for key, value in self.settings.items()},
            "model/pretrained": module.model.hash,
            **({"data/demonstrations": file_hash(own)} if own else {}),
        }

    def _rows(self, module: Generates, data: pl.LightningDataModule) -> list[Row]:
        domain = load_domain(module.model.config.domain)
        hparams = module.hparams
        ours = {
            "method": module.method,
            "K": hparams.get("components", 0),
            "omega": str(hparams.get("omega", hparams.get("guidance"))),
            "model_hash": module.model.hash,
            "config_hash": self.config_hash(module, data),
        }
        nobody = {"K": 0, "omega": "", "model_hash": "", "config_hash": content_hash([__version__, self.samples, self.seed])}

        def row(task: EvaluationTask, accuracy: float, what: dict[str, Any]) -> Row:
            subject = {"domain": domain.name, "setting": task.setting, "task": task.name, "seed": hparams["seed"]}
            return Row(**subject, **what, n=self.samples, metric="accuracy", value=round(accuracy, 6))

        references = [
            row(
                one.task,
                Judged.of(one.task, draw(one.task.goal, self.samples, self.seed), domain).accuracy,
                nobody | {"method": name},
            )
            for name, draw in domain.references.items()
            for one in self.judged
        ]
        return [row(one.task, one.accuracy, ours) for one in self.judged] + references

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``."""
        self._run(trainer, pl_module, "val")

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate in ``test`` and at the end of ``invert``."""
        self._run(trainer, pl_module, "test")
