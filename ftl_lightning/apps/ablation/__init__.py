"""Ablations: grids of configurations, run through the usual verbs; configurations with results are skipped."""
