"""Closed-loop execution: environments step in lockstep with batched planning (paper, 'closed loop')."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates, Observed, moved, take
from ftl_lightning.domains.execution import ClosedLoop, Policy, Rollout
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import Advance, bar
from ftl_lightning.training.concept_model import ConceptModel

if TYPE_CHECKING:
    import gymnasium

_LOG = logging.getLogger(__name__)

Planner = Callable[[Tensor, int, Observed], Tensor]
"""``(plans (episode, horizon, state), age in steps, observed) -> actions (episode, action)``."""
MakePlans = Callable[[Observed, list[int]], Tensor]
"""``(observed (episode, *shape) by name, episode numbers) -> plans (episode, horizon, state)``."""
SIDE_BY_SIDE = 64
"""Number of parallel episodes: a simulator takes tens of megabytes, and a larger batch plans no faster."""


def roll_out(loop: ClosedLoop, starts: InitialStates, policy: Policy) -> Rollout:
    """Run an episode from each scene until its environment ends it, :data:`SIDE_BY_SIDE` at a time.

    Args:
        loop: the domain's environment.
        starts: initial states with scenes.
        policy: policy of the running episodes.

    Raises:
        UserError: naming the episode, for a scene that cannot be built.
        MemoryError, OSError: from an environment; any other error only fails its episode.
    """
    count, kept = len(starts), loop.keeps or tuple(starts.observed)
    observed = {
        name: starts.observed[name][:, None].repeat(1, loop.steps + 1, *(1,) * (starts.observed[name].dim() - 1)) for name in kept
    }
    rollout = Rollout(starts, observed, torch.zeros(count, dtype=torch.bool), [{} for _ in range(count)])
    with bar(f"{count} episodes", loop.steps * count, lines=False) as advance:
        for rows in torch.arange(count).split(SIDE_BY_SIDE):
            _lock_step(loop, rows.tolist(), rollout, policy, advance)
    return rollout


def reset(loop: ClosedLoop, scenes: Tensor) -> InitialStates:
    """Observe the initial states of an environment reset to scenes ``(episode, scene)``.

    Raises:
        UserError: naming the episode, for a scene that cannot be built.
    """
    environment = loop.environment()
    try:
        seen = [_reset(environment, row, scene) for row, scene in enumerate(scenes)]
    finally:
        environment.close()
    return InitialStates({name: torch.stack([torch.as_tensor(first[name]) for first in seen]) for name in seen[0]}, scenes)


def _reset(environment: "gymnasium.Env[Any, Any]", row: int, scene: Tensor) -> Any:
    """Reset to a scene and return the observation."""
    try:
        return environment.reset(options={"scene": scene.numpy()})[0]
    except UserError as error:
        raise UserError(f"episode {row}: {error}") from error


def _lock_step(loop: ClosedLoop, rows: list[int], rollout: Rollout, policy: Policy, advance: Advance) -> None:
    """Run episodes in lockstep and fill in the rollout."""
    environments: dict[int, gymnasium.Env[Any, Any]] = {}
    scenes = rollout.starts.require_scenes()
    # Current values of all features; the rollout keeps some of them.
    now = {name: values[rows].clone() for name, values in rollout.starts.observed.items()}
    place = {row: index for index, row in enumerate(rows)}

    def fail(row: int, why: str) -> None:
        rollout.failed[row] = True
        _LOG.warning("episode %d, %s; the episode counts as failed", row, why)

    def see(row: int, step: int, seen: Observed) -> None:
        for name, values in now.items():
            if not isinstance(seen, Mapping) or name not in seen or tuple(np.shape(seen[name])) != tuple(values.shape[1:]):
                shape = np.shape(seen[name]) if isinstance(seen, Mapping) and name in seen else "none"
                raise UserError(f"environment: expected it to observe {name!r} {tuple(values.shape[1:])}, found {shape}")
            values[place[row]] = torch.as_tensor(seen[name])
            if name in rollout.observed:
                rollout.observed[name][row, step:] = values[place[row]]

    try:
        active = []
        for row in rows:
            environments[row] = loop.environment()
            try:
                seen = _reset(environments[row], row, scenes[row])
            except (UserError, MemoryError, OSError):
                raise
            except Exception as error:  # any error of a simulator: the other episodes go on
                fail(row, f"before its first step: {error!r}")
                advance(loop.steps)
                continue
            see(row, 0, seen)
            active.append(row)
        for step in range(loop.steps):
            if not active:
                break
            actions = policy(take(now, [place[row] for row in active]), active, step).numpy().astype(np.float32)
            if len(actions) != len(active):
                raise UserError(f"planner: expected actions of {len(active)} episodes, found shape {actions.shape}")
            going = []
            for row, action in zip(active, actions, strict=True):
                advance()
                if not np.isfinite(action).all():
                    fail(row, f"step {step}: the plan is not finite")
                    continue
                try:
                    seen, _, terminated, truncated, info = environments[row].step(action)
                except (MemoryError, OSError):
                    raise
                except Exception as error:  # as above
                    fail(row, f"step {step}: {error!r}")
                    continue
                see(row, step + 1, seen)
                rollout.infos[row].update(info)
                if not (terminated or truncated):
                    going.append(row)
            advance((len(active) - len(going)) * (loop.steps - step - 1))  # remaining steps of ended episodes
            active = going
    finally:
        for environment in environments.values():
            environment.close()


class PlanFollower:
    """Policy that follows plans. A plan with a non-finite value becomes NaN.

    Args:
        make: function that makes plans.
        act: the domain's planner, see :class:`~ftl_lightning.domains.domain.ClosedLoop`.
        replan: number of steps before replanning; 1 in the paper.

    Attributes:
        followed: plan ``(horizon, state)`` at each step, by episode.
    """

    def __init__(self, make: MakePlans, act: Planner, replan: int) -> None:
        self._make, self._act, self._replan = make, act, replan
        self.followed: dict[int, list[Tensor]] = {}

    def __call__(self, observed: Observed, rows: list[int], step: int) -> Tensor:
        age = step % self._replan
        if age == 0:
            made = self._make(observed, rows)
            finite = made.isfinite().flatten(1).all(dim=1)
            plans = torch.where(finite[:, None, None], made, torch.nan)
        else:
            plans = torch.stack([self.followed[row][-1] for row in rows])
        for row, plan in zip(rows, plans, strict=True):
            self.followed.setdefault(row, []).append(plan)
        return self._act(plans, age, observed)


def sampled_plans(
    model: ConceptModel, compositions: Sequence[Composition], sampling: Sampling, generators: Sequence[torch.Generator]
) -> MakePlans:
    """Sample plans from a model, independently for each episode.

    Args:
        model: generative model.
        compositions: composition of each episode ``(K, ...)``.
        sampling: sampler, steps and temperature.
        generators: generator of each episode's noise and mode; the mode is kept for the whole episode.
    """
    compositions = [composition.drawn(draw) for composition, draw in zip(compositions, generators, strict=True)]

    def make(observed: Observed, rows: list[int]) -> Tensor:
        batch, draws = [compositions[row] for row in rows], [generators[row] for row in rows]
        return model.sample(batch, 1, sampling, draws, moved(observed, model.device))[:, 0].cpu()

    return make


def planner(model: ConceptModel, loop: ClosedLoop) -> Planner:
    """The planner of the model's view, if it has one, else the domain's."""
    return model.view.act if model.view is not None and model.view.act is not None else loop.act


def fixed_plans(plans: Tensor) -> MakePlans:
    """Use fixed plans ``(episode, horizon, state)``, such as those of reference policies."""
    return lambda observed, rows: plans[rows]
