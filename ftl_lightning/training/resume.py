"""Exact resumption: an interrupted run ends with the same bytes as an unbroken run."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import lightning.pytorch as pl

from ftl_lightning.services.tensor_file import check_finite
from ftl_lightning.training.checkpoint import check_parameters, check_restored, check_signature, sign


class ExactResume(pl.LightningModule, ABC):
    """Sign checkpoints, refuse foreign or non-finite checkpoints, and check the restored state."""

    prefix: ClassVar[str] = ""
    """Prefix of the parameters in a checkpoint."""
    doing: ClassVar[str] = "training"
    """Name of the activity in messages."""
    resumed_from = 0
    """Step of the loaded checkpoint; 0 for none."""

    @abstractmethod
    def signature(self) -> Mapping[str, Any]:
        """Settings that must match before a checkpoint is loaded."""

    def on_train_start(self) -> None:
        """Check the restored state."""
        check_restored(self, self.resumed_from)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Sign the checkpoint and keep only parameters with the prefix.

        Raises:
            UserError: if a parameter is not finite; an existing checkpoint is kept.
        """
        sign(self, checkpoint, self.signature())
        state = {name: value for name, value in checkpoint["state_dict"].items() if name.startswith(self.prefix)}
        checkpoint["state_dict"] = state
        # Buffers of losses may still be infinite: with a prefix, only parameters are checked.
        learned = dict(self.named_parameters()) if self.prefix else state
        learned = {name: value for name, value in learned.items() if name in state}
        check_finite(learned, f"{self.doing}: step {self.global_step}", "nothing was saved of it; lower the learning rate")

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another module or with other parameters."""
        check_signature(self, checkpoint, self.signature())
        check_parameters(checkpoint["state_dict"], self, self.prefix)
        self.resumed_from = checkpoint["global_step"]
