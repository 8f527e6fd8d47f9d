"""Export of the trained model at the end of fitting."""

import lightning.pytorch as pl

from ftl_lightning.errors import UserError
from ftl_lightning.learning.pretraining import PretrainingModule


class SavePretrained(pl.Callback):
    """Writes the averaged model to a folder that ``invert`` and ``sample`` read.

    Args:
        folder: made if missing.
    """

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Export."""
        if not isinstance(pl_module, PretrainingModule):
            raise UserError(f"model.class_path: expected PretrainingModule, found {type(pl_module).__name__}")
        pl_module.model.save(self.folder)
