"""Ablations: grids of configurations, each run through the same verbs as by hand, skipping what the results hold already."""

from ftl_lightning.ablation.plan import Stage

__all__ = ["Stage"]
