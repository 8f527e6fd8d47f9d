"""The two LightningModules: pretraining (Eq. 1) and inversion (Eq. 2)."""

from ftl_lightning.learning.inversion import InversionModule
from ftl_lightning.learning.pretraining import PretrainingModule

__all__ = ["InversionModule", "PretrainingModule"]
