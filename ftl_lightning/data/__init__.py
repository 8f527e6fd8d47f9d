"""Demonstrations: container, file formats, normalisation, checks."""

from ftl_lightning.data import formats
from ftl_lightning.data.demonstrations import Demonstrations

__all__ = ["Demonstrations", "formats"]
