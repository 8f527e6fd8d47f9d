"""Curves and progress of a run: TensorBoard log, learning rate, progress bar."""

import re
import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from torch.optim import Optimizer

from ftl_lightning.services.progress import Advance, bar

PICTURES, FILMS, ROLLOUTS = "1 pictures", "2 plans in motion", "3 rollouts"
"""Groups of pictures of plans, films of plans and films of episodes. TensorBoard sorts groups by name: these precede curves."""
RESULTS = "test results"
"""Group of test results, a single point each."""


def tag(name: str) -> str:
    """Tag of a logged number: ``'train/loss'`` becomes ``'loss/train'``, ``'val/accuracy/SETTING'`` ``'accuracy/SETTING'``.

    TensorBoard groups tags by the first word. Grouping by metric puts a metric's curves side by side, and test results, which are
    not curves, last in :data:`RESULTS`.

    Args:
        name: name in callbacks: stage, metric and optionally setting; other names are unchanged.
    """
    stage, _, measured = name.partition("/")
    if stage == "test" and measured:
        return f"{RESULTS}/{measured}"
    if stage in ("train", "val") and measured:
        return measured if "/" in measured else f"{measured}/{stage}"
    return name


class Board(TensorBoardLogger):
    """Lightning's logger with the tags of :func:`tag` and without the epoch."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log a point of each metric."""
        super().log_metrics({tag(name): value for name, value in metrics.items() if name != "epoch"}, step)


TAG, NUMBER = "optimizer/learning rate", re.compile(r"\.\d+(?=\.|$)")


class LearningRate(pl.Callback):
    """Logs the learning rate of each step.

    An optimiser with several parameter groups has a curve for each name of a group's first parameter, without numbers, since
    adapters have a group for every factor.
    """

    def on_before_optimizer_step(self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Optimizer) -> None:
        """Log the rates of the next step."""
        pl_module.log_dict(rates(pl_module, optimizer), on_step=True, on_epoch=False)


def rates(module: pl.LightningModule, optimizer: Optimizer) -> dict[str, float]:
    """Learning rates by tag."""
    groups: list[dict[str, Any]] = optimizer.param_groups
    if len(groups) == 1:
        return {TAG: float(groups[0]["lr"])}
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    named = [(names.get(id(group["params"][0]), "others"), float(group["lr"])) for group in groups]
    return {f"{TAG}/{re.sub(NUMBER, '', name)}": rate for name, rate in named}


REFRESH = 0.5
"""Seconds between updates of loss and accuracy, which would be slow at every step."""


class TrainingBar(ProgressBar):
    """Bar over all steps of ``fit`` or ``invert``, and another for an evaluation after it."""

    def __init__(self) -> None:
        super().__init__()
        self._on = True
        self._open = ExitStack()
        self._advance: Advance | None = None
        self._shown = 0
        self._looked = 0.0

    def enable(self) -> None:
        self._on = True

    def disable(self) -> None:
        self._on = False

    def _begin(self, title: str, total: int | None, done: int = 0) -> None:
        self._close()
        if self._on:
            self._advance = self._open.enter_context(bar(title, total, done))

    def _close(self) -> None:
        self._advance = None
        self._open.close()

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if not pl_module.automatic_optimization:
            return  # an inversion shows its gradient steps itself
        self._shown = trainer.global_step
        self._begin(getattr(trainer, "verb", "fit"), int(trainer.estimated_stepping_batches), self._shown)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._advance is not None:
            if look := time.monotonic() - self._looked > REFRESH:
                self._looked = time.monotonic()
            self._advance(trainer.global_step - self._shown, logged_metrics(trainer) if look else "")
            self._shown = trainer.global_step

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self._advance is not None:
            self._advance(0, logged_metrics(trainer))
        self._close()

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.state.fn == "validate":
            self._begin("evaluation", None)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.state.fn == "validate":
            self._close()

    def on_test_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._begin("evaluation", None)

    def on_test_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self._close()

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        self._advance = None
        # With the exception, so that the bar does not report its end.
        self._open.__exit__(type(exception), exception, exception.__traceback__)


def logged_metrics(trainer: pl.Trainer) -> str:
    """Logged loss and accuracy of a run: ``loss 0.031, accuracy 0.98``."""
    metrics = trainer.callback_metrics
    loss = [f"loss {metrics['train/loss']:.3g}"] if "train/loss" in metrics else []
    return ", ".join([*loss, *accuracies(trainer)])


def accuracies(trainer: pl.Trainer) -> list[str]:
    """Metrics that the evaluator logged during fitting, ``accuracy 0.98``, with the setting's name if a metric has several."""
    logged = [key.split("/") for key in trainer.callback_metrics if key.startswith("val/")]
    pairs = [(key[1], key[2]) for key in logged if len(key) == 3]  # val/METRIC/SETTING
    settings = {name: [setting for metric, setting in pairs if metric == name] for name, _ in pairs}
    return [
        f"{name}{f' ({setting})' if len(settings[name]) > 1 else ''} {trainer.callback_metrics[f'val/{name}/{setting}']:.2f}"
        for name, setting in pairs
    ]
