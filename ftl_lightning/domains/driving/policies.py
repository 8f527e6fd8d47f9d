"""Baseline policies from the same initial states: constant decision, random, look-up, regressions and the expert."""

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import InitialStates, Observed
from ftl_lightning.domains.domain import Policy
from ftl_lightning.domains.driving.motion import drive
from ftl_lightning.domains.driving.shipped import training_set
from ftl_lightning.domains.driving.tasks import TRAINING_CONCEPTS
from ftl_lightning.domains.driving.traffic import STATE, TRAFFIC, check_simulator, origin
from ftl_lightning.domains.driving.views import VIEWS
from ftl_lightning.services.randomness import generator

if TYPE_CHECKING:
    from highway_env.envs.common.abstract import AbstractEnv

Make = Callable[[str, InitialStates, Demonstrations | None, int], Policy | None]
SHOWN = 100
"""Demonstrations per training scenario for the look-up and the regressions."""
MLP_STEPS = 400


def _made(goal: str) -> "AbstractEnv":
    """Environment of the scenario, for its names of decisions."""
    check_simulator()
    from ftl_lightning.domains.driving.scenarios import make

    return make(goal)


def _always(name: str) -> Make:
    """Constant decision, subject to the planner's veto."""

    def policy(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
        number = float(_made(goal).action_type.actions_indexes[name])
        return lambda observed, rows, step: torch.full((len(rows), 1), number)

    return policy


def _random(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """Uniformly random decisions."""
    count = int(_made(goal).action_space.n)
    draws = [generator("cpu", seed, row) for row in range(len(starts))]
    return lambda observed, rows, step: torch.stack([torch.randint(count, (1,), generator=draws[row]).float() for row in rows])


def _transitions(goal: str, demonstrations: Demonstrations | None) -> tuple[Observed, Tensor]:
    """Observations ``(n, *shape)`` by name and next states ``(n, 7)`` of all steps of the demonstrations."""
    known = training_set("train", SHOWN).select(goal) if demonstrations is None else demonstrations
    pairs = [(row, time) for row, length in enumerate(known.lengths.tolist()) for time in range(length - 1)]
    rows, times = torch.tensor(pairs).T
    return {name: values[rows, times] for name, values in known.observed.items()}, known.states[rows, times + 1]


def _nearest(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """Successor of the nearest demonstrated state."""
    seen, following = _transitions(goal, demonstrations)
    places = seen[TRAFFIC][:, :STATE]
    return lambda observed, rows, step: following[torch.cdist(observed[TRAFFIC][:, :STATE], places).argmin(dim=1)]


def _regression(fit: Callable[[Tensor, Tensor, torch.Generator], Callable[[Tensor], Tensor]]) -> Make:
    """Predict drives ``(n, 4)`` from the models' view of the observations.

    Args:
        fit: ``(inputs (n, 35), drives (n, 4), generator) -> prediction``, both arguments standardised.
    """

    def policy(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
        seen, following = _transitions(goal, demonstrations)
        view = VIEWS["steps"].observe
        inputs, drives = view(seen)[TRAFFIC], drive(seen[TRAFFIC][:, :STATE], following)
        middle, spread = inputs.mean(dim=0), inputs.std(dim=0).clamp(min=1e-3)
        mean, scale = drives.mean(dim=0), drives.std(dim=0).clamp(min=1e-3)
        predict = fit((inputs - middle) / spread, (drives - mean) / scale, generator("cpu", seed))
        return lambda observed, rows, step: predict((view(observed)[TRAFFIC] - middle) / spread) * scale + mean

    return policy


def _ridge(inputs: Tensor, drives: Tensor, draw: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Least squares with a penalty of 1 on standardised inputs."""
    terms = torch.cat((inputs, torch.ones(len(inputs), 1)), dim=1).double()
    weights = torch.linalg.solve(terms.T @ terms + torch.eye(terms.shape[1], dtype=torch.double), terms.T @ drives.double()).float()
    return lambda seen: seen @ weights[:-1] + weights[-1]


def _mlp(inputs: Tensor, drives: Tensor, draw: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Two hidden layers of 64, 400 full-batch steps."""
    layers: list[Tensor] = []

    def predict(seen: Tensor) -> Tensor:
        for number in range(0, len(layers), 2):
            seen = seen @ layers[number] + layers[number + 1]
            seen = torch.nn.functional.silu(seen) if number < len(layers) - 2 else seen
        return seen

    with torch.inference_mode(False), torch.enable_grad():  # also within evaluation
        for before, after in itertools.pairwise((inputs.shape[1], 64, 64, drives.shape[1])):
            weight = torch.randn(before, after, generator=draw) / before**0.5
            layers += [weight.requires_grad_(), torch.zeros(after, requires_grad=True)]
        inputs, drives = inputs.clone(), drives.clone()
        optimizer = torch.optim.AdamW(layers, lr=3e-3, weight_decay=0.1)
        for _ in range(MLP_STEPS):
            optimizer.zero_grad()
            (predict(inputs) - drives).square().mean().backward()
            optimizer.step()
    return lambda seen: predict(seen).detach()


def _expert(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy | None:
    """Next state of the expert; not in training scenarios, where it takes minutes (see the data card for its rates)."""
    if goal in TRAINING_CONCEPTS:
        return None
    check_simulator()
    from ftl_lightning.domains.driving.generation import episode

    drives = [torch.from_numpy(episode(*origin(start))[0][:, 0]) for start in starts.require_scenes().numpy()]
    return lambda observed, rows, step: torch.stack([drives[row][min(step + 1, len(drives[row]) - 1)] for row in rows])


POLICIES = {
    "IDLE": _always("IDLE"),
    "random": _random,
    "FASTER": _always("FASTER"),
    "nearest demonstration": _nearest,
    "ridge regression": _regression(_ridge),
    "MLP regression": _regression(_mlp),
    "expert (oracle)": _expert,
}
"""Baseline policies by name; all are subject to the planner's veto."""
