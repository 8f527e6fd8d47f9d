"""Expert that drives to the target in the same physics and avoids the distractor."""

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.agent.dynamics import LOOKAHEAD, STEP, check_simulator
from ftl_lightning.domains.agent.scenes import INITIAL, OBSERVED, PLANE, object_positions, scenes, target

if TYPE_CHECKING:
    from ftl_lightning.domains.agent.environment import AgentEnvironment

LENGTH = 150
"""States of a demonstration, padded with the last state (paper)."""
SPEED = 0.4
"""Speed of the reference point along the route in m/s."""
KEEP_CLEAR = 0.5
"""Minimum distance of the route from the distractor's centre in metres."""
STOP = 0.26
"""Distance of the end of the route from the target's centre in metres, just before contact."""
AT_REST = 0.02
"""Speed in m/s below which the agent is at rest."""

Plane = NDArray[np.float64]


def route(start: Plane, target: Plane, distractor: Plane) -> Plane:
    """Corners ``(2 or 3, 2)`` of the route from the start to just before the target, in x and z."""
    way = target - start
    end = target - STOP * way / np.linalg.norm(way)
    share = np.clip((distractor - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    nearest = start + share * (end - start)
    gap = nearest - distractor
    if np.linalg.norm(gap) >= KEEP_CLEAR:
        return np.stack((start, end))
    # Pass the distractor on the side of the straight line.
    detour = distractor + 1.1 * KEEP_CLEAR * gap / np.linalg.norm(gap)
    last = target - detour
    return np.stack((start, detour, target - STOP * last / np.linalg.norm(last)))


def along(corners: Plane, distance: float) -> Plane:
    """Point ``(2,)`` at a distance in metres along a polyline, at most its end."""
    for here, there in itertools.pairwise(corners):
        length = float(np.linalg.norm(there - here))
        if distance <= length:
            return np.asarray(here + (there - here) * distance / length)
        distance -= length
    return np.asarray(corners[-1])


def demonstrate(environment: "AgentEnvironment", initial: NDArray[np.float32], chosen: int) -> NDArray[np.float32]:
    """Observations ``(time, 52)`` of a drive, ``time`` at most :data:`LENGTH`.

    Args:
        environment: environment; it is reset.
        initial: ``(52,)``.
        chosen: 0 or 1, the object to drive to.
    """
    objects = object_positions(torch.from_numpy(initial)[None])[0].double().numpy()[:, PLANE]
    place = initial[list(PLANE)].astype(np.float64)
    return follow(environment, initial, route(place, objects[chosen], objects[1 - chosen]))


def follow(environment: "AgentEnvironment", initial: NDArray[np.float32], corners: Plane) -> NDArray[np.float32]:
    """Observations ``(time, 52)`` of a drive along a route at the expert's speed, until rest at its end.

    Args:
        environment: environment; it is reset.
        initial: ``(52,)``.
        corners: corners of the route ``(2 or more, 2)`` in x and z; the drive is cut at :data:`LENGTH` states.
    """
    observation = environment.reset(options={"scene": initial})[0][OBSERVED]
    seen = [observation]
    for step in range(LENGTH - 1):
        ahead = along(corners, (step + LOOKAHEAD) * STEP * SPEED)
        observation = environment.step((ahead - observation[list(PLANE)]).astype(np.float32))[0][OBSERVED]
        seen.append(observation)
        near = np.linalg.norm(corners[-1] - observation[list(PLANE)]) < 0.02
        if near and np.linalg.norm(observation[7:10]) < AT_REST:
            break
    return np.stack(seen)


def demonstrations(task: str, count: int, seed: int, progress: Callable[[], None]) -> tuple[Tensor, Tensor]:
    """Expert drives of a task.

    Args:
        task: see :func:`~ftl_lightning.domains.agent.scenes.parse`.
        count, seed: number and seed of scenes.
        progress: called after each drive.

    Returns:
        Observations ``(count, 150, 52)``, padded with the last, and lengths ``(count,)``.
    """
    initial = scenes(task, count, seed)
    check_simulator()
    from ftl_lightning.domains.agent.environment import AgentEnvironment

    observations = torch.empty(count, LENGTH, INITIAL)
    lengths = torch.empty(count, dtype=torch.int64)
    environment = AgentEnvironment()
    for row, (state, chosen) in enumerate(zip(initial.numpy(), target(task, initial).tolist(), strict=True)):
        seen = torch.from_numpy(demonstrate(environment, state, chosen))
        observations[row, : len(seen)] = seen
        observations[row, len(seen) :] = seen[-1]
        lengths[row] = len(seen)
        progress()
    environment.close()
    return observations, lengths
