"""Lightning's trainer with one more verb."""

from typing import Any

import lightning.pytorch as pl

from ftl_lightning.errors import UserError
from ftl_lightning.learning.adaptation import Adaptation


class Trainer(pl.Trainer):
    """A trainer that can also ``invert``.

    Attributes:
        verb: what it does, for the progress bar.
    """

    verb = "fit"

    def fit(self, model: pl.LightningModule, *arguments: Any, **options: Any) -> None:
        """As Lightning's, for what learns."""
        if isinstance(model, Adaptation) and not model.learns:
            raise UserError(f"verb: expected invert (model.class_path: {type(model).__name__} learns nothing), found fit")
        super().fit(model, *arguments, **options)

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
