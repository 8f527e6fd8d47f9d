"""Lightning's progress bar as a single bar over all steps of a run."""

import time
from contextlib import ExitStack
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ProgressBar

from ftl_lightning.services.progress import Advance, bar

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
        self._shown = trainer.global_step
        self._begin(getattr(trainer, "verb", "fit"), int(trainer.estimated_stepping_batches), self._shown)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._advance is not None:
            if look := time.monotonic() - self._looked > REFRESH:
                self._looked = time.monotonic()
            self._advance(trainer.global_step - self._shown, told(trainer) if look else "")
            self._shown = trainer.global_step

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self._advance is not None:
            self._advance(0, told(trainer))
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


def told(trainer: pl.Trainer) -> str:
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
