"""A checkpoint names the module class it belongs to, so that one module never continues another's."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import lightning.pytorch as pl

from ftl_lightning.errors import UserError

_KEY = "belongs_to"


def _signature(module: pl.LightningModule, more: Mapping[str, Any]) -> dict[str, Any]:
    return {"module_class": type(module).__name__, **more}


def sign(module: pl.LightningModule, checkpoint: dict[str, Any], more: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Write the module's class, and the settings that must match before it is loaded, into its checkpoint."""
    checkpoint[_KEY] = _signature(module, more)


def check_signature(module: pl.LightningModule, checkpoint: dict[str, Any], more: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Refuse a checkpoint with another signature.

    Raises:
        UserError: naming the first key that differs.
    """
    own, signature = _signature(module, more), checkpoint.get(_KEY, {})
    for key in own | signature:  # a setting that one of them does not name is at its default there
        if (found := signature.get(key)) != (expected := own.get(key)):
            raise UserError(f"ckpt_path: key {key!r}: expected {expected}, found {found}; it is the checkpoint of something else")
