"""Ablations: grids of configurations, run through the usual verbs; configurations with results are skipped."""

from ftl_lightning.apps.ablation.plan import Stage

__all__ = ["Stage"]
