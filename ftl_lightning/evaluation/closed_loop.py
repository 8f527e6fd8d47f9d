"""Closed-loop execution: environments step in lockstep with batched planning (paper, 'closed loop')."""

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates, Observed, moved, take
from ftl_lightning.domains.execution import ClosedLoop, Policy, Rollout
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError, about, require
from ftl_lightning.services.progress import Advance, bar
from ftl_lightning.training.concept_model import ConceptModel

if TYPE_CHECKING:
    import gymnasium

_LOG = logging.getLogger(__name__)

Planner = Callable[[Tensor, int, Observed], Tensor]
"""``(plans (episode, horizon, state), age in steps, observed) -> actions (episode, action)``."""
MakePlans = Callable[[Observed, list[int]], Tensor]
"""``(observed (episode, *shape) by name, episode numbers) -> plans (episode, horizon, state)``."""
Seen = Callable[[int, int, Any, float, Mapping[str, Any]], None]
"""``(episode, step, observation, reward, info)``; step 0 is the reset."""
SIDE_BY_SIDE = 64
"""Number of parallel episodes: a simulator takes tens of megabytes, and a larger batch plans no faster."""


def roll_out(loop: ClosedLoop, starts: InitialStates, policy: Policy) -> Rollout:
    """Run an episode from each scene of ``starts`` until its environment ends it, :data:`SIDE_BY_SIDE` at a time.

    Gymnasium's ``SyncVectorEnv`` cannot do this: it resets all environments with the same options, an error of one environment ends
    all episodes, and without autoreset it fails at the first step after an episode has ended (version 1.4).

    Raises:
        UserError: naming the episode, for a scene that cannot be built.
        MemoryError, OSError: from an environment; any other error only fails its episode.
    """
    count = len(starts)
    observed = {
        name: values[:, None].repeat(1, loop.steps + 1, *(1,) * (values.dim() - 1))
        for name, values in starts.observed.items()
        if name in loop.keeps or not loop.keeps
    }
    rollout = Rollout(starts, observed, torch.zeros(count, dtype=torch.bool), [{} for _ in range(count)])
    with bar(f"{count} episodes", loop.steps * count, lines=False) as advance:
        for first in range(0, count, SIDE_BY_SIDE):
            _episodes(loop, range(first, min(first + SIDE_BY_SIDE, count)), rollout, policy, advance)
    return rollout


def reset(loop: ClosedLoop, scenes: Tensor) -> InitialStates:
    """Observe the initial states of an environment reset to scenes ``(episode, scene)``.

    Raises:
        UserError: naming the episode, for a scene that cannot be built.
    """
    with closing(loop.environment()) as environment:
        observed = [_reset(environment, row, scene) for row, scene in enumerate(scenes)]
    return InitialStates({name: torch.stack([torch.as_tensor(first[name]) for first in observed]) for name in observed[0]}, scenes)


def _reset(environment: "gymnasium.Env[Any, Any]", row: int, scene: Tensor) -> Any:
    """Reset to a scene and return the observation."""
    with about(f"episode {row}"):
        return environment.reset(options={"scene": scene.numpy()})[0]


def _episodes(loop: ClosedLoop, rows: range, rollout: Rollout, policy: Policy, advance: Advance) -> None:
    """Run consecutive episodes of a domain's environment in lockstep and fill in the rollout."""
    scenes = rollout.starts.require_scenes()
    # Current values of all features; the rollout keeps some of them.
    current = {name: values[rows.start : rows.stop].clone() for name, values in rollout.starts.observed.items()}

    def seen(row: int, step: int, observation: Any, reward: float, info: Mapping[str, Any]) -> None:
        rollout.infos[row].update(info)
        for name, values in current.items():
            value = observation.get(name) if isinstance(observation, Mapping) else None
            shape, place = tuple(values.shape[1:]), row - rows.start
            if value is None or np.shape(value) != shape:
                actual = "none" if value is None else np.shape(value)
                raise UserError(f"environment: expected it to observe {name!r} {shape}, found {actual}")
            values[place] = torch.as_tensor(value)
            if name in rollout.observed:
                rollout.observed[name][row, step:] = values[place]

    def act(active: list[int], step: int) -> NDArray[np.float32]:
        return policy(take(current, [row - rows.start for row in active]), active, step).numpy().astype(np.float32)

    def failed(row: int) -> None:
        rollout.failed[row] = True

    with ExitStack() as stack:
        environments = {row: stack.enter_context(closing(loop.environment())) for row in rows}
        lock_step(environments, lambda row: _reset(environments[row], row, scenes[row]), act, loop.steps, seen, failed, advance)


def lock_step(
    environments: "Mapping[int, gymnasium.Env[Any, Any]]",
    reset: Callable[[int], Any],
    act: Callable[[list[int], int], Sequence[Any] | NDArray[np.float32]],
    steps: int,
    seen: Seen,
    failed: Callable[[int], None],
    advance: Advance,
) -> None:
    """Run episodes in lockstep, each until its environment ends it. An error of an environment only fails its episode.

    Args:
        environments: environment of each episode.
        reset: ``episode -> first observation``.
        act: ``(active episodes, step) -> actions (episode, action)``; not finite for no action, which fails the episode.
        steps: maximum number of steps.
        seen: called after a reset and after each step.
        failed: called for an episode that fails.
        advance: called with numbers of steps.

    Raises:
        UserError, MemoryError, OSError: from an environment.
    """
    active: list[int] = []

    def fail(row: int, reason: str) -> None:
        failed(row)
        _LOG.warning("episode %d, %s; the episode counts as failed", row, reason)

    for row in environments:
        try:
            observation = reset(row)
        except (UserError, MemoryError, OSError):
            raise
        except Exception as error:  # any error of a simulator: the other episodes go on
            fail(row, f"before its first step: {error!r}")
            advance(steps)
            continue
        seen(row, 0, observation, 0.0, {})
        active.append(row)
    for step in range(steps):
        if not active:
            break
        actions = act(active, step)
        require(len(actions) == len(active), "planner", f"actions of {len(active)} episodes", len(actions))
        continuing = []
        for row, action in zip(active, actions, strict=True):
            advance()
            if not np.isfinite(action).all():
                fail(row, f"step {step}: the plan is not finite")
                continue
            try:
                observation, reward, terminated, truncated, info = environments[row].step(action)
            except (MemoryError, OSError):
                raise
            except Exception as error:  # as above
                fail(row, f"step {step}: {error!r}")
                continue
            seen(row, step + 1, observation, float(reward), info)
            if not (terminated or truncated):
                continuing.append(row)
        advance((len(active) - len(continuing)) * (steps - step - 1))  # remaining steps of ended episodes
        active = continuing


class PlanFollower:
    """Policy that makes plans, and replans after ``replan`` steps; 1 in the paper. A plan with a non-finite value becomes NaN.

    ``act`` is the domain's planner, see :class:`~ftl_lightning.domains.domain.ClosedLoop`.

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
    """Sample plans from a model, independently for each episode, with its composition ``(K, ...)`` and its generator.

    A generator draws noise and the mode, which is kept for the whole episode.
    """
    compositions = [composition.drawn(draw) for composition, draw in zip(compositions, generators, strict=True)]

    def make(observed: Observed, rows: list[int]) -> Tensor:
        batch, draws = [compositions[row] for row in rows], [generators[row] for row in rows]
        return model.sample(batch, 1, sampling, draws, moved(observed, model.device))[:, 0].cpu()

    return make


def planner(model: ConceptModel, loop: ClosedLoop) -> Planner:
    """Planner of the model's view, else of the domain."""
    return model.view.act if model.view is not None and model.view.act is not None else loop.act


def fixed_plans(plans: Tensor) -> MakePlans:
    """Use fixed plans ``(episode, horizon, state)``, such as those of reference policies."""
    return lambda observed, rows: plans[rows]
