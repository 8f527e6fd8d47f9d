"""Demonstrations: container, files, normalisation, checks."""

from ftl_lightning.data.demonstrations import Demonstrations

__all__ = ["Demonstrations"]
