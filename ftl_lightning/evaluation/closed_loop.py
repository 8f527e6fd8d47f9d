"""Executing plans: environments step in lock-step, their plans are made in one batch (paper, 'closed loop')."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.features import InitialStates, Observed, moved, take
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.domain import ClosedLoop, Policy
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.errors import UserError
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.progress import Advance, bar

if TYPE_CHECKING:
    import gymnasium

_LOG = logging.getLogger(__name__)

Planner = Callable[[Tensor, int, Observed], Tensor]
"""``(plans (episode, horizon, state), steps since they were made, observed) -> actions (episode, action)``."""
MakePlans = Callable[[Observed, list[int]], Tensor]
"""``(observed (episode, *shape) by name, which episodes) -> plans (episode, horizon, state)``."""
SIDE_BY_SIDE = 64
"""Episodes that run together: a simulator takes tens of megabytes, and a larger batch makes no plan faster."""


def roll_out(loop: ClosedLoop, starts: InitialStates, policy: Policy) -> Rollout:
    """Run one episode from each scene until its environment ends it, :data:`SIDE_BY_SIDE` at a time.

    Args:
        loop: the domain's environment.
        starts: initial states with scenes.
        policy: acts in those episodes that still run.

    Raises:
        UserError: naming the episode, for a scene that cannot be built.
        MemoryError, OSError: for what the machine lacks; what else an environment raises costs its episode alone.
    """
    count, kept = len(starts), loop.keeps or tuple(starts.observed)
    observed = {
        name: starts.observed[name][:, None].repeat(1, loop.steps + 1, *(1,) * (starts.observed[name].dim() - 1)) for name in kept
    }
    found = Rollout(starts, observed, torch.zeros(count, dtype=torch.bool), [{} for _ in range(count)])
    with bar(f"{count} episodes", loop.steps * count, lines=False) as advance:
        for rows in torch.arange(count).split(SIDE_BY_SIDE):
            _lock_step(loop, rows.tolist(), found, policy, advance)
    return found


def reset(loop: ClosedLoop, scenes: Tensor) -> InitialStates:
    """What is observed where an environment is reset to scenes ``(episode, scene)``.

    Raises:
        UserError: naming the episode, for a scene that cannot be built.
    """
    environment = loop.environment()
    try:
        seen = [_begun(environment, row, scene) for row, scene in enumerate(scenes)]
    finally:
        environment.close()
    return InitialStates({name: torch.stack([torch.as_tensor(one[name]) for one in seen]) for name in seen[0]}, scenes)


def _begun(environment: "gymnasium.Env[Any, Any]", row: int, scene: Tensor) -> Any:
    """What is observed where an episode starts."""
    try:
        return environment.reset(options={"scene": scene.numpy()})[0]
    except UserError as error:
        raise UserError(f"episode {row}: {error}") from error


def _lock_step(loop: ClosedLoop, rows: list[int], found: Rollout, policy: Policy, advance: Advance) -> None:
    """Run these episodes together, one step of each after the other, and fill in what happened."""
    environments: dict[int, gymnasium.Env[Any, Any]] = {}
    scenes = found.starts.require_scenes()
    # What is seen now, of every feature; a rollout keeps some of them.
    now = {name: values[rows].clone() for name, values in found.starts.observed.items()}
    place = {row: index for index, row in enumerate(rows)}

    def fail(row: int, why: str) -> None:
        found.failed[row] = True
        _LOG.warning("episode %d, %s; the episode counts as failed", row, why)

    def see(row: int, step: int, seen: Observed) -> None:
        for name, values in now.items():
            if not isinstance(seen, Mapping) or name not in seen or tuple(np.shape(seen[name])) != tuple(values.shape[1:]):
                found_shape = np.shape(seen[name]) if isinstance(seen, Mapping) and name in seen else "none"
                raise UserError(f"environment: expected it to observe {name!r} {tuple(values.shape[1:])}, found {found_shape}")
            values[place[row]] = torch.as_tensor(seen[name])
            if name in found.observed:
                found.observed[name][row, step:] = values[place[row]]

    try:
        active = []
        for row in rows:
            environments[row] = loop.environment()
            try:
                seen = _begun(environments[row], row, scenes[row])
            except (UserError, MemoryError, OSError):
                raise
            except Exception as error:  # whatever a simulator raises: the other episodes go on
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
                found.infos[row].update(info)
                if not (terminated or truncated):
                    going.append(row)
            advance((len(active) - len(going)) * (loop.steps - step - 1))  # of those that have ended
            active = going
    finally:
        for environment in environments.values():
            environment.close()


class PlanFollower:
    """The policy that follows plans. Where one holds a number that is not finite, there is no action.

    Args:
        make: makes plans.
        act: the domain's planner, see :class:`~ftl_lightning.domains.domain.ClosedLoop`.
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.

    Attributes:
        followed: for each episode the plan ``(horizon, state)`` of each of its steps.
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
    """Plans from a model: composition and noise are an episode's own, so that it does not depend on its neighbours.

    Args:
        model: the model.
        compositions: of each episode, ``(K, ...)``.
        sampling: sampler, steps and temperature.
        generators: of each episode's noise, and of its mode, which it keeps to its end.
    """
    compositions = [one.drawn(draw) for one, draw in zip(compositions, generators, strict=True)]

    def make(observed: Observed, rows: list[int]) -> Tensor:
        own, draws = [compositions[row] for row in rows], [generators[row] for row in rows]
        return model.sample(own, 1, sampling, draws, moved(observed, model.device))[:, 0].cpu()

    return make


def planner(model: ConceptModel, loop: ClosedLoop) -> Planner:
    """What follows a model's plans: the domain's planner, or that of the model's view."""
    return model.view.act if model.view is not None and model.view.act is not None else loop.act


def fixed_plans(plans: Tensor) -> MakePlans:
    """Plans ``(episode, horizon, state)`` that are made once, such as those of reference policies."""
    return lambda observed, rows: plans[rows]
