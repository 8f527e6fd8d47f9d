"""Executing plans: environments step in lock-step, their plans are made in one batch (paper, 'closed loop')."""

import itertools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.progress import Progress
from torch import Tensor

from ftl_lightning.diffusion.samplers import Sampler
from ftl_lightning.domains.domain import ClosedLoop, Policy
from ftl_lightning.learning.concept_model import ConceptModel

_LOG = logging.getLogger(__name__)

Plan = Callable[[Tensor, list[int]], Tensor]
"""``(observations (episode, m), which episodes) -> plans (episode, horizon, state)``."""
SIDE_BY_SIDE = 64
"""Episodes that run together: a simulator takes tens of megabytes, and a larger batch makes no plan faster."""


@dataclass(frozen=True)
class Rollout:
    """What happened.

    Attributes:
        observations: ``(episode, steps + 1, m)``, padded with an episode's last one.
        failed: ``(episode,)`` of bool: the policy had no finite action or the environment raised an error; the episode ended there.
        infos: what the environment told of each episode's last step, by name.
    """

    observations: Tensor
    failed: Tensor
    infos: list[dict[str, Any]]

    def split(self, counts: Sequence[int]) -> list["Rollout"]:
        """The same in parts of so many episodes."""
        ends = list(itertools.accumulate(counts))
        return [
            Rollout(self.observations[start:end], self.failed[start:end], self.infos[start:end])
            for start, end in zip([0, *ends], ends, strict=False)
        ]


def roll_out(loop: ClosedLoop, initial_states: Tensor, policy: Policy) -> Rollout:
    """Run one episode from each initial state until its environment ends it, :data:`SIDE_BY_SIDE` at a time.

    Args:
        loop: the domain's environment.
        initial_states: ``(episode, m)``.
        policy: acts in those episodes that still run.
    """
    count = len(initial_states)
    found = Rollout(
        initial_states[:, None].repeat(1, loop.steps + 1, 1), torch.zeros(count, dtype=torch.bool), [{} for _ in range(count)]
    )
    with Progress(transient=True) as progress:
        bar = progress.add_task(f"{count} episodes", total=loop.steps * math.ceil(count / SIDE_BY_SIDE))
        for rows in torch.arange(count).split(SIDE_BY_SIDE):
            _lock_step(loop, rows.tolist(), found, policy, lambda: progress.advance(bar))
    return found


def _lock_step(loop: ClosedLoop, rows: list[int], found: Rollout, policy: Policy, advance: Callable[[], None]) -> None:
    """Run these episodes together, one step of each after the other, and fill in what happened."""
    environments: dict[int, gymnasium.Env[Any, Any]] = {}
    observations = found.observations
    try:
        for row in rows:
            environments[row] = loop.environment()
            initial = observations[row, 0].numpy()
            observations[row] = torch.as_tensor(environments[row].reset(options={"initial_state": initial})[0])
        active = rows
        for step in range(loop.steps):
            advance()
            if not active:
                break
            actions = policy(observations[active, step], active, step).numpy().astype(np.float32)
            going = []
            for row, action in zip(active, actions, strict=True):
                if not np.isfinite(action).all():
                    found.failed[row] = True
                    _LOG.warning("episode %d, step %d: the plan is not finite; the episode counts as failed", row, step)
                    continue
                try:
                    seen, _, terminated, truncated, info = environments[row].step(action)
                except Exception as error:  # whatever a simulator raises: the other episodes go on
                    found.failed[row] = True
                    _LOG.warning("episode %d, step %d: %s; the episode counts as failed", row, step, repr(error))
                    continue
                observations[row, step + 1 :] = torch.as_tensor(seen)
                found.infos[row].update(info)
                if not (terminated or truncated):
                    going.append(row)
            active = going
    finally:
        for environment in environments.values():
            environment.close()


class Following:
    """The policy that follows plans. Where one holds a number that is not finite, there is no action.

    Args:
        plan: makes plans.
        act: the domain's planner, see :class:`~ftl_lightning.domains.domain.ClosedLoop`.
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.

    Attributes:
        followed: for each episode the plan ``(horizon, state)`` of each of its steps.
    """

    def __init__(self, plan: Plan, act: Callable[[Tensor, int, Tensor], Tensor], replan: int) -> None:
        self._plan, self._act, self._replan = plan, act, replan
        self.followed: dict[int, list[Tensor]] = {}

    def __call__(self, observations: Tensor, rows: list[int], step: int) -> Tensor:
        age = step % self._replan
        if age == 0:
            made = self._plan(observations, rows)
            finite = made.isfinite().flatten(1).all(dim=1)
            plans = torch.where(finite[:, None, None], made, torch.nan)
        else:
            plans = torch.stack([self.followed[row][-1] for row in rows])
        for row, plan in zip(rows, plans, strict=True):
            self.followed.setdefault(row, []).append(plan)
        return self._act(plans, age, observations)


def sampled_plans(
    model: ConceptModel,
    concepts: Sequence[Tensor],
    weights: Sequence[Tensor],
    sampler: Sampler,
    steps: int,
    temperature: float,
    generators: Sequence[torch.Generator],
) -> Plan:
    """Plans from a model: composition, weights and noise are an episode's own, so that it does not depend on its neighbours.

    Args:
        model: the model.
        concepts, weights: of each episode, ``(K, n)`` and ``(K,)``.
        sampler, steps, temperature: see :mod:`ftl_lightning.diffusion.samplers`.
        generators: of each episode's noise.
    """

    def plan(observations: Tensor, rows: list[int]) -> Tensor:
        own, omega, draws = ([values[row] for row in rows] for values in (concepts, weights, generators))
        seen = observations.to(model.device)
        return model.sample(own, omega, 1, sampler, steps, temperature, draws, seen)[:, 0].cpu()  # type: ignore[arg-type]

    return plan


def planner(model: ConceptModel, loop: ClosedLoop) -> Callable[[Tensor, int, Tensor], Tensor]:
    """What follows a model's plans: the domain's planner, or that of the model's view."""
    return model.view.act if model.view is not None and model.view.act is not None else loop.act


def fixed_plans(plans: Tensor) -> Plan:
    """Plans ``(episode, horizon, state)`` that are made once, such as those of reference policies."""
    return lambda observations, rows: plans[rows]
