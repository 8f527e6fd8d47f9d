"""Names of methods and forms, and numbers reported by a paper."""

from dataclasses import dataclass
from typing import NamedTuple

OURS = "FTL-IGM"
"""Name of the paper's method."""
FINE_TUNED = "LoRA fine-tuning"
"""Baseline: learning a concept with an adapter of the whole network."""
WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN = "with modes", "over time", "with adapter", "form chosen"
"""Forms of a method beyond the paper: concepts with modes, several knots or an adapter, or the form selected by leave-one-out."""
FORMS = (WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN)
"""Order in which forms are joined by a space: ``'with modes over time'``."""


class Compared(NamedTuple):
    """Method and form, as compared in tables.

    Attributes:
        name: such as ``'FTL-IGM'`` or ``'BC'``.
        form: form of its concepts: some of :data:`FORMS`, or the method's description; empty for the paper's form, a single set of
            embeddings that is constant over time.
    """

    name: str
    form: str = ""


PAPERS_METHOD = Compared(OURS)
"""Our method in the paper's form."""


@dataclass(frozen=True)
class Published:
    """A number of the paper.

    Attributes:
        setting: as in :class:`~ftl_lightning.domains.tasks.EvaluationTask`.
        value: the number, such as an accuracy in [0, 1].
        error: standard error over tasks; ``None`` for a single task or where it is not reported.
        components: K.
        omega: the fixed weight as text, or ``'learned'``.
        task: name of the evaluation task; ``''`` for the mean of the setting.
        metric: as in a row of the results.
        method: ours, or a baseline's name.
    """

    setting: str
    value: float
    error: float | None = None
    components: int = 2
    omega: str = "learned"
    task: str = ""
    metric: str = "accuracy"
    method: str = OURS


@dataclass(frozen=True)
class Paper:
    """What the paper reports of a domain.

    Attributes:
        numbers: all of them.
        omega: guidance weight of two components in the paper's main figures, as text.
        ours: guidance weight that our main tables compare with it, as text.
        comparable: whether its numbers were measured as ours are. Where they were not, such as on a robot, reports show none of
            them beside ours.
    """

    numbers: tuple[Published, ...]
    omega: str
    ours: str
    comparable: bool = True
