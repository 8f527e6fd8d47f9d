"""Lightning's trainer with the additional verb ``invert``."""

import inspect
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ftl_lightning.services import log_folder
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.text import silence
from ftl_lightning.services.validation import check_count, check_range
from ftl_lightning.training import process_group
from ftl_lightning.training.adaptation import Adaptation
from ftl_lightning.training.board import LearningRate
from ftl_lightning.training.checkpoint import WholeCheckpoints

HARMLESS = {
    "accelerator",
    "barebones",
    "callbacks",
    "check_val_every_n_epoch",
    "default_root_dir",
    "detect_anomaly",
    "devices",
    "enable_autolog_hparams",
    "enable_checkpointing",
    "enable_model_summary",
    "enable_progress_bar",
    "inference_mode",
    "limit_predict_batches",
    "limit_test_batches",
    "limit_val_batches",
    "log_every_n_steps",
    "logger",
    "model_registry",
    "num_nodes",
    "num_sanity_val_steps",
    "profiler",
    "reload_dataloaders_every_n_epochs",
    "val_check_interval",
}
"""Options that change no number of a run on one device; all other options do."""
MOST_PROCESSES = 256
"""Maximum number of processes that learn concepts."""
_STARTS = ("`val_check_interval`", "Early stopping conditioned")
"""Beginnings of Lightning's messages about options."""
USUAL = {"max_epochs": 1, "deterministic": True}
"""Defaults of the shipped configurations of ``invert`` that differ from Lightning's."""


RANGES = {
    "devices": (-1, 10_000),
    "num_nodes": (1, 1000),
    "max_steps": (-1, math.inf),
    "max_epochs": (-1, math.inf),
    "min_steps": (0, math.inf),
    "min_epochs": (0, math.inf),
    "check_val_every_n_epoch": (1, math.inf),
    "log_every_n_steps": (0, math.inf),
    "accumulate_grad_batches": (1, math.inf),
    "num_sanity_val_steps": (-1, math.inf),
    "reload_dataloaders_every_n_epochs": (0, math.inf),
    "gradient_clip_val": (0, math.inf),
}
"""Ranges of options that Lightning does not check: invalid values fail during a run, or are ignored."""
LIMITS = {
    "limit_train_batches": "batches",
    "limit_val_batches": "batches",
    "limit_test_batches": "batches",
    "overfit_batches": "batches",
    "val_check_interval": "steps",
}
"""Unchecked options that are a share or a number, with the unit of the number."""


class _Begun(pl.Callback):
    """Record the start of learning, and check that metrics monitored by callbacks exist."""

    def on_train_batch_start(self, *_: Any) -> None:
        log_folder.keep()

    def on_validation_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if not trainer.sanity_checking:
            _expect_monitors(trainer)


def _expect_monitors(trainer: pl.Trainer) -> None:
    """Refuse a callback that monitors a metric which is not logged: it would have no effect.

    Raises:
        UserError: naming the callback and the logged metrics.
    """
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        watched = getattr(callback, "monitor", None)
        if isinstance(watched, str) and watched not in trainer.callback_metrics:
            known, name = short(", ".join(sorted(trainer.callback_metrics)), 150), type(callback).__name__
            raise UserError(f"trainer.callbacks: {name}: monitor: expected one of {known}, found {short(watched)!r}")


class Trainer(pl.Trainer):
    """A trainer with the additional verb ``invert``.

    Attributes:
        verb: current verb, for the progress bar.
        unusual: options that can affect learning and differ from their defaults; they are part of a result's identity.
        processes: number of processes among which ``invert`` divides the concepts, see :mod:`ftl_lightning.training.in_processes`.
    """

    verb = "fit"

    def __init__(self, *arguments: Any, processes: int = 1, **options: Any) -> None:
        check_count("trainer.processes", processes, 1, MOST_PROCESSES)
        self.processes = processes
        for name, (least, most) in RANGES.items():
            value = options.get(name)
            value = int(value) if isinstance(value, str) and value.isdecimal() else value  # devices may be a string
            if isinstance(value, int | float) and not isinstance(value, bool):
                check_range(f"trainer.{name}", value, least, most)
        for name, words in LIMITS.items():
            value = options.get(name)
            if isinstance(value, int | float) and not (0 <= value <= 1 or (value > 1 and value == int(value))):
                raise UserError(f"trainer.{name}: expected a share from 0 to 1 or a whole number of {words}, found {value}")
        if options.get("val_check_interval") == 0:
            raise UserError(
                "trainer.val_check_interval: expected more than 0, found 0; trainer.limit_val_batches 0 validates never"
            )
        try:
            super().__init__(*arguments, **options)
        except UserError:
            raise
        except Exception as error:  # of many types, by accelerators, strategies and plugins
            raise UserError(f"trainer: {short(str(error), 200)}") from error
        if isinstance(self.accelerator, CPUAccelerator):
            check_range("trainer.devices", self.num_devices, 1, os.cpu_count() or 1)
        known = inspect.signature(pl.Trainer.__init__).parameters
        usual = {name: parameter.default for name, parameter in known.items()} | USUAL
        self.unusual = {
            name: value if isinstance(value, int | float | str | None) else type(value).__name__
            for name, value in options.items()
            if name not in HARMLESS and value != usual.get(name)
        }
        process_group.take_over(self)
        self.callbacks += [_Begun(), LearningRate()]  # type: ignore[attr-defined]
        if type(self.strategy.checkpoint_io) is TorchCheckpointIO:  # unless it is configured
            self.strategy.checkpoint_io = WholeCheckpoints()

    def fit(self, model: pl.LightningModule, *arguments: Any, **options: Any) -> None:
        """Lightning's ``fit``, for models that learn."""
        if isinstance(model, Adaptation) and not model.learns:
            raise UserError(f"verb: expected invert (model.class_path: {type(model).__name__} learns nothing), found fit")
        for key, length in (("max_steps", self.max_steps), ("max_epochs", self.max_epochs)):
            if length == 0:
                raise UserError(f"trainer.{key}: expected 1 or more, or -1 for no limit, found 0, with which nothing is learned")
        if self.limit_train_batches == 0:
            raise UserError("trainer.limit_train_batches: expected more than 0, found 0, with which nothing is learned")
        process_group.check_exact(self)
        if self.global_rank:
            silence()
        with self._restoring():
            try:
                super().fit(model, *arguments, **options)
            except (ValueError, RuntimeError) as error:  # raised by Lightning at the start
                if str(error).strip().startswith(_STARTS):
                    raise UserError(f"trainer: {short(str(error), 250)}") from error
                raise
        _expect_monitors(self)

    def validate(self, *arguments: Any, **options: Any) -> Any:
        """Lightning's ``validate``, in one process."""
        process_group.check_alone(self, "validate")
        with self._restoring():
            return super().validate(*arguments, **options)

    def test(self, *arguments: Any, **options: Any) -> Any:
        """Lightning's ``test``, in one process."""
        process_group.check_alone(self, self.verb if self.verb == "invert" else "test")
        with self._restoring():
            return super().test(*arguments, **options)

    @contextmanager
    def _restoring(self) -> Iterator[None]:
        """Report errors of Lightning and torch about a checkpoint that cannot be restored, in one line."""
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            if not self._checkpoint_connector._loaded_checkpoint:  # released once restoring is complete
                raise
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:150]
            raise UserError(
                f"{self.ckpt_path}: expected a checkpoint of a run like this one, found one that cannot be restored ({reason})"
            ) from error

    def invert(self, model: Adaptation, datamodule: pl.LightningDataModule, ckpt_path: str | None = None) -> None:
        """Learn the concepts, write them to files, then generate and judge samples.

        Args:
            model: adapts a pretrained model.
            datamodule: demonstrations.
            ckpt_path: checkpoint of an inversion to resume.
        """
        if not isinstance(model, Adaptation):
            raise UserError(f"model.class_path: expected a module that adapts a pretrained model, found {type(model).__name__}")
        if ckpt_path and not model.learns:
            raise UserError(f"ckpt_path: expected none for {model.method}, which learns nothing, found {ckpt_path}")
        self.verb = "invert"
        process_group.check_alone(self, self.verb)
        if self.processes > 1:
            self._expect_plain(model, ckpt_path)
        elif model.learns:
            self.fit(model, datamodule=datamodule, ckpt_path=ckpt_path, weights_only=True)
        self.test(model, datamodule=datamodule, verbose=False)

    def _expect_plain(self, model: Adaptation, ckpt_path: str | None) -> None:
        """Refuse options that learning in several processes ignores, because no trainer runs in them."""
        if not model.learns:
            message = f"expected 1 for {model.method}, which learns nothing, found {self.processes}"
        elif ckpt_path:
            message = f"expected 1 to go on with a checkpoint, found {self.processes}"
        elif self.unusual:
            message = f"expected 1 with trainer.{next(iter(self.unusual))}, found {self.processes}"
        else:
            return
        raise UserError(f"trainer.processes: {message}")
