"""Demonstrations: container, file, normalisation, DataModules."""

from ftl_lightning.demonstrations.container import Demonstrations

__all__ = ["Demonstrations"]
