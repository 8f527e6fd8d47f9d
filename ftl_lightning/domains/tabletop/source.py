"""Demonstrations of scripted experts."""

import logging
import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations, concatenate, padded
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.formats.files import cached
from ftl_lightning.domains.domain import Split
from ftl_lightning.domains.tabletop import environment, experts, interface, world
from ftl_lightning.domains.tabletop import scenes as layouts
from ftl_lightning.domains.tabletop.environment import TableTopEnvironment, judged
from ftl_lightning.domains.tabletop.experts import PAST, SLIP, SLIPS, STAY, TREMBLE, led_astray, moves, style
from ftl_lightning.domains.tabletop.interface import FEATURES, IMAGE, NAME, OVERHEAD, PLACES, POSE, PUSH, PUSHES, Camera
from ftl_lightning.domains.tabletop.scenes import (
    CIRCLE,
    HEIGHT,
    HIDDEN,
    NEEDED,
    PRESENT,
    SURFACES,
    draw_scene,
    free_pose,
    outline,
    scenes,
)
from ftl_lightning.domains.tabletop.world import turned
from ftl_lightning.services.errors import require
from ftl_lightning.services.randomness import VALIDATION_SEED, task_key

_LOG = logging.getLogger(__name__)

MOST = 4  # Maximum attempts per demonstration
VERSION = 5  # Version of the experts; part of the cache key
TIMES = {PUSH: 4}  # Factors of the demonstrations per training concept: the paper has 124 of the push, 29 to 31 of others
COVERED = 0.3  # Probability that a distractor lies under a lifted circle, if the circle is higher than the distractor
RECOVERY_SEED = 2_000_000  # Seed offset of recovery demonstrations
_NO_SETTINGS = ("ROUND", "FEATURES", "NEEDED", "TYPE_CHECKING")  # Constants without influence on a demonstration
_SETTINGS = {
    f"{module.__name__.rpartition('.')[2]}.{name}": value
    for module in (environment, experts, layouts, world)
    for name, value in sorted(vars(module).items())
    if name.isupper() and isinstance(value, int | float | str | tuple | dict | Camera) and name not in _NO_SETTINGS
}
"""Constants that determine a demonstration, besides task, count and seed."""


@dataclass(frozen=True)
class Episode:
    """Recorded episode of an expert."""

    commands: NDArray[np.float32]  # (time, 4), executed; the first is the initial state
    actions: NDArray[np.float32]  # (steps, 4), passed to the environment, which shortens long moves
    images: NDArray[np.uint8]  # (time, 3, 64, 64)
    poses: NDArray[np.float32]  # (time, 8), measured
    success: bool  # whether the task is done
    places: NDArray[np.float32] | None = None  # (time, 5, 4), object positions in the images; only with scattered distractors


Begin = Callable[[TableTopEnvironment, str, np.random.Generator], dict[str, NDArray[Any]]]
"""``(environment, task, rng) -> first observation of the demonstration``."""


def scattered(
    env: TableTopEnvironment, task: str, trace: Sequence[NDArray[np.float64]], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Images ``(time, 3, 64, 64)`` of a finished episode, and positions ``(time, 5, 4)``, see :meth:`.TableTopEnvironment.seen`.

    Networks memorise few demonstrations by their distractors. Random distractors carry no information (domain randomisation, Tobin
    et al., 2017). The triangle also lies on book and block, where it looks larger. With coupled fingers, objects also lie under a
    lifted circle, which covers them in the image. ``trace`` is that of the episode's last info; the objects of ``env`` are moved.
    """
    needed = NEEDED[task](np.random.default_rng(0))
    objects = env.bodies.objects
    others = sorted((name for name in objects if name not in needed), key=lambda name: name not in SURFACES)
    pictures, places = [], []
    for moment in trace:
        env.show(moment)
        taken = {name: env.outline(name) for name in objects if name in needed}
        circle = env.places()[CIRCLE]
        below = circle[2] - HEIGHT[CIRCLE] / 2
        for name in others:
            base, (x, y, yaw) = 0.0, HIDDEN
            if rng.uniform() < PRESENT:
                if env.coupled and below > HEIGHT[name] and rng.uniform() < COVERED:
                    free = {key: shape for key, shape in taken.items() if key != CIRCLE}
                    base, (x, y, yaw) = free_pose(rng, name, free, near=circle[:2])
                else:
                    base, (x, y, yaw) = free_pose(rng, name, taken)
            env.client.resetBasePositionAndOrientation(objects[name], (x, y, base + HEIGHT[name] / 2), turned(yaw))
            if x != HIDDEN[0]:
                taken[name] = outline(name, x, y, yaw)
        pictures.append(OVERHEAD.picture(env.client).transpose(2, 0, 1))
        places.append(env.seen())
    return np.stack(pictures), np.stack(places)


def perform(
    env: TableTopEnvironment,
    task: str,
    scene: NDArray[np.float32],
    rng: np.random.Generator,
    height: float | None = None,
    feedback: bool = True,
    scatter: bool = False,
    begin: Begin | None = None,
) -> Episode:
    """Run an episode of a task's expert from a scene; a ``UserError`` for an invalid scene.

    Args:
        rng: generator of style and noise.
        height, feedback: see :func:`moves`.
        scatter: whether to move distractors in each image, see :func:`scattered`.
        begin: change of the scene before the demonstration, such as :func:`led_astray`; ``None`` for no change.
    """
    observation, info = env.reset(options={"scene": scene})
    if begin is not None:
        observation = begin(env, task, rng)
    how = style(rng)
    commands, images, poses = [env.command.copy()], [observation[IMAGE]], [observation[POSE]]
    actions: list[NDArray[np.float32]] = []
    ended, success = None, False
    for command in moves(env, task, how, height, feedback):
        noise = TREMBLE * rng.standard_normal(3)
        angle, size, slips = rng.uniform(-math.pi, math.pi), rng.uniform(*SLIP), rng.random() < SLIPS
        if slips and task in PUSHES and feedback:  # no recovery without feedback
            noise[:2] += size * np.array([math.cos(angle), math.sin(angle)])
        actions.append((command + np.array([*noise, 0.0])).astype(np.float32))
        observation, _, terminated, truncated, info = env.step(actions[-1])
        commands.append(env.command.copy())
        images.append(observation[IMAGE])
        poses.append(observation[POSE])
        done = judged(task, env.scene, info)
        if ended is None and (terminated or truncated or (done and task in PUSHES)):
            ended, success = len(actions), done
        if ended is not None and len(actions) >= ended + (PAST if success and task in PUSHES else 0):
            break
    if ended is None:  # a task without an event that ends it
        success = judged(task, env.scene, info)
    places = None
    if scatter:
        pictures, places = scattered(env, task, info["trace"], rng)
        images, places = list(pictures), _stayed(list(places))
    states, measured = _stayed(commands).astype(np.float32), _stayed(poses).astype(np.float32)
    return Episode(states, np.stack(actions), _stayed(images), measured, success, places)


def _stayed(values: list[Any]) -> NDArray[Any]:
    return np.stack([*values, *[values[-1]] * STAY])


Job = tuple[str, int, int, bool, bool, bool]
"""Task, seed, episode number, whether distractors are scattered in each image, whether the episode is a recovery, and whether the
fingers are coupled."""
_ENVIRONMENT: dict[bool, TableTopEnvironment] = {}  # Environments of this process, with and without coupled fingers


def _scene(job: Job) -> np.ndarray:
    task, seed, number, *_ = job
    return draw_scene(task, np.random.default_rng([seed, task_key(task), number]))


def _episode(job: Job) -> Episode | None:
    """Run an episode of the expert; ``None`` if the simulator raised an error, except for a lack of resources."""
    task, seed, number, scatter, elsewhere, coupled = job
    if coupled not in _ENVIRONMENT:
        _ENVIRONMENT[coupled] = TableTopEnvironment(coupled=coupled)
    try:
        rng = np.random.default_rng([seed, task_key(task), number, 1])
        return perform(_ENVIRONMENT[coupled], task, _scene(job), rng, scatter=scatter, begin=led_astray if elsewhere else None)
    except (MemoryError, OSError):
        raise
    except Exception as error:  # any error of the simulator: other episodes continue
        _LOG.warning("table-top %r, episode %d: %r; it counts as rejected", task, number, error)
        _ENVIRONMENT.pop(coupled).close()
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
    coupled: bool = False,
) -> Demonstrations:
    """The first ``count`` successful episodes of a task by number, independent of ``workers``; a ``UserError`` if there are fewer.

    Args:
        progress: called after each successful episode.
        scatter: whether to scatter distractors in each image, with object positions as a privileged feature.
        elsewhere: whether episodes are recoveries, with the hand anywhere around the circle.
        coupled: see :class:`.TableTopEnvironment`.
    """
    kept: list[tuple[Job, Episode]] = []
    jobs = [(task, seed, number, scatter, elsewhere, coupled) for number in range(MOST * count)]
    tried = 0
    for job, episode in zip(jobs, _episodes(jobs, workers), strict=False):
        tried += 1
        if episode is not None and episode.success:
            kept.append((job, episode))
            progress()
        if len(kept) == count:
            break
    require(len(kept) == count, f"table-top {task!r}", f"{count} successful episodes of {tried}", len(kept))
    drawn = torch.from_numpy(np.stack([_scene(job) for job, _ in kept]))
    provenance = {"generator": NAME, "seed": seed, "count": count, "tried": tried, "rejected": tried - count}
    return joined_episodes(task, [episode for _, episode in kept], drawn, provenance)


def joined_episodes(
    task: str, episodes: Sequence[Episode], drawn: torch.Tensor | None, provenance: Mapping[str, Any]
) -> Demonstrations:
    """Demonstrations from episodes of a task, and their scenes ``(episode, 24)``, if any; all have places, or none has."""
    places = [episode.places for episode in episodes if episode.places is not None]
    columns: dict[str, list[NDArray[Any]]] = {
        IMAGE: [episode.images for episode in episodes],
        POSE: [episode.poses for episode in episodes],
    }
    columns |= {PLACES: places} if places else {}
    observed = {name: padded([torch.from_numpy(values) for values in rows])[0] for name, rows in columns.items()}
    states, lengths = padded([torch.from_numpy(episode.commands) for episode in episodes])
    return Demonstrations(
        states=states,
        lengths=lengths,
        domain=NAME,
        state_names=interface.STATE_NAMES,
        state_units=interface.STATE_UNITS,
        concepts=(task,) * len(episodes),
        observed=observed,
        per_step=tuple(observed),
        scenes=drawn,
        provenance=dict(provenance),
    )


class Expert:
    """Successful episodes of the scripted experts, cached; tasks ``begun_anew``, by default pushes, also have recoveries."""

    def __init__(
        self,
        concepts: Sequence[str] = interface.TRAINING_CONCEPTS,
        domain: str = NAME,
        begun_anew: Sequence[str] | None = None,
        coupled: bool = False,
    ) -> None:
        self.concepts, self.domain, self.coupled = tuple(concepts), domain, coupled
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
        settings = {"domain": NAME, "task": interface.check_task(task), "count": count, "seed": seed, "experts": VERSION}
        settings |= {**_SETTINGS, "scatter": scatter, "elsewhere": elsewhere, "coupled": self.coupled}
        how = scatter, elsewhere, self.coupled
        made = cached(settings, count, lambda progress: demonstrations(task, count, seed, workers, progress, *how))
        return made if made.domain == self.domain else replace(made, domain=self.domain)

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """New scenes ``(count, 24)`` and their observations."""
        return initial_states(scenes(task, count, seed))


def initial_states(drawn: torch.Tensor) -> InitialStates:
    """Scenes ``(scene, 24)`` and their initial observations."""
    env = TableTopEnvironment()
    try:
        observations = [env.reset(options={"scene": scene.numpy()})[0] for scene in drawn]
    finally:
        env.close()
    return InitialStates({name: torch.from_numpy(np.stack([row[name] for row in observations])) for name in FEATURES}, drawn)
