"""Lightning's trainer with one more verb."""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ftl_lightning.errors import UserError
from ftl_lightning.learning.adaptation import Adaptation
from ftl_lightning.learning.checkpoint import WholeCheckpoints
from ftl_lightning.ranges import expect_range

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
"""Options that change no number of a run on one device; every other one does."""
USUAL = {"max_epochs": 1, "deterministic": True}
"""Of a configuration that ships with ``invert``, where Lightning's default is another one."""


class Trainer(pl.Trainer):
    """A trainer that can also ``invert``.

    Attributes:
        verb: what it does, for the progress bar.
        unusual: options that can change what is learned and have not their usual values: these are part of a result's identity.
    """

    verb = "fit"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        known = inspect.signature(pl.Trainer.__init__).parameters
        usual = {name: one.default for name, one in known.items()} | USUAL
        self.unusual = {
            name: value if isinstance(value, int | float | str | None) else type(value).__name__
            for name, value in options.items()
            if name not in HARMLESS and value != usual.get(name)
        }
        if type(self.strategy.checkpoint_io) is TorchCheckpointIO:  # unless it is configured
            self.strategy.checkpoint_io = WholeCheckpoints()

    def fit(self, model: pl.LightningModule, *arguments: Any, **options: Any) -> None:
        """As Lightning's, for what learns."""
        if isinstance(model, Adaptation) and not model.learns:
            raise UserError(f"verb: expected invert (model.class_path: {type(model).__name__} learns nothing), found fit")
        for key, length in (("max_steps", self.max_steps), ("max_epochs", self.max_epochs)):
            if length == 0:
                raise UserError(f"trainer.{key}: expected 1 or more, or -1 for no limit, found 0, with which nothing is learned")
        if self.limit_train_batches == 0:
            raise UserError("trainer.limit_train_batches: expected more than 0, found 0, with which nothing is learned")
        expect_range("trainer.gradient_clip_val", self.gradient_clip_val or 0, 0)
        with self._restoring():
            super().fit(model, *arguments, **options)

    def validate(self, *arguments: Any, **options: Any) -> Any:
        """As Lightning's."""
        with self._restoring():
            return super().validate(*arguments, **options)

    def test(self, *arguments: Any, **options: Any) -> Any:
        """As Lightning's."""
        with self._restoring():
            return super().test(*arguments, **options)

    @contextmanager
    def _restoring(self) -> Iterator[None]:
        """Tell in one line what Lightning and torch raise, each in its own way, of a checkpoint that they cannot restore."""
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            if not self._checkpoint_connector._loaded_checkpoint:  # which is let go of as soon as all of it is restored
                raise
            told = " ".join(f"{type(error).__name__}: {error}".split())[:150]
            raise UserError(
                f"{self.ckpt_path}: expected a checkpoint of a run like this one, found one that cannot be restored ({told})"
            ) from error

    def invert(self, model: Adaptation, datamodule: pl.LightningDataModule, ckpt_path: str | None = None) -> None:
        """Learn the concepts, write them to files, then generate and judge.

        Args:
            model: what adapts a pretrained model.
            datamodule: demonstrations.
            ckpt_path: checkpoint of an inversion to go on with.
        """
        if not isinstance(model, Adaptation):
            raise UserError(f"model.class_path: expected a module that adapts a pretrained model, found {type(model).__name__}")
        if ckpt_path and not model.learns:
            raise UserError(f"ckpt_path: expected none for {model.method}, which learns nothing, found {ckpt_path}")
        self.verb = "invert"
        if model.learns:
            self.fit(model, datamodule=datamodule, ckpt_path=ckpt_path, weights_only=True)
        self.test(model, datamodule=datamodule, verbose=False)
