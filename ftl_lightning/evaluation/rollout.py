"""Episodes of a policy in a user's Gymnasium environment: success, returns, films and latency."""

import importlib
import inspect
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ftl_lightning.domains.domain import SUCCESS
from ftl_lightning.evaluation.closed_loop import lock_step
from ftl_lightning.evaluation.generation import Generation, TaskResult
from ftl_lightning.evaluation.pictures import gif
from ftl_lightning.evaluation.policy import POLICY_STEPS, Policy
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError, require, short, shown
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import EVALUATION_SEED
from ftl_lightning.services.tensor_file import atomic
from ftl_lightning.services.text import Shown, counted
from ftl_lightning.services.trust import OPTION, is_vouched
from ftl_lightning.training.concept_model import ConceptModel

if TYPE_CHECKING:
    import gymnasium

SUCCESSES = ("is_success", "success")
"""Keys of success in an environment's ``info``, tried in this order."""
SIDE_BY_SIDE = 16
"""Maximum number of environments that are made."""
LONGEST = 1000
"""Maximum steps of an episode in an environment that has no limit."""
TIMED = 20
"""Number of chunks that measure the latency."""
Z = 1.96
"""Standard normal quantile of a 95 % interval."""


@dataclass(frozen=True)
class Place:
    """A user's environment.

    Attributes:
        environment, success: see :func:`environment_of` and :meth:`FewShot.rollout`.
        episodes: number of episodes of each task.
    """

    environment: str
    success: str | None
    episodes: int


@dataclass(frozen=True, repr=False)
class Episodes(Shown):
    """Episodes in an environment.

    Attributes:
        successes: ``(episode,)`` of bool; ``None`` if success is unknown.
        returns: sum of the rewards of each episode.
        lengths: number of steps of each episode.
        failed: episodes without a finite action or with an error of the environment, which are no success.
        infos: the environment's ``info`` of each episode's last step.
        milliseconds: processor wall time of each chunk of a single episode: the action after which a plan is sampled or corrected.
        first_milliseconds: time of the first action of a single episode, which samples the plan.
        frames: pictures of the first episode ``(height, width, 3)``, if the environment renders them.
    """

    successes: tuple[bool, ...] | None
    returns: tuple[float, ...]
    lengths: tuple[int, ...]
    failed: tuple[bool, ...]
    infos: tuple[Mapping[str, Any], ...]
    milliseconds: tuple[float, ...]
    first_milliseconds: float
    frames: tuple[NDArray[np.uint8], ...] = field(default=())

    def __len__(self) -> int:
        return len(self.returns)

    @property
    def success(self) -> float:
        """Share of successful episodes; NaN if success is unknown."""
        return math.nan if self.successes is None else statistics.fmean(self.successes)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the success rate (Wilson, 1927)."""
        if self.successes is None:
            return math.nan, math.nan
        count, rate, square = len(self.successes), self.success, Z**2
        middle = (rate + square / (2 * count)) / (1 + square / count)
        half = Z / (1 + square / count) * math.sqrt(rate * (1 - rate) / count + square / (4 * count**2))
        return max(middle - half, 0.0), min(middle + half, 1.0)

    @property
    def latency(self) -> tuple[float, float]:
        """Median and 95th percentile of :attr:`milliseconds`."""
        return float(np.median(self.milliseconds)), float(np.quantile(self.milliseconds, 0.95))

    def _words(self) -> Iterator[str]:
        yield counted(len(self), "episode")
        if self.successes is None:
            yield "success unknown: name it with success="
        else:
            yield "success {:.2f} ({:.2f} to {:.2f})".format(self.success, *self.interval)
        yield f"return {statistics.fmean(self.returns):.3g}"
        if any(self.failed):
            yield f"{sum(self.failed)} failed"
        yield "a chunk takes {:.1f} ms (95 %: {:.1f})".format(*self.latency)

    def save(self, path: str | Path) -> None:
        """Save the first episode as an animation; ``path`` ends in .gif.

        Raises:
            UserError: for another suffix, or an environment that renders no pictures.
        """
        require(Path(path).suffix == ".gif", str(path), "a name that ends in .gif", Path(path).suffix or "no ending")
        found = 'none; make the environment with render_mode="rgb_array"'
        require(self.frames, "film", "pictures of the first episode", found)
        with atomic(path) as temporary:
            temporary.write_bytes(gif(self.frames))


def rollout(
    policy: Policy,
    environment: "str | Callable[[], gymnasium.Env[Any, Any]] | gymnasium.Env[Any, Any]",
    episodes: int = 50,
    success: str | Callable[[Mapping[str, Any]], bool] | None = None,
    steps: int | None = None,
    seed: int = 0,
) -> Episodes:
    """Run episodes in lockstep, in up to :data:`SIDE_BY_SIDE` environments; see :meth:`FewShot.rollout`."""
    made = [_made(environment)]
    several = isinstance(environment, type) or not hasattr(environment, "step")
    made += [_made(environment) for _ in range(min(SIDE_BY_SIDE, episodes) - 1 if several else 0)]
    with ExitStack() as stack:
        for each in made if several else ():
            stack.enter_context(closing(each))
        limit = steps or getattr(made[0].spec, "max_episode_steps", None) or LONGEST
        record = _Record(policy, made, episodes, seed)
        with bar(f"{episodes} episodes", limit * episodes, lines=False) as advance:
            for first in range(0, episodes, len(made)):
                rows = range(first, min(first + len(made), episodes))
                record.run(rows, limit, advance)
        require(record.begun is not None, "environment", "episodes that begin", "none; the warnings above say why")
        first_time, times = _latency(policy, record.begun, seed)
    return Episodes(
        _successes(record.infos, record.failed, success),
        tuple(record.returns),
        tuple(record.lengths),
        tuple(record.failed),
        tuple(record.infos),
        times,
        first_time,
        tuple(record.frames),
    )


def environment_of(reference: str, key: str) -> "Callable[[str], gymnasium.Env[Any, Any]]":
    """Function that makes the environment of a goal's text.

    Args:
        reference: name of a registered environment, or ``'package.module:function'``. The function may take the goal's text. Its
            module must be named by the user: a configuration file alone does not suffice, as the function runs.
        key: option that holds the reference, for errors.

    Raises:
        UserError: for a module that the user did not name, or without such a function.
    """
    module, colon, name = reference.partition(":")
    if not colon:
        return lambda goal: _made(reference)
    refused = f"{short(reference)!r} in a file; name it on the command line, or add {OPTION} {short(module)}"
    require(is_vouched(reference), key, "a function that the command line names", refused)
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise UserError(f"{key}: expected 'package.module:function', found {short(str(error), 150)}") from error
    require(callable(function), key, "a function", shown(function))
    takes = bool(inspect.signature(function).parameters)
    return lambda goal: _made(partial(function, goal) if takes else function)


def played(
    model: ConceptModel, judged: Sequence[TaskResult], compositions: Sequence[Composition], place: Place, generation: Generation
) -> list[TaskResult]:
    """Add episodes in a user's environment to results, with the outcomes ``success``, if it is known, and ``return``.

    Args:
        model: model of a user's data.
        judged, compositions: results and their compositions.
        place: environment, success, and number of episodes of each task.
        generation: settings of the plans, of which a policy takes at most :data:`POLICY_STEPS` sampler steps.
    """
    make = environment_of(place.environment, "evaluation.environment")
    sampling = replace(generation.sampling, steps=min(POLICY_STEPS, generation.steps))
    results = []
    for behaviour, composition in zip(judged, compositions, strict=True):
        policy = Policy(model, composition, sampling, generation.replan)
        episodes = rollout(policy, partial(make, behaviour.task.goal), place.episodes, place.success, seed=generation.seed)
        outcomes = {"return": torch.tensor(episodes.returns)}
        if episodes.successes is not None:
            outcomes = {SUCCESS: torch.tensor(episodes.successes), **outcomes}
        results.append(replace(behaviour, outcomes=outcomes))
    return results


def _made(environment: Any) -> "gymnasium.Env[Any, Any]":
    import gymnasium

    if isinstance(environment, str):
        try:
            return gymnasium.make(environment, render_mode="rgb_array")
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            raise UserError(f"environment: expected the name of a Gymnasium environment, found {short(str(error), 150)}") from error
    made = environment if hasattr(environment, "step") and not isinstance(environment, type) else environment()
    require(hasattr(made, "step") and hasattr(made, "reset"), "environment", "a Gymnasium environment", shown(made))
    return made


class _Record:
    """Episodes so far."""

    def __init__(self, policy: Policy, environments: "list[gymnasium.Env[Any, Any]]", episodes: int, seed: int) -> None:
        self._policy, self._environments, self._seed = policy, environments, seed
        self._latest: dict[int, Any] = {}
        self.begun: Any = None
        self.returns, self.lengths, self.failed = [0.0] * episodes, [0] * episodes, [False] * episodes
        self.infos: list[dict[str, Any]] = [{} for _ in range(episodes)]
        self.frames: list[NDArray[np.uint8]] = []

    def run(self, rows: range, steps: int, advance: Callable[..., None]) -> None:
        """Run episodes in lockstep."""
        from gymnasium.spaces import Box, Discrete

        environments = {row: self._environments[row - rows.start] for row in rows}
        follow = self._policy.following(rows.stop, self._seed)
        space: Any = environments[rows.start].action_space
        discrete = isinstance(space, Discrete)  # whose actions are rounded
        require(discrete or isinstance(space, Box), "environment", "a Box or Discrete action space", shown(type(space).__name__))
        ends = (space.start, space.start + space.n - 1) if discrete else ()
        low, high = map(np.atleast_1d, ends or (space.low, space.high))

        def act(active: list[int], step: int) -> list[Any]:
            each = [self._policy.observed(self._latest[row])[0] for row in active]
            observed = {name: torch.cat([one[name] for one in each]) for name in each[0]}
            with torch.inference_mode():
                actions = follow(observed, active, step).numpy().astype(np.float32)
            require(actions.shape[1:] == low.shape, "act", f"actions of shape {low.shape}", actions.shape[1:])
            limited = np.where(np.isfinite(actions), actions.clip(low, high), actions)
            if discrete:
                return [int(np.rint(value)) if np.isfinite(value) else value for value in limited[:, 0]]
            return list(limited.astype(low.dtype))

        def seen(row: int, step: int, observation: Any, reward: float, info: Mapping[str, Any]) -> None:
            self.begun = observation if self.begun is None else self.begun
            self._latest[row], self.lengths[row], self.infos[row] = observation, step, dict(info)
            self.returns[row] += reward
            if row == 0 and environments[row].render_mode == "rgb_array":
                self.frames.append(np.asarray(environments[row].render(), dtype=np.uint8))

        def failed(row: int) -> None:
            self.failed[row] = True

        def reset(row: int) -> Any:
            return environments[row].reset(seed=EVALUATION_SEED + self._seed + row)[0]

        lock_step(environments, reset, act, steps, seen, failed, advance)


def _successes(
    infos: list[dict[str, Any]], failed: list[bool], success: str | Callable[[Mapping[str, Any]], bool] | None
) -> tuple[bool, ...] | None:
    """Success of each episode by the ``info`` of its last step; ``None`` if unknown."""
    if callable(success):
        return tuple(bool(success(info)) and not lost for info, lost in zip(infos, failed, strict=True))
    known = [key for key in SUCCESSES if any(key in info for info in infos)]
    if success is None and not known:
        return None
    key = known[0] if success is None else success.removeprefix("info.")
    keys = short(", ".join(dict.fromkeys(key for info in infos for key in info)), 120) or "none"
    require(any(key in info for info in infos), "success", f"'info.KEY' with one of {keys}", shown(success))
    return tuple(bool(np.all(info.get(key, False))) and not lost for info, lost in zip(infos, failed, strict=True))


def _latency(policy: Policy, observation: Any, seed: int) -> tuple[float, tuple[float, ...]]:
    """Milliseconds of the first action and of :data:`TIMED` later chunks of a single episode that stays where it begins."""
    times: list[float] = []
    while len(times) <= TIMED:
        follow = policy.following(1, seed)
        for step in range(max(policy.model.horizon - 1, policy.execute + 1)):
            begin = time.perf_counter()
            observed, _ = policy.observed(observation)
            with torch.inference_mode():
                follow(observed, [0], step)
            if step % policy.execute == 0 and (step or not times):
                times.append(1000 * (time.perf_counter() - begin))
    return times[0], tuple(times[1 : 1 + TIMED])
