"""Demonstrations of scripted experts."""

import logging
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ftl_lightning.data.cache import cached
from ftl_lightning.data.container import Demonstrations, concatenate, padded
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.tabletop import distractors, environment, experts, pushing, success, world
from ftl_lightning.domains.tabletop import scenes as scene_settings
from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
from ftl_lightning.domains.tabletop.experts import Episode, led_astray, perform
from ftl_lightning.domains.tabletop.interface import FEATURES, IMAGE, NAME, PLACES, POSE, STATE_NAMES, STATE_UNITS
from ftl_lightning.domains.tabletop.scenes import draw_scene, scenes
from ftl_lightning.domains.tabletop.tasks import PUSH, PUSHES, TRAINING_CONCEPTS, check_task
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import VALIDATION_SEED, task_key

_LOG = logging.getLogger(__name__)

MOST = 4
"""Maximum attempts per demonstration."""
FORM = 5
"""Version of the experts; part of the cache key."""
TIMES = {PUSH: 4}
"""Factors of the demonstrations per training concept: the paper has 124 of the push, 29 to 31 of others."""
RECOVERY_SEED = 2_000_000
"""Seed offset of recovery demonstrations."""
_NO_SETTINGS = ("ROUND", "FEATURES", "NEEDED", "TYPE_CHECKING")
_SETTINGS = {
    f"{module.__name__.rpartition('.')[2]}.{name}": value
    for module in (distractors, environment, experts, pushing, scene_settings, success, world)
    for name, value in sorted(vars(module).items())
    if name.isupper() and isinstance(value, int | float | str | tuple | dict | world.Camera) and name not in _NO_SETTINGS
}
"""Constants that determine a demonstration, besides task, count and seed."""

Job = tuple[str, int, int, bool, bool]
"""Task, seed, episode number, whether distractors are scattered in each image, and whether the episode is a recovery."""
_ENVIRONMENT: list[TableTopEnvironment] = []
"""Environment of this process."""


def _scene(job: Job) -> np.ndarray:
    task, seed, number, *_ = job
    return draw_scene(task, np.random.default_rng([seed, task_key(task), number]))


def _episode(job: Job) -> Episode | None:
    """Run an episode of the expert; ``None`` if the simulator raised an error.

    Raises:
        MemoryError, OSError: for a lack of resources, which would affect every episode.
        UserError: if the simulator does not start.
    """
    task, seed, number, scatter, elsewhere = job
    if not _ENVIRONMENT:
        _ENVIRONMENT.append(TableTopEnvironment())
    try:
        rng = np.random.default_rng([seed, task_key(task), number, 1])
        return perform(_ENVIRONMENT[0], task, _scene(job), rng, scatter=scatter, begin=led_astray if elsewhere else None)
    except (MemoryError, OSError):
        raise
    except Exception as error:  # any error of the simulator: other episodes continue
        _LOG.warning("table-top %r, episode %d: %r; it counts as rejected", task, number, error)
        _ENVIRONMENT.pop().close()
        return None


def _episodes(jobs: list[Job], workers: int) -> Iterator[Episode | None]:
    if workers == 1:
        yield from map(_episode, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap(_episode, jobs)


def demonstrations(
    task: str,
    count: int,
    seed: int,
    workers: int,
    progress: Callable[[], None],
    scatter: bool = False,
    elsewhere: bool = False,
) -> Demonstrations:
    """The first ``count`` successful episodes of a task by number, independent of the number of workers.

    Args:
        task: known task.
        count: number of demonstrations.
        seed: seed of scenes, styles and noise.
        workers: number of processes.
        progress: called after each successful episode.
        scatter: whether to scatter distractors in each image, with object positions as a privileged feature.
        elsewhere: whether episodes are recoveries, with the hand anywhere around the circle.

    Raises:
        UserError: if too few episodes succeed.
    """
    kept: list[tuple[Job, Episode]] = []
    jobs = [(task, seed, number, scatter, elsewhere) for number in range(MOST * count)]
    tried = 0
    for job, episode in zip(jobs, _episodes(jobs, workers), strict=False):
        tried += 1
        if episode is not None and episode.success:
            kept.append((job, episode))
            progress()
        if len(kept) == count:
            break
    else:
        raise UserError(f"table-top {task!r}: expected {count} successful episodes of {tried}, found {len(kept)}")
    drawn = torch.from_numpy(np.stack([_scene(job) for job, _ in kept]))
    provenance = {"generator": NAME, "seed": seed, "count": count, "tried": tried, "rejected": tried - count}
    return joined_episodes(task, [episode for _, episode in kept], drawn, provenance)


def joined_episodes(
    task: str, episodes: Sequence[Episode], drawn: torch.Tensor | None, provenance: Mapping[str, Any]
) -> Demonstrations:
    """Demonstrations from episodes of a task.

    Args:
        task: known task.
        episodes: all with places, or none.
        drawn: their scenes ``(episode, 24)``; ``None`` if they did not start from a scene.
        provenance: record of their origin.
    """
    observed = {
        IMAGE: padded([torch.from_numpy(episode.images) for episode in episodes])[0],
        POSE: padded([torch.from_numpy(episode.poses) for episode in episodes])[0],
    }
    if places := [torch.from_numpy(episode.places) for episode in episodes if episode.places is not None]:
        observed[PLACES] = padded(places)[0]
    states, lengths = padded([torch.from_numpy(episode.commands) for episode in episodes])
    return Demonstrations(
        states=states,
        lengths=lengths,
        domain=NAME,
        state_names=STATE_NAMES,
        state_units=STATE_UNITS,
        concepts=(task,) * len(episodes),
        observed=observed,
        per_step=tuple(observed),
        scenes=drawn,
        provenance=dict(provenance),
    )


class Expert:
    """Successful episodes of the scripted experts, cached.

    Args:
        concepts: training concepts.
        domain: name of the domain.
        begun_anew: tasks that also have recoveries; ``None`` for pushes only.
    """

    def __init__(
        self, concepts: Sequence[str] = TRAINING_CONCEPTS, domain: str = NAME, begun_anew: Sequence[str] | None = None
    ) -> None:
        self.concepts, self.domain = tuple(concepts), domain
        self.begun_anew = tuple(task for task in self.concepts if task in (PUSHES if begun_anew is None else begun_anew))

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` demonstrations of every training concept, times :data:`TIMES`; distractors are scattered."""
        start = seed if name == "train" else VALIDATION_SEED + seed
        return concatenate([self.draw(task, TIMES.get(task, 1) * count, start, scatter=True) for task in self.concepts])

    def recoveries(self, name: Split, count: int, seed: int) -> Demonstrations:
        """``count`` recoveries of every task with recoveries, see :func:`.experts.led_astray`."""
        start = RECOVERY_SEED + seed + (0 if name == "train" else VALIDATION_SEED)
        return concatenate([self.draw(task, count, start, scatter=True, elsewhere=True) for task in self.begun_anew])

    def draw(
        self, task: str, count: int, seed: int, workers: int = 1, scatter: bool = False, elsewhere: bool = False
    ) -> Demonstrations:
        """``count`` demonstrations of a task, see :func:`demonstrations`."""
        settings = {"domain": NAME, "task": check_task(task), "count": count, "seed": seed, "experts": FORM, **_SETTINGS}
        settings |= {"scatter": scatter, "elsewhere": elsewhere}
        made = cached(settings, count, lambda progress: demonstrations(task, count, seed, workers, progress, scatter, elsewhere))
        return made if made.domain == self.domain else replace(made, domain=self.domain)

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """New scenes ``(count, 24)`` and their observations."""
        return initial_states(scenes(task, count, seed))


def initial_states(drawn: torch.Tensor) -> InitialStates:
    """Scenes ``(scene, 24)`` and their initial observations."""
    env = TableTopEnvironment()
    try:
        seen = [env.reset(options={"scene": scene.numpy()})[0] for scene in drawn]
    finally:
        env.close()
    return InitialStates({name: torch.from_numpy(np.stack([row[name] for row in seen])) for name in FEATURES}, drawn)
