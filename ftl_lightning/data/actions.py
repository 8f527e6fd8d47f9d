"""Actions as columns of states, and an inverse model that obtains them from consecutive states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.services.randomness import generator

ACTION = "action"
"""First word of the names of columns of actions, where they are joined to the columns of states."""
UNITS_HIDDEN, RIDGES = 512, (1e-8, 1e-6, 1e-4, 1e-2)
"""Number of random features of the inverse model, and ridge penalties to choose from."""
LARGEST_FIT = 20_000
"""Maximum number of transitions that the inverse model is fitted to."""


def action_columns(names: Sequence[str]) -> tuple[int, ...]:
    """Columns of a state that are actions, by their names, whatever their case."""
    return tuple(column for column, name in enumerate(names) if name.strip().lower().startswith(ACTION))


def named_actions(names: Sequence[str]) -> tuple[str, ...]:
    """Names of actions as columns of a state."""
    return tuple(name if action_columns((name,)) else f"{ACTION} {name}" for name in names)


def held_actions(actions: Tensor, lengths: Tensor, time: int) -> Tensor:
    """Actions ``(demo, time, action)`` of demonstrations with as many actions as states, or with one less.

    Where the last state has none, the action before is repeated.

    Args:
        actions: ``(demo, time, action)`` or ``(demo, time - 1, action)``.
        lengths: number of states of each demonstration ``(demo,)``.
        time: number of states that demonstrations are padded to.
    """
    if actions.dim() != 3 or actions.shape[1] not in (time - 1, time) or len(actions) != len(lengths):
        return actions  # refused by the demonstrations
    last = (lengths - (1 if actions.shape[1] == time else 2)).clamp(min=0)
    times = torch.minimum(torch.arange(time), last[:, None])
    return actions[torch.arange(len(actions))[:, None], times]


@dataclass(frozen=True)
class InverseModel:
    """Actions from consecutive states, by ridge regression on random features of both.

    Attributes:
        centre, scale: mean and standard deviation of a state and of a step ``(2 * state,)``.
        weights: of the random features ``(1 + 2 * state, feature)``.
        readout: ``(1 + 2 * state + feature, action)``.
        low, high: extremes of the actions ``(action,)``.
        error: mean squared error on demonstrations that were left out of a fit, as a share of the actions' variance.
    """

    centre: Tensor
    scale: Tensor
    weights: Tensor
    readout: Tensor
    low: Tensor
    high: Tensor
    error: float

    @classmethod
    def fit(cls, states: Tensor, actions: Tensor, lengths: Tensor) -> Self:
        """Fit to all transitions of demonstrations; every third of them measures error and ridge penalty of a fit to the others.

        Args:
            states, actions: ``(demo, time, state)`` and ``(demo, time, action)``.
            lengths: valid times of each demonstration ``(demo,)``.
        """
        before = torch.arange(states.shape[1] - 1) < (lengths - 1)[:, None]  # (demo, time)
        row = torch.arange(len(states))[:, None].expand_as(before)[before]
        chosen = torch.randperm(len(row), generator=generator("cpu", 0))[:LARGEST_FIT]
        first, second = states[:, :-1][before].double(), states[:, 1:][before].double()
        inputs, outputs = torch.cat((first, second - first), dim=1)[chosen], actions[:, :-1][before].double()[chosen]
        centre, scale = inputs.mean(dim=0), inputs.std(dim=0).clamp(min=1e-9)
        weights = torch.randn(1 + inputs.shape[1], UNITS_HIDDEN, generator=generator("cpu", 1), dtype=torch.float64)
        weights[1:] /= inputs.shape[1] ** 0.5
        features = _features((inputs - centre) / scale, weights)
        left = row[chosen] % 3 == 2 if len(states) > 2 else torch.arange(len(inputs)) % 3 == 2
        variance = outputs.var(dim=0, correction=0).sum().clamp(min=1e-12)
        errors = {}
        for ridge in RIDGES:
            readout = _ridge(features[~left], outputs[~left], ridge)
            errors[ridge] = float((features[left] @ readout - outputs[left]).square().sum(dim=1).mean() / variance)
        ridge = min(RIDGES, key=lambda value: errors[value])
        readout = _ridge(features, outputs, ridge)
        return cls(centre, scale, weights, readout, outputs.amin(dim=0), outputs.amax(dim=0), errors[ridge])

    def __call__(self, states: Tensor, following: Tensor) -> Tensor:
        """Actions ``(sample, action)`` that lead from ``states (sample, state)`` to ``following (sample, state)``."""
        first, second = states.double(), following.double()
        inputs = (torch.cat((first, second - first), dim=1) - self.centre) / self.scale
        return (_features(inputs, self.weights) @ self.readout).clamp(self.low, self.high).float()


def _features(inputs: Tensor, weights: Tensor) -> Tensor:
    """Constant, inputs and random features ``(sample, 1 + input + feature)``."""
    affine = torch.cat((inputs.new_ones(len(inputs), 1), inputs), dim=1)
    return torch.cat((affine, torch.tanh(affine @ weights)), dim=1)


def _ridge(features: Tensor, outputs: Tensor, ridge: float) -> Tensor:
    gram = features.T @ features
    penalty = ridge * len(features) * torch.eye(len(gram), dtype=gram.dtype)
    return torch.linalg.solve(gram + penalty, features.T @ outputs)
