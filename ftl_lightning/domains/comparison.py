"""Comparison of results: names of methods and forms, published numbers, reference policies and distances between plans."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates

OURS = "FTL-IGM"
"""Name of the paper's method."""
FINE_TUNED = "LoRA fine-tuning"
"""Baseline: learning a concept with an adapter of the whole network."""
WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN = "with modes", "over time", "with adapter", "form chosen"
"""Forms of a method beyond the paper: concepts with modes, several knots or an adapter, or the form selected by leave-one-out."""
FORMS = (WITH_MODES, WITH_KNOTS, WITH_ADAPTER, CHOSEN)
"""Order in which forms are joined by a space: ``'with modes over time'``."""

Distance = Callable[[Tensor, Tensor], Tensor]
"""``(states (a, horizon, state), others (b, horizon, state)) -> (a, b)``: symmetric, 0 for the same behaviour."""


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


def path_distance(paths: Tensor, others: Tensor) -> Tensor:
    """Root mean square over the horizon of the Euclidean distance, in the columns' unit.

    Args:
        paths: ``(a, horizon, column)``.
        others: ``(b, horizon, column)``.

    Returns:
        ``(a, b)``.
    """
    # Differences, not products: the distance of a path to itself is exactly 0.
    between = torch.cdist(paths.flatten(1), others.flatten(1), compute_mode="donot_use_mm_for_euclid_dist")
    return between / paths.shape[1] ** 0.5


def scaled_distance(real: Tensor, resolution: float = 0.0) -> Distance:
    """Generic distance: :func:`path_distance` of columns scaled to standard deviation 1.

    Scales are of real behaviour, not of samples: widely spread samples must not seem close.

    Args:
        real: behaviour ``(n, time, state)`` of the task.
        resolution: columns that vary by less are not scaled.
    """
    spread = real.flatten(0, 1).std(dim=0, correction=0)
    spread = torch.where(spread > resolution, spread, 1)
    return lambda states, others: path_distance(states / spread, others / spread)


def warped_distances(states: Tensor, lengths: Tensor, others: Tensor, other_lengths: Tensor) -> Tensor:
    """Mean distance per step after dynamic time warping (Sakoe & Chiba, 1978).

    Args:
        states: ``(n, time, state)``.
        lengths: ``(n,)``.
        others: ``(m, other time, state)``.
        other_lengths: ``(m,)``.

    Returns:
        ``(n, m)``: the minimum sum of Euclidean distances along a warping path, divided by the longer length.
    """
    total = []
    for path, length in zip(states, lengths.tolist(), strict=True):
        cost = torch.cdist(path[None, :length].expand(len(others), -1, -1), others)  # (m, length, other time)
        far = torch.full((len(others),), math.inf)
        before = torch.full((len(others), cost.shape[2] + 1), math.inf)
        before[:, 0] = 0
        for row in cost.unbind(dim=1):
            here = [far]
            for column in range(cost.shape[2]):
                here.append(row[:, column] + torch.minimum(torch.minimum(before[:, column], before[:, column + 1]), here[-1]))
            before = torch.stack(here, dim=1)
        ends = before.gather(1, other_lengths[:, None])[:, 0]
        total.append(ends / other_lengths.clamp(min=length))
    return torch.stack(total)
