"""Demonstrations from routes drawn by hand, which the agent follows in the expert's simulator."""

import numpy as np
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.agent.expert import LENGTH, NAME, SPEED, STOP, Plane, drives, environment, follow, initial_states
from ftl_lightning.domains.agent.rendering import SEEN, STEPS_A_SECOND, from_above
from ftl_lightning.domains.agent.scenes import OBSERVED, PLANE, STEP, check_simulator, object_positions, scenes
from ftl_lightning.domains.agent.tasks import COMPOSITIONS
from ftl_lightning.domains.recorder import Numbers, Piece, Scene, at_even_steps, reached, smoothed
from ftl_lightning.services.errors import require

BRAKING = 20
"""States reserved for braking."""
LONGEST, SHORTEST = (LENGTH - BRAKING) * STEP * SPEED, 0.1
"""Maximum and minimum length of a route in metres."""
BLUR, CORNER = 0.08, 0.04
"""Standard deviation of the smoothing along the route, and distance between its corners afterwards, in metres."""
FINE = 0.005
"""Accuracy in metres of the end of a route before an object."""


def scene(task: str, seed: int) -> Scene:
    """Top-view scene of a task with the agent at its start; for '', of the first of the paper's compositions.

    Raises:
        UserError: without the simulator, or for an invalid task.
    """
    check_simulator()
    world = scenes(task or COMPOSITIONS[0], 1, seed)
    film = from_above(world[0], world[:, :3])
    x, z = world[0, list(PLANE)].tolist()
    faster = STEPS_A_SECOND * STEP  # the hand moves at the speed of films
    agent = Piece("agent", (x, z), (len(film.shapes) - 1,))
    return Scene(film, (agent,), faster * SPEED, LONGEST / (faster * SPEED), initial_states(world))


def record(scene_before: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
    """Drive at the expert's speed along the drawn route ``(step, 1, 2)`` in metres, to just before the first object on it.

    The route is clipped to the picture; the speed of drawing is ignored.

    Raises:
        UserError: for a route shorter than :data:`SHORTEST`, or without the simulator.
    """
    assert scene_before.starts is not None  # set by `scene`
    world = scene_before.starts.observed[OBSERVED]
    start = world[:, list(PLANE)].double().numpy()
    lower, upper = np.array(SEEN).T
    hand = np.concatenate((start, path[:, 0].clip(lower, upper)))
    length = reached(hand)[-1]
    require(length >= SHORTEST, "way", f"at least {SHORTEST:g} m", f"{length:.2f} m; lead the agent further")
    route = _before_objects(smoothed(hand, BLUR), object_positions(world)[0].double().numpy()[:, PLANE])
    env = environment()
    try:
        drive = follow(env, world[0].numpy(), route)
    finally:
        env.close()
    return drives(torch.from_numpy(drive)[None], torch.tensor([len(drive)]), ("",), {"generator": "by hand", "domain": NAME})


def _before_objects(way: Plane, objects: Plane) -> Plane:
    """Corners ``(corner, 2)`` of a route up to contact with an object, at most :data:`LONGEST` metres."""
    fine = at_even_steps(way, int(np.ceil(reached(way)[-1] / FINE)) + 1)
    near = (np.linalg.norm(fine[:, None] - objects, axis=-1) < STOP).any(axis=1) | (reached(fine) > LONGEST)
    free = fine[: int(near.argmax()) if near.any() else None]
    return at_even_steps(free, int(np.ceil(reached(free)[-1] / CORNER)) + 1)
