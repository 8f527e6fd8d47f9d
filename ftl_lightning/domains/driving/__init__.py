"""Driving: highway-env scenarios; the roundabout is learned from five demonstrations (paper, section 5.1)."""

from ftl_lightning.domains.driving.domain import DOMAIN, WIDE

__all__ = ["DOMAIN", "WIDE"]
