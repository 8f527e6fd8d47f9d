"""Films of episodes, as pictures of the simulator and as moving shapes, and pictures of plans from above and from the front."""

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.films import FINER, PAPER, SIZE, Frames, Points, Shape, VectorFilm, some, still
from ftl_lightning.domains.pictures import framed
from ftl_lightning.services.errors import note
from ftl_metaworld.domain import act
from ftl_metaworld.environment import FIRST, GOAL, GRIPPER, HAND, SECOND, STEP, MetaWorld

if TYPE_CHECKING:
    import mujoco

FRAMES, STEPS_A_SECOND = 64, 40.0
"""Maximum number of frames of an episode, and simulation steps per second of a vector film: half of real time."""
LOOK_AT, AZIMUTH, ELEVATION, DISTANCE = (0.0, 0.65, 0.12), 160.0, -32.0, 1.35
"""Camera: point in the middle of the picture and distance from it in metres, angles in degrees; the model's cameras are tilted."""
VIEWS = (((0, 1), (0.0, 0.0)), ((0, 2), (1.04, 0.35)))
"""Columns of a place and their shift in the drawing in metres, from above and from the front."""
LOW, HIGH, WINDOW = (-0.5, 0.3), (0.5, 1.0), (-0.52, 0.28, 2.08, 0.74)
"""Lower left and upper right corner of the visible workspace from above; left and lower edge, width and height of the drawing."""
GROUND, TABLE, DARK, WAY = "#f1f3f5", "#e8e1d5", "#222222", "#56b4e9"
BACKGROUND = ((-0.5, 0.3, 0.5, 1.0, TABLE), (0.54, 0.3, 1.54, 1.0, GROUND), (0.54, 0.3, 1.54, 0.35, TABLE))
"""Left, lower, right and upper edge and colour of both views, and of the table from the front, whose top is at z = 0."""
PLACES = ((FIRST, "#0072b2", 0.025, True), (SECOND, "#e69f00", 0.025, True), (GOAL, "#d55e00", 0.032, False))
"""Columns, colour (of Okabe and Ito), radius in metres and filling of objects and goal."""
MIDDLE, SPREAD = (0.0, 0.6, 0.2), 0.1
"""Start of plans without initial states, and distance of the fingers, along y, at an opening of 1, in metres."""
MAX_COLUMNS = 3


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Draw the paths of the hand that plans ``(sample, horizon, 4)`` command, from above and, to the right, from the front.

    Paths begin with a square at the hand of the initial state; a plan's first action is past and left out. Dark dots are steps that
    close the gripper. Frames are green, red, or grey for ``None``.
    """
    figure = framed(len(states), right, title, MAX_COLUMNS, (3.6, 1.3))
    for number, (axes, plan) in enumerate(zip(figure.axes, states.cpu(), strict=False)):
        hand = np.array(MIDDLE)
        for corners, colour in _background():
            axes.fill(*corners.T, color=colour, linewidth=0)
        if starts is not None:
            world = starts.observed["world"][number].cpu().numpy()
            hand = world[HAND]
            for place, colour, _, filled in _present(world):
                for at in _views(place):
                    axes.plot(*at, "o", color=colour, fillstyle="full" if filled else "none", markersize=5, mew=1.2)
        moves = STEP * plan[1:, :3].clamp(-1, 1).numpy()
        path = hand + np.concatenate((np.zeros((1, 3)), moves.cumsum(axis=0)))
        closing = path[1:][plan[1:, 3].numpy() > 0]
        for line, start, dots in zip(_views(path), _views(hand), _views(closing), strict=True):
            axes.plot(*line.T, color=WAY, linewidth=2)
            axes.plot(*dots.T, ".", color=DARK, markersize=1.5)
            axes.plot(*start, "s", color=DARK, markersize=2.5)
        left, lower, width, height = WINDOW
        axes.set(xlim=(left, left + width), ylim=(lower, lower + height))
    return figure


def film(rollout: Rollout, plans: Tensor) -> Frames:
    """Film an episode by executing the followed plans ``(step, horizon, 4)`` again: at most :data:`FRAMES` frames.

    Frames are pictures ``(SIZE, SIZE, 3)`` of the simulator; without OpenGL, those of :func:`vector_film`.
    """
    env = MetaWorld()
    env.reset(options={"scene": rollout.starts.require_scenes()[0].numpy()})
    renderer = _renderer(env._simulator.model)
    if renderer is None:
        return _drawn(vector_film(rollout))
    import mujoco

    camera = mujoco.MjvCamera()
    camera.lookat[:] = LOOK_AT
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, DISTANCE
    actions, pictures = _actions(plans), []
    times = some(len(actions) + 1, min(FRAMES, len(actions) // 2 + 2))
    with renderer:
        for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[effect] = False  # six times faster on a CPU
        for time in range(len(actions) + 1):
            if time > 0:
                env.step(actions[time - 1])
            if time in times:
                renderer.update_scene(env._simulator.data, camera)
                pictures.append(renderer.render().copy())
    return pictures


def vector_film(rollout: Rollout) -> VectorFilm:
    """Film of an episode from above and, to the right, from the front, until nothing moves any more.

    The hand is two dots, as far apart as the fingers, with its past way; objects are discs, the goal is a ring.
    """
    world = rollout.observed["world"][0].numpy()
    moving = (world[1:] != world[:-1]).any(axis=1).nonzero()[0]
    end = int(moving[-1]) + 2 if len(moving) else 1
    times = some(end, FRAMES)
    world = world[times, None]
    hand, apart = world[..., HAND], world[..., GRIPPER] * (0, SPREAD / 2, 0)
    shapes = [still("area", corners, colour) for corners, colour in _background()]
    shapes += [Shape("way", way, WAY, 0.01) for way in _views(hand)]
    for places, colour, radius, filled in _present(world):
        shapes += [Shape("dots", at, colour, radius, filled) for at in _views(places)]
    shapes += [Shape("dots", at, DARK, 0.016) for fingers in (hand - apart, hand + apart) for at in _views(fingers)]
    return VectorFilm(shapes, WINDOW, STEPS_A_SECOND * len(times) / end)


def _views(points: NDArray[np.floating]) -> list[Points]:
    """Points of the drawing ``(..., 2)`` of places ``(..., 3)`` from above and from the front; NaN out of the view."""
    views = []
    for columns, shift in VIEWS:
        at = points[..., list(columns)] + shift
        level = at - (shift[0], 0)
        seen = ((level >= LOW) & (level <= HIGH)).all(axis=-1, keepdims=True)
        views.append(np.where(seen, at, np.nan).astype(np.float32))
    return views


def _background() -> Iterator[tuple[Points, str]]:
    """Corners ``(4, 2)`` and colour of both views and of the table from the front."""
    for left, low, right, high, colour in BACKGROUND:
        yield np.array([(left, low), (right, low), (right, high), (left, high)], dtype=np.float32), colour


def _present(world: NDArray[np.floating]) -> Iterator[tuple[NDArray[np.floating], str, float, bool]]:
    """Places ``(..., 3)``, colour, radius and filling of the objects and the goal that worlds ``(..., 21)`` have."""
    for columns, colour, radius, filled in PLACES:
        if (places := world[..., columns][..., :3]).any():
            yield places, colour, radius, filled


def _actions(plans: Tensor) -> list[NDArray[np.float32]]:
    """Actions ``(4,)`` of the plans ``(step, horizon, 4)`` followed at each step, up to the first that is not finite."""
    age, actions = 0, []
    for step, plan in enumerate(plans):
        age = age + 1 if step > 0 and torch.equal(plan, plans[step - 1]) else 0
        actions.append(act(plan[None], age, {})[0].numpy())
        if not np.isfinite(actions[-1]).all():
            return actions[:-1]
    return actions


def _renderer(model: "mujoco.MjModel") -> "mujoco.Renderer | None":
    """Renderer of pictures ``(SIZE, SIZE, 3)``; ``None`` without OpenGL."""
    import mujoco

    class Renderer(mujoco.Renderer):  # type: ignore[misc]
        _gl_context = _mjr_context = None  # `close` reads them, also after a constructor that failed

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return Renderer(model, SIZE, SIZE)
        except Exception:  # each OpenGL library raises its own
            note("film: MuJoCo finds no OpenGL, so films are drawings; for pictures set the variable MUJOCO_GL to egl or osmesa")
            return None


def _drawn(film: VectorFilm) -> Frames:
    """Frames ``(SIZE, width, 3)`` of the areas, ways and dots of a film."""
    left, lower, width, height = film.window
    wide, scale, pictures = round(SIZE * width / height), SIZE * FINER / height, []
    for frame in range(film.frames):
        picture = Image.new("RGB", (wide * FINER, SIZE * FINER), PAPER)
        pen = ImageDraw.Draw(picture)
        for shape in film.shapes:
            points = shape.points[: frame + 1, 0] if shape.kind == "way" else shape.points[frame if len(shape.points) > 1 else 0]
            at = ((points[np.isfinite(points).all(axis=1)] * (1, -1) + (-left, lower + height)) * scale).tolist()
            radius = shape.size * scale
            if shape.kind == "area":
                pen.polygon([*map(tuple, at)], fill=shape.colour)
            elif shape.kind == "way":
                pen.line([*map(tuple, at)], fill=shape.colour, width=round(radius), joint="curve")
            else:
                for x, y in at:
                    fill, edges = shape.colour if shape.filled else None, (x - radius, y - radius, x + radius, y + radius)
                    pen.ellipse(edges, fill, outline=shape.colour, width=round(0.3 * radius))
        pictures.append(np.asarray(picture.resize((wide, SIZE), Image.Resampling.BOX), dtype=np.uint8))
    return pictures
