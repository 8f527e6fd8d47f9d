"""Expert that drives to the target in simulation and avoids the distractor, and the source of its demonstrations."""

import itertools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.formats.files import cached
from ftl_lightning.domains.agent import scenes
from ftl_lightning.domains.domain import Split
from ftl_lightning.services.randomness import VALIDATION_SEED

if TYPE_CHECKING:
    from ftl_lightning.domains.agent.environment import AgentEnvironment

NAME = "agent"
_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "angular vx", "angular vy", "angular vz")
STATE_NAMES = tuple(f"agent.{column}" for column in _COLUMNS)
STATE_UNITS = ("m",) * 3 + ("1",) * 4 + ("m/s",) * 3 + ("rad/s",) * 3
LENGTH = 150
"""States of a demonstration, padded with the last state (paper)."""
SPEED = 0.4
"""Speed of the reference point along the route in m/s."""
KEEP_CLEAR = 0.5
"""Minimum distance of the route from the distractor's centre in metres."""
STOP = 0.26
"""Distance of the route's end from the target's centre in metres, just before contact."""
AT_REST = 0.02
"""Speed in m/s below which the agent is at rest."""

_PHYSICS = ("STEP", "SUBSTEPS", "DRAG", "MASS", "MAX_FORCE", "RADIUS", "LOOKAHEAD", "MARGIN", "COLOURS", "SHAPES")
_LAYOUT = ("AGENT_START", "OBJECT_X", "OBJECT_Z", "AGENT_CLEARANCE", "OBJECT_CLEARANCE")
_PACE = {"LENGTH": LENGTH, "SPEED": SPEED, "KEEP_CLEAR": KEEP_CLEAR, "STOP": STOP, "AT_REST": AT_REST}
_SETTINGS = {name: getattr(scenes, name) for name in (*_PHYSICS, *_LAYOUT)} | _PACE
"""Settings that determine demonstrations besides task, count and seed (cache key)."""

Plane = NDArray[np.float64]


def route(start: Plane, goal: Plane, distractor: Plane) -> Plane:
    """Corners ``(2 or 3, 2)`` of the route from the start to just before the target, in x and z."""
    direction = goal - start
    end = goal - STOP * direction / np.linalg.norm(direction)
    share = np.clip((distractor - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    nearest = start + share * (end - start)
    gap = nearest - distractor
    if np.linalg.norm(gap) >= KEEP_CLEAR:
        return np.stack((start, end))
    # Pass the distractor on the side of the straight line.
    detour = distractor + 1.1 * KEEP_CLEAR * gap / np.linalg.norm(gap)
    last = goal - detour
    return np.stack((start, detour, goal - STOP * last / np.linalg.norm(last)))


def along(corners: Plane, distance: float) -> Plane:
    """Point ``(2,)`` at a distance in metres along a polyline, at most its end."""
    for here, there in itertools.pairwise(corners):
        length = float(np.linalg.norm(there - here))
        if distance <= length:
            return np.asarray(here + (there - here) * distance / length)
        distance -= length
    return np.asarray(corners[-1])


def demonstrate(env: "AgentEnvironment", initial: NDArray[np.float32], chosen: int) -> NDArray[np.float32]:
    """Observations ``(time, 52)`` of a drive to object 0 or 1 of a scene ``(52,)``, at most :data:`LENGTH`; resets the
    environment.
    """
    objects = scenes.object_positions(torch.from_numpy(initial)[None])[0].double().numpy()[:, scenes.PLANE]
    place = initial[list(scenes.PLANE)].astype(np.float64)
    return follow(env, initial, route(place, objects[chosen], objects[1 - chosen]))


def follow(env: "AgentEnvironment", initial: NDArray[np.float32], corners: Plane) -> NDArray[np.float32]:
    """Observations ``(time, 52)`` of a drive along a route ``(corner, 2)`` at the expert's speed, until rest at its end.

    The environment is reset; the drive is cut at :data:`LENGTH` states.
    """
    observation = env.reset(options={"scene": initial})[0][scenes.OBSERVED]
    observations = [observation]
    for step in range(LENGTH - 1):
        ahead = along(corners, (step + scenes.LOOKAHEAD) * scenes.STEP * SPEED)
        observation = env.step((ahead - observation[list(scenes.PLANE)]).astype(np.float32))[0][scenes.OBSERVED]
        observations.append(observation)
        near = np.linalg.norm(corners[-1] - observation[list(scenes.PLANE)]) < 0.02
        if near and np.linalg.norm(observation[7:10]) < AT_REST:
            break
    return np.stack(observations)


def environment() -> "AgentEnvironment":
    """Environment of the domain; raises a ``UserError`` without the simulator, or if it does not start."""
    scenes.check_simulator()
    from ftl_lightning.domains.agent.environment import AgentEnvironment

    return AgentEnvironment()


def demonstrations(tasks: tuple[str, ...], count: int, seed: int) -> Demonstrations:
    """``count`` expert drives of each task, from the cache if present."""
    settings = {"domain": NAME, "tasks": tasks, "count": count, "seed": seed, **_SETTINGS}
    return cached(settings, len(tasks) * count, lambda progress: _drive(tasks, count, seed, progress))


def _drive(tasks: tuple[str, ...], count: int, seed: int, progress: Callable[[], None]) -> Demonstrations:
    """Drive in new scenes; ``progress`` is called after each drive."""
    initial = [scenes.scenes(task, count, seed) for task in tasks]
    chosen = torch.cat([scenes.target(task, states) for task, states in zip(tasks, initial, strict=True)])
    env, driven = environment(), []
    for state, index in zip(torch.cat(initial).numpy(), chosen.tolist(), strict=True):
        driven.append(torch.from_numpy(demonstrate(env, state, index)))
        progress()
    env.close()
    times = torch.arange(LENGTH)
    observations = torch.stack([drive[times.clamp(max=len(drive) - 1)] for drive in driven])
    lengths = torch.tensor([len(drive) for drive in driven])
    concepts = tuple(task for task in tasks for _ in range(count))
    return drives(observations, lengths, concepts, {"generator": NAME, "seed": seed, "count_per_task": count})


def drives(observations: Tensor, lengths: Tensor, concepts: tuple[str, ...], provenance: Mapping[str, Any]) -> Demonstrations:
    """Convert drives ``(demo, time, 52)`` to demonstrations."""
    return Demonstrations(
        states=observations[..., : scenes.STATE].contiguous(),
        lengths=lengths,
        domain=NAME,
        state_names=STATE_NAMES,
        state_units=STATE_UNITS,
        concepts=concepts,
        observed={scenes.OBSERVED: observations},
        per_step=(scenes.OBSERVED,),
        scenes=observations[:, 0].contiguous(),
        provenance=provenance,
    )


class Expert:
    """Source of expert drives, cached."""

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        return demonstrations(scenes.TRAINING_CONCEPTS, count, seed if name == "train" else VALIDATION_SEED + seed)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        return demonstrations((task,), count, seed)

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        return initial_states(scenes.scenes(task, count, seed))


def initial_states(drawn: Tensor) -> InitialStates:
    """Initial states of scenes ``(scene, 52)``, which are fully observed."""
    return InitialStates({scenes.OBSERVED: drawn}, drawn)
