"""Formats of demonstrations. Each module registers its formats on import; a new format is a new module."""

from ftl_lightning.data.formats import arrays, files, lerobot, minari

__all__ = ["arrays", "files", "lerobot", "minari"]
