"""Row of a results file; for tables see :mod:`ftl_lightning.evaluation.results`."""

from dataclasses import dataclass

from ftl_lightning.version import __version__

METHOD, REFERENCE = "method", "reference"
"""Roles: methods, and reference lines (chance, trivial policies, oracles)."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A measured value.

    Attributes:
        domain, setting, task: evaluated task.
        method: name of the method, for example ``'FTL-IGM'`` or ``'BC'``, or of the reference line.
        form: form of the method, see :class:`~ftl_lightning.domains.comparison.Compared`; empty for the paper's.
        variant: label of settings of the same method and form, for example ``'entities, free'``; may be empty.
        role: :data:`METHOD` or :data:`REFERENCE`.
        K: number of concept components; 0 without learning.
        omega: fixed guidance weight as text, ``'learned'``, or ``'none'`` for a method without; empty for a reference line.
        demonstrations: number of demonstrations of the task's concept; 0 without learning.
        seed: seed of pretraining and inversion.
        n: number of samples or episodes behind the value.
        metric: name of the metric, for example ``'accuracy'``.
        value: measured value.
        model_hash: hash of the pretrained model.
        config_hash: hash of the full configuration; equal hash and version imply an equal value.
        version: version of this package.
    """

    domain: str
    setting: str
    task: str
    method: str
    form: str = ""
    variant: str = ""
    role: str = METHOD
    K: int
    omega: str
    demonstrations: int
    seed: int
    n: int
    metric: str
    value: float
    model_hash: str
    config_hash: str
    version: str = __version__


def label(method: str, form: str = "", variant: str = "") -> str:
    """Label in tables and legends: name and form of the method, and its variant in brackets."""
    name = f"{method} {form}".strip()
    return f"{name} ({variant})" if variant else name
