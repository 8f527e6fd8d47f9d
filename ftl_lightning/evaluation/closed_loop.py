"""Executing plans: environments step in lock-step, their plans are made in one batch (paper, 'closed loop')."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from rich.progress import Progress
from torch import Tensor

from ftl_lightning.diffusion.samplers import Sampler
from ftl_lightning.domains.domain import ClosedLoop
from ftl_lightning.learning.generative_model import GenerativeModel

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
        failed: ``(episode,)`` of bool: a plan was not finite, and the episode ended there.
    """

    observations: Tensor
    failed: Tensor


def roll_out(loop: ClosedLoop, initial_states: Tensor, plan: Plan, replan: int) -> Rollout:
    """Run one episode from each initial state until its environment ends it, :data:`SIDE_BY_SIDE` at a time.

    Args:
        loop: the domain's environment and planner.
        initial_states: ``(episode, m)``.
        plan: makes the plans of those episodes that still run.
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.
    """
    count = len(initial_states)
    observations = initial_states[:, None].repeat(1, loop.steps + 1, 1)
    failed = torch.zeros(count, dtype=torch.bool)
    with Progress(transient=True) as progress:
        bar = progress.add_task(f"{count} episodes", total=loop.steps * math.ceil(count / SIDE_BY_SIDE))
        for rows in torch.arange(count).split(SIDE_BY_SIDE):
            _lock_step(loop, rows.tolist(), observations, failed, plan, replan, lambda: progress.advance(bar))
    return Rollout(observations, failed)


def _lock_step(
    loop: ClosedLoop,
    rows: list[int],
    observations: Tensor,
    failed: Tensor,
    plan: Plan,
    replan: int,
    advance: Callable[[], None],
) -> None:
    """Run these episodes together, one step of each after the other, and fill in their observations and failures."""
    environments = {row: loop.environment() for row in rows}
    try:
        for row, environment in environments.items():
            initial = observations[row, 0].numpy()
            observations[row] = torch.as_tensor(environment.reset(options={"initial_state": initial})[0])
        active, plans = rows, torch.empty(0)
        for step in range(loop.steps):
            advance()
            if active and step % replan == 0:
                plans = plan(observations[active, step], active)
                finite = plans.isfinite().flatten(1).all(dim=1)
                for row in [row for row, good in zip(active, finite.tolist(), strict=True) if not good]:
                    failed[row] = True
                    _LOG.warning("episode %d, step %d: the plan is not finite; the episode counts as failed", row, step)
                active, plans = [row for row, good in zip(active, finite.tolist(), strict=True) if good], plans[finite]
            if not active:
                break
            actions = loop.act(plans, step % replan, observations[active, step]).numpy().astype(np.float32)
            going = []
            for place, row in enumerate(active):
                seen, _, terminated, truncated, _ = environments[row].step(actions[place])
                observations[row, step + 1 :] = torch.as_tensor(seen)
                if not (terminated or truncated):
                    going.append(place)
            active, plans = [active[place] for place in going], plans[going]
    finally:
        for environment in environments.values():
            environment.close()


def sampled_plans(
    model: GenerativeModel,
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
        seen = observations.to(model.alpha_bar.device)
        return model.sample(own, omega, 1, sampler, steps, temperature, draws, seen)[:, 0].cpu()  # type: ignore[arg-type]

    return plan


def fixed_plans(plans: Tensor) -> Plan:
    """Plans ``(episode, horizon, state)`` that are made once, such as those of reference policies."""
    return lambda observations, rows: plans[rows]
