"""What a person chose of a run, by names that they know: the columns of the HPARAMS tab."""

from collections.abc import Mapping, Sequence
from typing import Any

import lightning.pytorch as pl

from ftl_lightning.errors import short
from ftl_lightning.evaluation.evaluable import Evaluable
from ftl_lightning.evaluation.row import Row
from ftl_lightning.evaluation.rows import public

USUAL = "usual"
"""Of a form that is not said to be otherwise."""
MOST = 100
"""Letters of the tasks' names that are shown."""
OTHERS = "with "
"""How names of the other settings begin: TensorBoard shows the first five by name, or those in which runs differ."""
TOLD = ("model/components", "model/omega", "model/guidance", "model/seed", "model/form", "data/domain", "data/seed", "data/steps")
"""Settings that are among the first ones, by other names."""


def chosen(
    module: Evaluable, data: pl.LightningDataModule, settings: Mapping[str, Any], trainer: pl.Trainer, rows: Sequence[Row]
) -> dict[str, Any]:
    """Settings by name: what is known by name stands for itself, and never a hash for it.

    Args:
        module: what generated.
        data: what it learned from, or was tested on.
        settings: the evaluator's.
        trainer: what learned.
        rows: of the method, one or more.
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
        **{f"{OTHERS}{name}": value for name, value in others.items() if name not in TOLD},
    }


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
