"""Demonstrations: container, files, normalisation, checks."""

from ftl_lightning.demonstrations.container import Demonstrations

__all__ = ["Demonstrations"]
