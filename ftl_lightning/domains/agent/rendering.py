"""Top-view pictures of plans, films of episodes, and demonstrations from routes drawn by hand on such pictures."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, check_starts
from ftl_lightning.domains.agent.expert import LENGTH, NAME, SPEED, STOP, Plane, drives, environment, follow, initial_states
from ftl_lightning.domains.agent.scenes import (
    COLOURS,
    OBSERVED,
    PLANE,
    REACH,
    STEP,
    check_simulator,
    looks,
    object_positions,
    scenes,
)
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.films import Shape, VectorFilm, regular, some, still
from ftl_lightning.domains.pictures import framed
from ftl_lightning.domains.recorder import Numbers, Piece, Scene, at_even_steps, reached, smoothed
from ftl_lightning.services.errors import require

MARKERS = {"cone": "^", "sphere": "o", "bowl": "v", "cube": "s"}  # a bowl is an open triangle pointing down
CORNERS = {"cone": (3, np.pi / 2), "cube": (4, np.pi / 4)}
"""Number of corners and angle of the first corner."""
SEEN = (-2.1, 2.1), (-4.8, -2.8)
"""Ranges of x and z in pictures."""
MAX_COLUMNS = 4
FRAMES = 40  # at most, of an episode
SIZE = 0.1  # half the width of a body in metres
AGENT = "#c79a2b"
STEPS_A_SECOND = 30.0
"""Simulation steps per second of a vector film: 1.5 times real time."""


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Draw a grid of top-view scenes ``(scene, horizon, 13)`` with the agent's path; frames are green where the task holds, else
    red.
    """
    figure = framed(len(states), right, title, MAX_COLUMNS, (2.6, 1.3))
    for axes, plan, initial in zip(figure.axes, states, check_starts(starts).observed[OBSERVED], strict=False):
        places = object_positions(initial[None])[0][:, list(PLANE)].tolist()
        for (colour, shape), (x, z) in zip(looks(initial.tolist()), places, strict=True):
            shade = [value / 255 for value in COLOURS[colour]]
            axes.plot(x, z, MARKERS[shape], color=shade, fillstyle="none" if shape == "bowl" else "full", markersize=9, mew=2)
            angle = np.linspace(0, 2 * np.pi, 48)
            axes.plot(x + REACH * np.cos(angle), z + REACH * np.sin(angle), color="#c0c0c0", linewidth=0.6)
        axes.plot(*plan[:, list(PLANE)].T.tolist(), color="#303030", linewidth=1)
        axes.plot(initial[0].item(), initial[2].item(), "^", color=AGENT, markersize=7)
        axes.set(xlim=SEEN[0], ylim=SEEN[1], xticks=[], yticks=[])
    return figure


def _end(observations: Tensor) -> int:
    """Number of steps ``(step, 3 or more)`` until nothing moves any more."""
    moving = (observations[1:, :3] - observations[:-1, :3]).abs().amax(dim=1) > 0
    return int(moving.nonzero().max()) + 2 if moving.any() else 1


def film(rollout: Rollout, plans: Tensor) -> list[NDArray[np.uint8]]:
    """Film an episode: at most :data:`FRAMES` frames ``(height, width, 3)`` of the simulator, without plans, until nothing
    moves.
    """
    observations = rollout.observed[OBSERVED][0]
    env = environment()
    pictures = []
    for time in some(_end(observations), FRAMES):
        env.reset(options={"scene": observations[time].numpy()})
        pictures.append(env.render())
    env.close()
    return pictures


def vector_film(rollout: Rollout) -> VectorFilm:
    """Top-view film of an episode, until nothing moves any more."""
    observations = rollout.observed[OBSERVED][0]
    return from_above(observations[0], observations)


def plan_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Top-view film of a plan or demonstration ``(time, 13)``, until nothing moves any more."""
    return from_above(check_starts(starts).observed[OBSERVED][0], states)


def from_above(world: Tensor, states: Tensor) -> VectorFilm:
    """Top-view film of a scene ``(52,)`` and the agent's path ``(time, 3 or more)``; the agent is the last shape."""
    end = _end(states)
    times = some(end, FRAMES)
    agent = states[times][:, list(PLANE)].numpy()[:, None]
    shapes = []
    for (colour, shape), at in zip(looks(world.tolist()), object_positions(world[None])[0].numpy(), strict=True):
        place, shade = at[list(PLANE)], "#{:02x}{:02x}{:02x}".format(*COLOURS[colour])
        shapes.append(still("line", regular(48, REACH)[[*range(48), 0]] + place, "#a8adb3", 0.01))
        if shape in CORNERS:
            corners, turn = CORNERS[shape]
            shapes.append(still("area", regular(corners, 1.35 * SIZE, turn) + place, shade))
        else:
            shapes.append(Shape("dots", place[None, None].astype(np.float32), shade, SIZE, filled=shape == "sphere"))
    shapes += [Shape("way", agent, AGENT, 0.025), Shape("dots", agent, AGENT, 0.07)]
    (left, right), (low, high) = SEEN
    return VectorFilm(shapes, (left, low, right - left, high - low), STEPS_A_SECOND * len(times) / end)


BRAKING = 20
"""States reserved for braking."""
LONGEST, SHORTEST = (LENGTH - BRAKING) * STEP * SPEED, 0.1
"""Maximum and minimum length of a route in metres."""
BLUR, CORNER = 0.08, 0.04
"""Standard deviation of the smoothing along the route, and distance between its corners afterwards, in metres."""
COMPOSITION = "go to red bowl"  # the first of the paper's
FINE = 0.005
"""Accuracy in metres of the end of a route before an object."""


def scene(task: str, seed: int) -> Scene:
    """Top-view scene of a task with the agent at its start; for '', of :data:`COMPOSITION`.

    Raises:
        UserError: without the simulator, or for an invalid task.
    """
    check_simulator()
    world = scenes(task or COMPOSITION, 1, seed)
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
