"""The two LightningModules: pretraining (Eq. 1) and inversion (Eq. 2).

They are imported on demand: learning and sampling without a trainer do not need Lightning.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ftl_lightning.training.inversion_module import InversionModule

__all__ = ["InversionModule", "PretrainingModule"]

_MODULES = {
    "InversionModule": "ftl_lightning.training.inversion_module",
    "PretrainingModule": "ftl_lightning.methods.ftl_igm.pretraining",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
