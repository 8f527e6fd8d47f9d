"""A checkpoint names the module class it belongs to, so that one module never continues another's."""

from typing import Any

import lightning.pytorch as pl

from ftl_lightning.errors import UserError

_KEY = "module_class"


def sign(module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
    """Write the module's class into its checkpoint."""
    checkpoint[_KEY] = type(module).__name__


def check_signature(module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
    """Refuse a checkpoint of another class.

    Raises:
        UserError: if the classes differ.
    """
    expected, found = type(module).__name__, checkpoint.get(_KEY)
    if found != expected:
        raise UserError(f"ckpt_path: key {_KEY!r}: expected {expected}, found {found}; it is the checkpoint of another module")
