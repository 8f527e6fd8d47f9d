"""Settings of a run for the columns of the HPARAMS tab."""

from collections.abc import Mapping, Sequence
from typing import Any

import lightning.pytorch as pl

from ftl_lightning.evaluation.generation import Evaluable
from ftl_lightning.evaluation.row import Row
from ftl_lightning.evaluation.rows import public
from ftl_lightning.services.errors import short

USUAL = "usual"
"""Name of the default form."""
MOST = 100
"""Maximum length of the list of tasks."""
OTHERS = "with "
"""Prefix of the other settings: TensorBoard shows the first five by name, or those in which runs differ."""
MAIN = ("model/components", "model/omega", "model/guidance", "model/seed", "model/form", "data/domain", "data/seed", "data/steps")
"""Settings listed under another name without the prefix."""


def chosen(
    module: Evaluable, data: pl.LightningDataModule, settings: Mapping[str, Any], trainer: pl.Trainer, rows: Sequence[Row]
) -> dict[str, Any]:
    """Settings by name, without hashes.

    Args:
        module: evaluated module.
        data: training or test data.
        settings: settings of the evaluator.
        trainer: trainer.
        rows: rows of the method, at least one.
    """
    first = rows[0]
    groups = {"model": public(module.hparams), "data": public(data.hparams), "evaluation": settings.items()}
    others = {f"{group}/{key}": value for group, pairs in groups.items() for key, value in pairs}
    others |= {f"trainer/{key}": value for key, value in getattr(trainer, "unusual", {}).items()}
    return {
        "domain": first.domain,
        "method": first.method,
        "K": first.K,
        "omega": _number(first.omega),
        "form": first.form or USUAL,
        "seed": first.seed,
        "steps": data.hparams.get("steps", trainer.max_steps),
        "tasks": short(", ".join(dict.fromkeys(row.task for row in rows)), MOST),
        "variant": first.variant,
        **{f"{OTHERS}{name}": value for name, value in others.items() if name not in MAIN},
    }


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
