"""Demonstrations: container, files, normalisation, checks."""

from ftl_lightning.data.container import Demonstrations

__all__ = ["Demonstrations"]
