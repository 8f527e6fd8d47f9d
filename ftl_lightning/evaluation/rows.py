"""What an evaluation adds to the results file, and the configuration that its numbers are known by."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.evaluable import Evaluable, demonstrations_of
from ftl_lightning.evaluation.judged import TaskResult, paired, share
from ftl_lightning.evaluation.row import METHOD, REFERENCE, Row
from ftl_lightning.tensor_file import content_hash, file_hash
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
"""Settings that came later, at the values under which everything is as before: they are left out, so that hashes stay."""


def public(hparams: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Hyper-parameters without those that Lightning's command line adds for itself."""
    return [(key, value) for key, value in hparams.items() if not key.startswith("_")]


def configuration(
    module: Evaluable, data: pl.LightningDataModule, settings: Mapping[str, Any], trainer: pl.Trainer | None = None
) -> dict[str, Any]:
    """Everything that was configured, by its place in a configuration file.

    Args:
        module: what generates.
        data: what it learned from.
        settings: the evaluator's.
        trainer: what learns. Unusual options of ours count, unless a model is pretrained, which is known by its weights.
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
        # A trained judge decides values, too; rules have no identity.
        **{f"metric/{name}": metric.identity for name, metric in module.model.domain.metrics.items() if metric.identity},
        **({"data/demonstrations": _identity(demonstrations)} if demonstrations else {}),
    }


def _identity(demonstrations: str) -> str:
    """A file's hash; a data set with a name and a version, which is no file, is known by these."""
    return file_hash(demonstrations) if Path(demonstrations).is_file() else demonstrations


def config_hash(configured: Mapping[str, Any]) -> str:
    """16-digit hash of the full configuration."""
    return content_hash([__version__, configured])


def rows(
    module: Evaluable,
    domain: Domain,
    judged: Sequence[TaskResult],
    references: Mapping[str, Sequence[TaskResult]],
    configured: Mapping[str, Any],
    variant: str | None = None,
) -> list[Row]:
    """The method's numbers, its comparison with policies from the same initial states, and the reference lines' numbers.

    Args:
        module: what generated.
        domain: that it generated for.
        judged: what it did.
        references: what reference policies did, by name.
        configured: see :func:`configuration`.
        variant: told beside the method's name, in place of the module's own words.
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
        # Reference plans are drawn without demonstrations; policies are given them.
        given = demonstrations_of(task, module.demonstrated) if source["method"] not in domain.references else None
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
