"""Rows of results that nobody measured."""

from typing import Any

from ftl_lightning.evaluation.results import Row

USUAL: dict[str, Any] = {"domain": "object_rearrangement", "setting": "new concept", "task": "t", "method": "FTL-IGM", "K": 2}
USUAL |= {"variant": "free", "omega": "1.2", "demonstrations": 5, "seed": 0, "n": 50, "metric": "accuracy", "value": 0.5}
USUAL |= {"model_hash": "m", "config_hash": "c"}
REFERENCE: dict[str, Any] = {"variant": "", "role": "reference", "K": 0, "omega": ""}
"""What is different in a reference, beside its name."""


def row(**changes: Any) -> Row:
    """One, of ours unless anything else is said."""
    return Row(**(USUAL | changes))
