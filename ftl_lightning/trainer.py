"""Lightning's trainer with one more verb."""

import lightning.pytorch as pl

from ftl_lightning.learning.adaptation import Adaptation


class Trainer(pl.Trainer):
    """A trainer that can also ``invert``."""

    def invert(self, model: Adaptation, datamodule: pl.LightningDataModule, ckpt_path: str | None = None) -> None:
        """Learn the concepts, write them to files, then generate and judge.

        Args:
            model: what adapts a pretrained model.
            datamodule: demonstrations.
            ckpt_path: checkpoint of an inversion to go on with.
        """
        if model.learns:
            self.fit(model, datamodule=datamodule, ckpt_path=ckpt_path, weights_only=True)
        self.test(model, datamodule=datamodule, verbose=False)
