"""Comparison of results: names of methods and forms, published numbers, reference policies and distances between plans."""

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from ftl_lightning.data.distances import Distance
from ftl_lightning.data.features import InitialStates

OURS, FINE_TUNED = "FTL-IGM", "LoRA fine-tuning"
"""Names of the paper's method, and of the baseline that learns a concept with an adapter of the whole network."""
WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN = "with modes", "with knots", "with adapter", "form chosen"
FORMS = (WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN)
"""Forms of a method beyond the paper, in the order in which their names are joined, as in ``'with modes, with knots'``."""


class Compared(NamedTuple):
    """Method and form, as compared in tables.

    Attributes:
        name: such as ``'FTL-IGM'`` or ``'BC'``.
        form: some of :data:`FORMS`, or the method's description; empty for the paper's form, a single set of embeddings.
    """

    name: str
    form: str = ""


PAPERS_METHOD = Compared(OURS)


@dataclass(frozen=True)
class Published:
    """A number of the paper.

    Attributes:
        setting: setting of the :class:`~ftl_lightning.domains.tasks.EvaluationTask`.
        value: the number, such as an accuracy in [0, 1].
        error: standard error over tasks; ``None`` for a single task or if not reported.
        components: number of components K.
        omega: the fixed guidance weight as text, or ``'learned'``.
        task: name of the evaluation task; ``''`` for the mean of the setting.
        metric: name of the metric in the results.
        method: our method, or the name of a baseline.
    """

    setting: str
    value: float
    error: float | None = None
    components: int = 2
    omega: str = "learned"
    task: str = ""
    metric: str = "accuracy"
    method: str = OURS


def published(path: Path) -> tuple[Published, ...]:
    """Numbers of the paper in a CSV file, whose columns are the attributes of :class:`Published` and the place in the paper."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [(float(row["value"]), float(row["error"]) if row["error"] else None, int(row["components"])) for row in rows]
    texts = [(row["omega"], row["task"], row["metric"], row["method"]) for row in rows]
    return tuple(Published(row["setting"], *of, *named) for row, of, named in zip(rows, numbers, texts, strict=True))


@dataclass(frozen=True)
class Paper:
    """Numbers that the paper reports for a domain.

    Attributes:
        numbers: all numbers.
        omega: guidance weight of two components in the paper's main figures, as text.
        ours: guidance weight of our results beside them in the main tables, as text.
        comparable: whether the numbers were measured under our conditions; reports omit others, such as those of a real robot.
    """

    numbers: tuple[Published, ...]
    omega: str
    ours: str
    comparable: bool = True


@dataclass(frozen=True)
class Comparison:
    """Standards that results of a domain are compared with.

    Attributes:
        ours: our method, in the form that baselines are compared with; by default the paper's form.
        headline: main measure: the name of a metric, or ``'closed loop '`` and the name of an outcome.
        references: reference policies (trivial policies and oracles) by name: ``(goal, samples, initial states or None, seed) ->
            states (sample, horizon, state)``.
        distance: distance between plans for novelty and coverage, ``(states (a, horizon, state), others (b, horizon, state)) ->
            (a, b)``; ``None`` for the root mean square over a plan's times, with columns scaled to standard deviation 1.
        fresh: whether the source draws demonstrations of any goal fast enough for every evaluation; otherwise coverage is not
            measured.
        paper: published numbers; ``None`` for none.
    """

    ours: Compared = PAPERS_METHOD
    headline: str = "accuracy"
    references: Mapping[str, Callable[[str, int, InitialStates | None, int], Tensor]] = field(default_factory=dict)
    distance: Distance | None = None
    fresh: bool = True
    paper: Paper | None = None
