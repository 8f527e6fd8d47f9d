"""Formats of demonstrations. Each module registers its formats when it is imported; a new format is one more module here."""

from ftl_lightning.data.formats import files, lerobot, minari

__all__ = ["files", "lerobot", "minari"]
