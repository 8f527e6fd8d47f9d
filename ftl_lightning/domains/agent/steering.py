"""Drives that a person leads: the agent follows the hand's way through the same physics, as it follows the expert's."""

import numpy as np
import torch

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.agent.domain import NAME, drives, environment, initial_states
from ftl_lightning.domains.agent.dynamics import STEP, expect_simulator
from ftl_lightning.domains.agent.expert import LENGTH, SPEED, STOP, Plane, follow
from ftl_lightning.domains.agent.rendering import SEEN, STEPS_A_SECOND, from_above
from ftl_lightning.domains.agent.scenes import OBSERVED, PLANE, object_positions, scenes
from ftl_lightning.domains.agent.tasks import COMPOSITIONS
from ftl_lightning.domains.hand_line import at_even_steps, reached, smoothed
from ftl_lightning.domains.recorder import Numbers, Piece, Scene
from ftl_lightning.errors import UserError

BRAKING = 20
"""States of a demonstration that are left for coming to rest."""
LONGEST = (LENGTH - BRAKING) * STEP * SPEED
"""Metres of a way, which the expert's speed takes most states of a demonstration for."""
SHORTEST = 0.1
"""Metres; a way that is shorter shows nothing."""
BLUR, CORNER = 0.08, 0.04
"""Metres: standard deviation along the way by which a hand's trembling is smoothed, and how far apart its corners then are."""
FINE = 0.005
"""Metres: how exactly the way ends before an object."""


def scene(task: str, seed: int) -> Scene:
    """A scene from above with the agent at its start.

    Args:
        task: whose objects stand there; a goal of the paper's compositions for ''.
        seed: of the scene.

    Raises:
        UserError: without the simulator, or for a task that is none.
    """
    expect_simulator()
    world = scenes(task or COMPOSITIONS[0], 1, seed)
    film = from_above(world[0], world[:, :3])
    x, z = world[0, list(PLANE)].tolist()
    faster = STEPS_A_SECOND * STEP  # the hand leads as fast as films play
    agent = Piece("agent", (x, z), (len(film.shapes) - 1,))
    return Scene(film, (agent,), faster * SPEED, LONGEST / (faster * SPEED), initial_states(world))


def record(seen: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
    """One drive along the hand's way, at the expert's speed, to just before the first object that the way comes to.

    Args:
        seen: the scene before.
        path: ``(step, 1, 2)``, x and z in metres; what leaves the picture is brought back to its edge.
        seconds: do not matter: how fast a hand is, is no property of a drive.

    Raises:
        UserError: for a way too short to show anything, or without the simulator.
    """
    assert seen.starts is not None  # of every scene of this domain
    world = seen.starts.observed[OBSERVED]
    start = world[:, list(PLANE)].double().numpy()
    (left, right), (low, high) = SEEN
    hand = np.concatenate((start, path[:, 0].clip((left, low), (right, high))))
    if (length := reached(hand)[-1]) < SHORTEST:
        raise UserError(f"way: expected one of at least {SHORTEST:g} m, found {length:.2f} m; lead the agent further")
    way = _before_objects(smoothed(hand, BLUR), object_positions(world)[0].double().numpy()[:, PLANE])
    env = environment()
    try:
        drive = follow(env, world[0].numpy(), way)
    finally:
        env.close()
    return drives(torch.from_numpy(drive)[None], torch.tensor([len(drive)]), ("",), {"generator": "by hand", "domain": NAME})


def _before_objects(way: Plane, objects: Plane) -> Plane:
    """A way's corners ``(corner, 2)`` up to where bodies would touch, as the expert stops, and at most :data:`LONGEST`."""
    fine = at_even_steps(way, int(np.ceil(reached(way)[-1] / FINE)) + 1)
    near = (np.linalg.norm(fine[:, None] - objects, axis=-1) < STOP).any(axis=1) | (reached(fine) > LONGEST)
    kept = fine[: int(near.argmax()) if near.any() else None]
    return at_even_steps(kept, int(np.ceil(reached(kept)[-1] / CORNER)) + 1)
