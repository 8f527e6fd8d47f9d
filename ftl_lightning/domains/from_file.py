"""User data as a domain, without code: a file of demonstrations with a concept text for each.

The training concepts are the texts in order of first appearance. Plans have the length of the longest demonstration, or of
``horizon``. The configuration lists metrics, a name and a number each:

``recognised: P``
    right if the goal is the likeliest of all concepts with demonstrations, and the plan is as typical of it as a share P of real
    demonstrations: in place, size, shape and roughness, see :mod:`ftl_lightning.domains.recognition`.
``nearest_demonstration: K``
    right if most of the K demonstrations nearest to the plan (dynamic time warping, columns scaled alike) are of the goal.
``nearest_shape: K``
    right if most of the K demonstrations nearest in shape are of the goal: Euclidean distance after removing place (mean of each
    column) and size (root mean square). For behaviour at any place and size, such as pen strokes.
``end_point_within: R``
    right if the plan ends within R (Euclidean, in the file's units) of where a demonstration of the goal ends.
``dtw_within: R``
    right if the mean distance per step to the nearest demonstration of the goal, after dynamic time warping, is at most R.
``dtw_to_demonstrations: 1``
    this distance itself; less is better. The number does not matter.

Plans are compared with held-out demonstrations; for a new concept, with the demonstrations it was learned from.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Concepts, Domain, Metric, Plans, Split
from ftl_lightning.domains.hand_drawn import drawn_by_hand
from ftl_lightning.domains.recognition import Recognition
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.randomness import generator

OWN = "own"
"""Name of the domain of user data."""


@dataclass(frozen=True)
class FileSource:
    """Source that splits the demonstrations of a file.

    Attributes:
        demonstrations: all demonstrations.
        held_out: mask of the validation split, ``(demo,)`` of bool.
    """

    demonstrations: Demonstrations
    held_out: Tensor

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """All demonstrations of a split; ``count`` and ``seed`` are ignored."""
        wanted = self.held_out if name == "validation" else ~self.held_out
        return self.demonstrations.rows(wanted.nonzero()[:, 0].tolist())

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """The first ``count`` demonstrations of a concept.

        Raises:
            UserError: if there are fewer.
        """
        known = self.demonstrations.select(task) if task in self.demonstrations.concepts else None
        if known is None or len(known) < count:
            raise UserError(
                f"task: expected {count} demonstrations of {task!r} in the file, found {0 if known is None else len(known)}"
            )
        return known.rows(list(range(count)))

    def starts(self, task: str, count: int, seed: int) -> InitialStates | None:
        """Initial states of held-out demonstrations, drawn with replacement."""
        if not self.demonstrations.observed:
            return None
        known = self.split("validation", count, seed).initial_states
        return known.take(torch.randint(len(known), (count,), generator=generator("cpu", seed)))


def own_domain(
    examples: Demonstrations,
    training: Sequence[str],
    horizon: int,
    metrics: Mapping[str, float],
    source: FileSource | None = None,
) -> Domain:
    """Domain of user data.

    Args:
        examples: demonstrations that plans are compared with, at least one of each evaluated concept.
        training: training concepts.
        horizon: states in a plan.
        metrics: names and numbers, see this module.
        source: source of demonstrations; ``None`` for the examples.

    Raises:
        UserError: for an unknown metric.
    """
    if unknown := set(metrics) - set(METRICS):
        raise UserError(f"data.metrics: expected some of {', '.join(METRICS)}, found {', '.join(sorted(unknown))}")
    texts = tuple(dict.fromkeys(examples.concepts))
    every = source or FileSource(examples, torch.ones(len(examples), dtype=torch.bool))
    return Domain(
        name=OWN,
        plans=Plans(horizon, examples.state_names, examples.state_units),
        concepts=Concepts(
            training=tuple(training),
            reads=lambda text: text in texts,
        ),
        source=lambda root: every,
        observed=examples.features,
        metrics={name: METRICS[name](examples, horizon, number) for name, number in metrics.items()},
        headline=next(iter(metrics), ""),
        distance=partial(_warped, examples),
        fresh=False,  # the file is all there is
        recorder=drawn_by_hand(examples, horizon),
    )


def domain_from_file(path: str, horizon: int | None, metrics: Mapping[str, float], share: float) -> Domain:
    """Domain of a file.

    Args:
        path: the file, the folder of a LeRobot data set, or the name of an installed Minari data set.
        horizon: states in a plan; ``None`` for the length of the longest demonstration.
        metrics: see :func:`own_domain`.
        share: share of each concept's demonstrations to hold out, at least one.

    Raises:
        UserError: naming the file, if it has no texts, fewer than two concepts, or a concept with a single demonstration.
    """
    demonstrations = read_own(path)
    training = tuple(dict.fromkeys(demonstrations.concepts))
    if len(training) < 2:
        raise UserError(f"{path}: key 'concepts': expected texts of two concepts or more to pretrain on, found {len(training)}")
    held_out = torch.zeros(len(demonstrations), dtype=torch.bool)
    for text in training:
        rows = [row for row, concept in enumerate(demonstrations.concepts) if concept == text]
        if len(rows) < 2:
            raise UserError(f"{path}: concept {text!r}: expected two demonstrations or more (one is held out), found 1")
        held_out[rows[-max(1, math.floor(share * len(rows))) :]] = True
    source = FileSource(demonstrations, held_out)
    longest = int(demonstrations.lengths.max())
    return own_domain(source.split("validation", 0, 0), training, horizon or longest, metrics, source)


def read_own(path: str) -> Demonstrations:
    """Read user data; demonstrations without a text are named after the file.

    Args:
        path: ``.npz`` or safetensors, the folder of a LeRobot data set, or the name of an installed Minari data set such as
            ``strokes/test-v0``.

    Raises:
        UserError: naming the file, if it is missing or damaged.
    """
    return Demonstrations.load(path).named(Path(path).stem)


def read_demonstrations(path: str, domain: Domain) -> Demonstrations:
    """Read demonstrations of a domain; those without a text are named after the file or data set.

    Raises:
        UserError: naming the file, if it does not fit the domain.
    """
    demonstrations = read_own(path)
    columns = len(domain.plans.columns)
    if demonstrations.domain not in ("", domain.name):
        raise UserError(f"{path}: key 'domain': expected {domain.name!r}, found {short(demonstrations.domain)!r}")
    if demonstrations.states.shape[2] != columns:
        raise UserError(f"{path}: key 'states': expected shape (demo, time, {columns}), found {tuple(demonstrations.states.shape)}")
    with about(path):
        return demonstrations.fitted(domain.observed)


def _scaled(examples: Demonstrations, states: Tensor) -> tuple[Tensor, Tensor]:
    """Scale columns to standard deviation 1 over the examples; constant columns stay unscaled."""
    spread = examples.states.flatten(0, 1).std(dim=0)
    spread = torch.where(spread > 0, spread, 1)
    return examples.states / spread, states / spread


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


def _whole(states: Tensor) -> Tensor:
    return torch.full((len(states),), states.shape[1])


def _warped(examples: Demonstrations, states: Tensor, others: Tensor) -> Tensor:
    """:func:`warped_distances` ``(a, b)`` of whole plans, columns scaled as in :func:`_nearest_demonstration`."""
    (_, rows), (_, columns) = (_scaled(examples, each) for each in (states, others))
    if len(columns) < len(rows):  # loop over the smaller set
        return warped_distances(columns, _whole(columns), rows, _whole(rows)).T
    return warped_distances(rows, _whole(rows), columns, _whole(columns))


def _goal_rows(examples: Demonstrations, goal: str) -> list[int]:
    rows = [row for row, text in enumerate(examples.concepts) if text == goal]
    if not rows:
        raise UserError(f"goal: expected a concept with demonstrations to compare with, found {goal!r}")
    return rows


def _recognised(examples: Demonstrations, horizon: int, number: float) -> Metric:
    if not 0 < number <= 1:
        raise UserError(f"data.metrics.recognised: expected a share of real demonstrations above 0, at most 1, found {number:g}")
    known = cache(lambda: Recognition(examples, horizon, number))  # fitted on first use

    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        _goal_rows(examples, goal)
        return known().recognised(goal, states)

    return Metric(measure, identity=examples.hash)


def _nearest_demonstration(examples: Demonstrations, horizon: int, number: float) -> Metric:
    count = int(number)
    if count < 1:
        raise UserError(f"data.metrics.nearest_demonstration: expected 1 or more neighbours, found {number:g}")

    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        known, scaled = _scaled(examples, states)
        near = warped_distances(scaled, _whole(states), known[:, :horizon], examples.lengths.clamp(max=horizon))
        of_goal = torch.zeros(len(examples), dtype=torch.bool)
        of_goal[_goal_rows(examples, goal)] = True
        return of_goal[near.topk(min(count, len(examples)), largest=False).indices].float().mean(dim=1) > 0.5

    return Metric(measure, identity=examples.hash)


def _nearest_shape(examples: Demonstrations, horizon: int, number: float) -> Metric:
    count = int(number)
    if count < 1:
        raise UserError(f"data.metrics.nearest_shape: expected 1 or more neighbours, found {number:g}")
    times = torch.arange(horizon).clamp(max=examples.states.shape[1] - 1)
    known = _shapes(examples.states[:, times])

    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        of_goal = torch.zeros(len(examples), dtype=torch.bool)
        of_goal[_goal_rows(examples, goal)] = True
        near = torch.cdist(_shapes(states), known).topk(min(count, len(examples)), largest=False).indices
        return of_goal[near].float().mean(dim=1) > 0.5

    return Metric(measure, identity=examples.hash)


def _shapes(states: Tensor) -> Tensor:
    """Remove place and size of behaviour ``(n, time, state)``: ``(n, time * state)``."""
    moved = states - states.mean(dim=1, keepdim=True)
    return (moved / moved.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=1e-9)).flatten(1)


def _end_point_within(examples: Demonstrations, horizon: int, number: float) -> Metric:
    def measure(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
        rows = _goal_rows(examples, goal)
        ends = examples.states[rows, examples.lengths[rows].clamp(max=horizon) - 1]
        return torch.cdist(states[:, -1], ends).amin(dim=1) <= number

    return Metric(measure, identity=examples.hash)


def _to_demonstrations(examples: Demonstrations, horizon: int, goal: str, states: Tensor) -> Tensor:
    rows = _goal_rows(examples, goal)
    lengths = examples.lengths[rows].clamp(max=horizon)
    return warped_distances(states, _whole(states), examples.states[rows, :horizon], lengths).amin(dim=1)


def _dtw_within(examples: Demonstrations, horizon: int, number: float) -> Metric:
    return Metric(lambda goal, states, starts: _to_demonstrations(examples, horizon, goal, states) <= number, False, examples.hash)


def _dtw_to_demonstrations(examples: Demonstrations, horizon: int, number: float) -> Metric:
    return Metric(lambda goal, states, starts: _to_demonstrations(examples, horizon, goal, states), True, examples.hash)


METRICS: dict[str, Callable[[Demonstrations, int, float], Metric]] = {
    "recognised": _recognised,
    "nearest_demonstration": _nearest_demonstration,
    "nearest_shape": _nearest_shape,
    "end_point_within": _end_point_within,
    "dtw_within": _dtw_within,
    "dtw_to_demonstrations": _dtw_to_demonstrations,
}
