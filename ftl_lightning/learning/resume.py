"""Resuming exactly: a run that was interrupted ends with the same bytes as the unbroken one."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import lightning.pytorch as pl

from ftl_lightning.learning.checkpoint import check_parameters, check_restored, check_signature, sign
from ftl_lightning.tensor_file import expect_finite


class ExactResume(pl.LightningModule, ABC):
    """Signs checkpoints, refuses those of something else or with numbers that are not finite, and looks at what was restored."""

    prefix: ClassVar[str] = ""
    """Names of all parameters that a checkpoint holds begin so."""
    doing: ClassVar[str] = "training"
    """What is interrupted, in messages."""
    resumed_from = 0
    """The step of the checkpoint that was loaded; 0 for none."""

    @abstractmethod
    def signature(self) -> Mapping[str, Any]:
        """Settings that must match before a checkpoint is loaded."""

    def on_train_start(self) -> None:
        """Look at what was restored, if anything."""
        check_restored(self, self.resumed_from)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Sign the checkpoint and leave out what it does not hold.

        Raises:
            UserError: if a parameter is not finite; the checkpoint that is there stays.
        """
        sign(self, checkpoint, self.signature())
        state = {name: value for name, value in checkpoint["state_dict"].items() if name.startswith(self.prefix)}
        checkpoint["state_dict"] = state
        # Losses that a concept has not reached yet are infinite: of what is learned in part, parameters alone are looked at.
        learned = dict(self.named_parameters()) if self.prefix else state
        learned = {name: value for name, value in learned.items() if name in state}
        expect_finite(learned, f"{self.doing}: step {self.global_step}", "nothing was saved of it; lower the learning rate")

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another module or with other parameters."""
        check_signature(self, checkpoint, self.signature())
        check_parameters(checkpoint["state_dict"], self, self.prefix)
        self.resumed_from = checkpoint["global_step"]
