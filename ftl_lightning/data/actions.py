"""Actions as columns of states, and an inverse model that obtains them from consecutive states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.services.randomness import generator

ACTION = "action"
"""First word of the names of columns of actions, where they are joined to the columns of states."""
PRESENT = "present state"
"""Observed feature that is added to demonstrations with actions: the state from which a window begins, after the states before it
that belong to a history.
"""
INITIAL = "initial state"
"""Observed feature that is added to demonstrations with actions whose plans are whole: the first state, without its actions."""
CONTEXT = "context "
"""Beginning of the name of the observed feature that holds columns which do not change in a demonstration, such as goals; their
names follow, separated by commas.
"""
STILL = 1e-5
"""Maximum range of a column that does not change in a demonstration, relative to its range over all."""
RIDGES = 1e-8, 1e-5, 1e-2
"""Ridge penalties to choose from."""
HIDDEN, LARGEST_FIT = 512, 20_000
"""Number of random features of an inverse model, and maximum number of transitions that it is fitted to."""
QUICK_HIDDEN, QUICK_FIT = 128, 3_000
"""The same of regressions that show what actions follow."""
FOLLOWS = 0.5
"""Maximum error of actions that are predicted from the present state, relative to those predicted from the initial state and time,
for plans to begin at the present state."""
SLACK = 0.05
"""Error that is no reason to choose, as a share of the variance of actions."""
MOST_CONCEPTS = 4
"""Number of concepts that are examined."""


def action_columns(names: Sequence[str]) -> tuple[int, ...]:
    """Columns of a state that are actions, by their names, whatever their case."""
    return tuple(column for column, name in enumerate(names) if name.strip().lower().startswith(ACTION))


def named_actions(names: Sequence[str]) -> tuple[str, ...]:
    """Names of actions as columns of a state."""
    return tuple(name if action_columns((name,)) else f"{ACTION} {name}" for name in names)


def held_actions(actions: Tensor, lengths: Tensor, time: int) -> Tensor:
    """Actions ``(demo, time, action)`` of demonstrations with as many actions as states, or with one less; also of single numbers.

    Where the last state has none, the action before is repeated.

    Args:
        actions: ``(demo, time, action)`` or ``(demo, time - 1, action)``, or the same without the last dimension.
        lengths: number of states of each demonstration ``(demo,)``.
        time: number of states that demonstrations are padded to.
    """
    actions = actions[..., None] if actions.dim() == 2 else actions
    if actions.dim() != 3 or actions.shape[1] not in (time - 1, time) or len(actions) != len(lengths):
        return actions  # refused by the demonstrations
    last = (lengths - (1 if actions.shape[1] == time else 2)).clamp(min=0)
    times = torch.minimum(torch.arange(time), last[:, None])
    return actions[torch.arange(len(actions))[:, None], times]


@dataclass(frozen=True)
class Regression:
    """Ridge regression on random features.

    Attributes:
        centre, scale: mean and standard deviation of the inputs ``(input,)``.
        weights: of the random features ``(1 + input, feature)``.
        readout: ``(1 + input + feature, output)``.
        low, high: extremes of the outputs ``(output,)``, which limit predictions.
        error: mean squared error on demonstrations that were left out of a fit, as a share of the outputs' variance.
    """

    centre: Tensor
    scale: Tensor
    weights: Tensor
    readout: Tensor
    low: Tensor
    high: Tensor
    error: float

    @classmethod
    def fit(cls, inputs: Tensor, outputs: Tensor, rows: Tensor, hidden: int, most: int) -> Self:
        """Fit to samples ``(sample, input)`` and ``(sample, output)`` of demonstrations ``rows (sample,)``.

        At most ``most`` samples are used, with ``hidden`` random features. Every third demonstration measures the error and the
        ridge penalty of a fit to the others.
        """
        chosen = torch.randperm(len(rows), generator=generator("cpu", 0))[:most]
        inputs, outputs, rows = inputs[chosen].double(), outputs[chosen].double(), rows[chosen]
        centre, scale = inputs.mean(dim=0), inputs.std(dim=0).clamp(min=1e-9)
        weights = torch.randn(1 + inputs.shape[1], hidden, generator=generator("cpu", 1), dtype=torch.float64)
        weights[1:] /= inputs.shape[1] ** 0.5
        features = _features((inputs - centre) / scale, weights)
        left = rows % 3 == 2 if int(rows.max()) > 1 else torch.arange(len(inputs)) % 3 == 2
        variance = outputs.var(dim=0, correction=0).sum().clamp(min=1e-12)
        errors = {}
        for ridge in RIDGES:
            readout = _ridge(features[~left], outputs[~left], ridge)
            errors[ridge] = float((features[left] @ readout - outputs[left]).square().sum(dim=1).mean() / variance)
        ridge = min(RIDGES, key=lambda value: errors[value])
        readout = _ridge(features, outputs, ridge)
        return cls(centre, scale, weights, readout, outputs.amin(dim=0), outputs.amax(dim=0), errors[ridge])

    def __call__(self, inputs: Tensor) -> Tensor:
        """Outputs ``(sample, output)`` of ``inputs (sample, input)``."""
        features = _features((inputs.double() - self.centre) / self.scale, self.weights)
        return (features @ self.readout).clamp(self.low, self.high).float()


def inverse_model(states: Tensor, actions: Tensor, lengths: Tensor, ahead: int = 1) -> Regression:
    """Regression of actions on the present state and the difference to the state some steps ahead ``(sample, 2 * state)``.

    Args:
        states, actions: ``(demo, time, state)`` and ``(demo, time, action)``.
        lengths: valid times of each demonstration ``(demo,)``.
        ahead: number of steps; at the end of a demonstration its last state is ahead.
    """
    row, time = _times(lengths - 1)
    first, later = states[row, time].double(), torch.minimum(time + ahead, lengths[row] - 1)
    inputs = torch.cat((first, states[row, later].double() - first), dim=1)
    return Regression.fit(inputs, actions[row, time], row, HIDDEN, LARGEST_FIT)


def forward_model(states: Tensor, actions: Tensor, lengths: Tensor) -> Regression:
    """Regression of the step to the next state on the present state and action; arguments as of :func:`inverse_model`."""
    row, time = _times(lengths - 1)
    first = states[row, time].double()
    inputs = torch.cat((first, actions[row, time].double()), dim=1)
    return Regression.fit(inputs, states[row, time + 1].double() - first, row, HIDDEN, LARGEST_FIT)


def follows_present(states: Tensor, actions: Tensor, lengths: Tensor, concepts: Sequence[str], observed: Tensor) -> bool:
    """Whether actions follow from the present state much better than from the initial state and time, in most concepts.

    Args:
        states, actions: ``(demo, time, state)`` and ``(demo, time, action)``.
        lengths: valid times of each demonstration ``(demo,)``.
        concepts: concept of each demonstration.
        observed: observed vectors ``(demo, time, size)``.
    """
    votes: list[bool] = []
    for name in dict.fromkeys(concepts):
        some = torch.tensor([index for index, text in enumerate(concepts) if text == name])
        if len(votes) == MOST_CONCEPTS or len(some) < 3:
            continue
        row, time = _times(lengths[some])
        known = torch.cat((states[some].double(), observed[some].double()), dim=2)
        outputs = actions[some][row, time]
        inputs = (known[row, time], torch.cat((known[row, 0], time[:, None].double()), dim=1))
        now, first = (Regression.fit(each, outputs, row, QUICK_HIDDEN, QUICK_FIT).error for each in inputs)
        votes.append(now + SLACK < FOLLOWS * first)
    return sum(votes) * 2 > len(votes)


def _times(lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Demonstration and time ``(sample,)`` of every state within lengths."""
    valid = torch.arange(int(lengths.max())) < lengths[:, None]
    row, time = valid.nonzero(as_tuple=True)
    return row, time


def _features(inputs: Tensor, weights: Tensor) -> Tensor:
    """Constant, inputs and random features ``(sample, 1 + input + feature)``."""
    affine = torch.cat((inputs.new_ones(len(inputs), 1), inputs), dim=1)
    return torch.cat((affine, torch.tanh(affine @ weights)), dim=1)


def _ridge(features: Tensor, outputs: Tensor, ridge: float) -> Tensor:
    gram = features.T @ features
    penalty = ridge * len(features) * torch.eye(len(gram), dtype=gram.dtype)
    return torch.linalg.solve(gram + penalty, features.T @ outputs)
