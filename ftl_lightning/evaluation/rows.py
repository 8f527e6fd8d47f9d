"""Rows of an evaluation for the results file, and the configuration behind their hash."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.generation import Evaluable, TaskResult, demonstrations_of, paired, share
from ftl_lightning.evaluation.row import METHOD, REFERENCE, Row
from ftl_lightning.services.tensor_file import content_hash, file_hash
from ftl_lightning.version import __version__

LATER = (
    ("modes", 1),
    ("mode_samples", 8),
    ("tolerance", None),
    ("knots", 1),
    ("guidance_scale", 1.0),
    ("adapter", 0),
    ("adapter_learning_rate", 1e-3),
    ("adapter_scope", "concept"),
    ("form", ""),
)
"""Settings added later, with their neutral values: they are omitted from the configuration to keep hashes."""


def public(hparams: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Hyper-parameters without the private keys of Lightning's command line."""
    return [(key, value) for key, value in hparams.items() if not key.startswith("_")]


def configuration(
    module: Evaluable, data: pl.LightningDataModule, settings: Mapping[str, Any], trainer: pl.Trainer | None = None
) -> dict[str, Any]:
    """Full configuration, by place in a configuration file.

    Args:
        module: evaluated module.
        data: training data.
        settings: settings of the evaluator.
        trainer: trainer. Its unusual options are included, except in pretraining, where the model's hash identifies the weights.
    """
    demonstrations, loop = data.hparams.get("demonstrations"), module.model.domain.closed_loop
    unusual = getattr(trainer, "unusual", {}) if "pretrained" in module.hparams else {}
    hparams = [(key, value) for key, value in public(module.hparams) if key not in ("pretrained", "output")]
    return {
        **{f"model/{key}": value for key, value in hparams if (key, value) not in LATER},
        **{f"data/{key}": value for key, value in public(data.hparams) if key not in ("demonstrations", "root")},
        **{f"evaluation/{key}": value for key, value in settings.items()},
        **{f"trainer/{key}": value for key, value in unusual.items()},
        **({"environment": loop.identity} if "replan" in settings and loop and loop.identity else {}),
        "model/pretrained": module.model.hash,
        # Trained metrics affect values too; rules have no identity.
        **{f"metric/{name}": metric.identity for name, metric in module.model.domain.metrics.items() if metric.identity},
        **({"data/demonstrations": _identity(demonstrations)} if demonstrations else {}),
    }


def _identity(demonstrations: str) -> str:
    """Hash of a file; a data set with a name and a version is returned as it is."""
    return file_hash(demonstrations) if Path(demonstrations).is_file() else demonstrations


def config_hash(configured: Mapping[str, Any]) -> str:
    """Hash of the full configuration, 16 digits."""
    return content_hash([__version__, configured])


def rows(
    module: Evaluable,
    domain: Domain,
    judged: Sequence[TaskResult],
    references: Mapping[str, Sequence[TaskResult]],
    configured: Mapping[str, Any],
    variant: str | None = None,
) -> list[Row]:
    """Rows of the method, of its paired comparison with policies, and of the reference lines.

    Args:
        module: evaluated module.
        domain: domain of the tasks.
        judged: behaviour of the method.
        references: behaviour of the reference lines, by name.
        configured: see :func:`configuration`.
        variant: label of the run in tables; ``None`` for the module's label.
    """
    hparams = module.hparams
    learned = {
        "method": module.method,
        "form": module.form,
        "variant": module.variant if variant is None else variant,
        "role": METHOD,
        "K": hparams.get("components", 0),
        "omega": str(hparams.get("omega", hparams.get("guidance", "none"))),
        "model_hash": module.model.hash,
        "config_hash": config_hash(configured),
    }
    shared = [__version__, configured["evaluation/samples"], configured["evaluation/sample_seed"]]
    shared += [configured["environment"]] if "environment" in configured else []
    unlearned = {"role": REFERENCE, "K": 0, "omega": "", "model_hash": "", "config_hash": content_hash(shared)}

    policies = domain.closed_loop.policies if domain.closed_loop else {}

    def task_rows(behaviour: TaskResult, source: Mapping[str, Any], values: Mapping[str, float]) -> list[Row]:
        task = behaviour.task
        subject = {"domain": domain.name, "setting": task.setting, "task": task.name, "seed": hparams["seed"]}
        # Reference policies use demonstrations, reference plans do not.
        given = demonstrations_of(task, module.demonstrated) if source["method"] not in domain.comparison.references else None
        subject["demonstrations"] = 0 if given is None else len(given)
        count = len(behaviour.states)
        return [Row(**subject, **source, n=count, metric=name, value=round(value, 6)) for name, value in values.items()]

    compared = [
        row
        for policy in policies
        for reference in references.get(policy, ())
        for behaviour in judged
        if behaviour.task == reference.task
        for row in task_rows(
            behaviour,
            learned,
            {metric: share(episodes) for metric, episodes in paired(behaviour, reference, policy, domain).items()},
        )
    ]
    return [
        *(row for behaviour in judged for row in task_rows(behaviour, learned, behaviour.values)),
        *compared,
        *(
            row
            for name, behaviours in references.items()
            for behaviour in behaviours
            for row in task_rows(behaviour, unlearned | {"method": name}, behaviour.values)
        ),
    ]
