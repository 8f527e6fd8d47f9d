"""Demonstrations of Meta-World's scripted experts."""

import functools
import itertools
import multiprocessing
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate, padded
from ftl_lightning.data.features import InitialStates, Observed
from ftl_lightning.data.formats.files import cached
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.execution import Policy
from ftl_lightning.services.errors import require
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import VALIDATION_SEED, task_key
from ftl_lightning.services.text import silence
from ftl_metaworld.environment import COLUMNS, MAX_STEPS, REST_ACTION, SCENE, UNITS, MetaWorld, make
from ftl_metaworld.tasks import NAMES, NUMBER

NOISE = 0.3
"""Standard deviation of the noise on the actions that are executed while an expert shows a task; recorded are the expert's."""
REST = 8
"""Steps that a demonstration goes on after success."""
MOST = 4
"""Maximum number of attempts per demonstration."""
VERSION = 1
"""Version of the demonstrations, part of the cache's key."""


@dataclass(frozen=True)
class Episode:
    """Episode of an expert: worlds ``(time, 21)``, the action ``(time, 4)`` before each world, and success."""

    worlds: NDArray[np.float32]
    actions: NDArray[np.float32]
    success: bool


@functools.cache
def expert(name: str) -> Any:
    """Meta-World's scripted policy of a task."""
    from metaworld.policies import ENV_POLICY_MAP

    return cast("Any", ENV_POLICY_MAP[f"{name}-v3"])()


def act(env: MetaWorld) -> NDArray[np.float32]:
    """The action ``(4,)`` of the expert of the environment's task, for what was last observed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it clips
        action = expert(env.name).get_action(env.seen.copy())
    return np.clip(action, -1, 1).astype(np.float32)


def scenes(task: str, seed: int) -> Iterator[NDArray[np.float32]]:
    """Scenes ``(7,)`` of a task without end, as Meta-World draws them."""
    number = NUMBER[task]
    simulator = make(NAMES[number])
    simulator.seeded_rand_vec, simulator._freeze_rand_vec = True, False
    simulator.seed(int(np.random.default_rng([seed, task_key(task)]).integers(2**31)))
    while True:
        simulator.reset_model()
        vector = simulator._last_rand_vec
        yield np.concatenate(([number], vector, np.zeros(SCENE - 1 - len(vector)))).astype(np.float32)


def show(env: MetaWorld, scene: NDArray[np.float32], rng: np.random.Generator, noise: float = NOISE) -> Episode:
    """An episode of the expert, with noise on what is executed; it goes on for :data:`REST` steps after success."""
    seen, _ = env.reset(options={"scene": scene})
    worlds, actions, left = [seen["world"]], [REST_ACTION], MAX_STEPS
    success = False
    while left > 0:
        actions.append(act(env))
        executed = actions[-1].copy()
        executed[:3] += noise * rng.standard_normal(3)
        seen, _, terminated, truncated, _ = env.step(executed)
        worlds.append(seen["world"])
        if terminated and not success:
            success, left = True, REST + 1
        left = 0 if truncated else left - 1
    return Episode(np.stack(worlds), np.stack(actions), success)


@functools.cache
def _environment() -> MetaWorld:
    """Environment of this process."""
    return MetaWorld()


def demonstrations(task: str, count: int, seed: int, progress: Callable[[], None]) -> Demonstrations:
    """The first ``count`` successful episodes of a task; a ``UserError`` if there are fewer."""
    kept: list[tuple[NDArray[np.float32], Episode]] = []
    tried = 0
    for tried, scene in enumerate(itertools.islice(scenes(task, seed), MOST * count), start=1):
        episode = show(_environment(), scene, np.random.default_rng([seed, task_key(task), tried]))
        if episode.success:
            kept.append((scene, episode))
            progress()
        if len(kept) == count:
            break
    require(len(kept) == count, f"metaworld {task!r}", f"{count} successful episodes of {tried}", len(kept))
    worlds, lengths = padded([torch.from_numpy(episode.worlds) for _, episode in kept])
    states, _ = padded([torch.from_numpy(episode.actions) for _, episode in kept])
    return Demonstrations(
        states=states,
        lengths=lengths,
        domain="metaworld",
        state_names=COLUMNS,
        state_units=UNITS,
        concepts=(task,) * count,
        observed={"world": worlds},
        per_step=("world",),
        scenes=torch.from_numpy(np.stack([scene for scene, _ in kept])),
        provenance={"generator": "metaworld", "seed": seed, "count": count, "tried": tried, "rejected": tried - count},
    )


class Experts:
    """Demonstrations of the training tasks, cached in the user's cache folder."""

    def __init__(self, training: tuple[str, ...], domain: str) -> None:
        self.training, self.domain = training, domain

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` demonstrations of every training task; missing ones are made in a process per core."""
        start, made = seed if name == "train" else VALIDATION_SEED + seed, []
        with (
            ExitStack() as stack,
            bar(f"{self.domain}: demonstrations of {len(self.training)} tasks", len(self.training)) as advance,
        ):
            makers: list[Future[Demonstrations]] = []

            def make(progress: Callable[[], None], row: int) -> Demonstrations:
                if not makers:
                    pool = ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"), initializer=silence)
                    stack.callback(pool.shutdown, cancel_futures=True)
                    makers.extend(pool.submit(self.draw, task, count, start) for task in self.training[row:])
                return makers[row - len(self.training)].result()

            for row, task in enumerate(self.training):
                made.append(self._cached(task, count, start, functools.partial(make, row=row)))
                advance()
        return concatenate(made)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        """``count`` demonstrations of a task, see :func:`demonstrations`; in this process."""
        return self._cached(task, count, seed, functools.partial(demonstrations, task, count, seed))

    def _cached(self, task: str, count: int, seed: int, make: Callable[[Callable[[], None]], Demonstrations]) -> Demonstrations:
        settings = {
            "domain": "metaworld",
            "task": task,
            "count": count,
            "seed": seed,
            "version": VERSION,
            "noise": NOISE,
            "rest": REST,
        }
        return replace(cached(settings, count, make), domain=self.domain)

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """New scenes ``(count, 7)``, drawn as Meta-World draws them, and their observations."""
        drawn = np.stack(list(itertools.islice(scenes(task, seed), count)))
        env = MetaWorld()
        worlds = [env.reset(options={"scene": scene})[0]["world"] for scene in drawn]
        return InitialStates({"world": torch.from_numpy(np.stack(worlds))}, torch.from_numpy(drawn))


def expert_policy(starts: InitialStates) -> Policy:
    """The experts as a policy that acts in separate simulators, one for each episode, which execute the same actions."""
    scenes = starts.require_scenes().numpy()
    environments: dict[int, MetaWorld] = {}

    def policy(observed: Observed, rows: list[int], step: int) -> Tensor:
        actions = []
        for row in rows:
            if step == 0:
                environments[row] = MetaWorld()
                environments[row].reset(options={"scene": scenes[row]})
            actions.append(act(environments[row]))
            environments[row].step(actions[-1])
        return torch.from_numpy(np.stack(actions))

    return policy
