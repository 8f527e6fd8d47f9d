"""One evaluated number, as it stands in a results file; tables of them are in :mod:`ftl_lightning.evaluation.results`."""

from dataclasses import dataclass

from ftl_lightning.version import __version__

METHOD, REFERENCE = "method", "reference"
"""Roles: what learns or is told a concept, and what stands beside it (chance, trivial policies, oracles)."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One number.

    Attributes:
        domain, setting, task: what was evaluated.
        method: the method's name, for example ``'FTL-IGM'`` or ``'BC'``, or a reference line's.
        form: of the method, see :class:`~ftl_lightning.domains.paper.Compared`; empty for the paper's.
        variant: what tells settings of one method and form apart, for example ``'entities, free'``; may be empty.
        role: :data:`METHOD` or :data:`REFERENCE`.
        K: number of concept components; 0 where nothing was learned.
        omega: the fixed guidance weight as text, ``'learned'``, or ``'none'`` for a method without; empty for a reference line.
        demonstrations: that the task's concept was learned from; 0 where nothing was learned.
        seed: of pretraining and inversion.
        n: number of samples or episodes behind the value.
        metric: for example ``'accuracy'``.
        value: the number.
        model_hash: of the pretrained model.
        config_hash: of everything that was configured; the same hash and version give the same value.
        version: of this package.
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
    """What tables and legends show: a method's name and form, and its variant in brackets."""
    name = f"{method} {form}".strip()
    return f"{name} ({variant})" if variant else name
