"""Names of methods and of their forms, and numbers that a paper reports, to be shown beside ours."""

from dataclasses import dataclass
from typing import NamedTuple

OURS = "FTL-IGM"
"""The name of the paper's method."""
FINE_TUNED = "LoRA fine-tuning"
"""Learning a concept with an adapter that changes the whole network: what ours is compared with."""
WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN = "with modes", "over time", "with adapter", "form chosen"
"""Forms of a method whose concepts have modes, several knots or an adapter, which the paper's have not, or whichever of these the
demonstrations ask for."""
FORMS = (WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN)
"""In the order in which several are joined, by one space: ``'with modes over time'``."""


class Compared(NamedTuple):
    """A method in one of its forms, which tables compare with others.

    Attributes:
        name: such as ``'FTL-IGM'`` or ``'BC'``.
        form: how its concepts are otherwise than in one set of embeddings that is alike at all times, the paper's form: some of
            :data:`FORMS`, or a method's own words; empty for the paper's.
    """

    name: str
    form: str = ""


PAPERS_METHOD = Compared(OURS)
"""Ours as the paper has it."""


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
