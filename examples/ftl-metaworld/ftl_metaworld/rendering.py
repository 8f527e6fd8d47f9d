"""Films of episodes, as pictures of the simulator and as moving shapes, and pictures of plans, all from above and from the front."""

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
from ftl_metaworld.domain import act
from ftl_metaworld.environment import FIRST, GOAL, GRIPPER, HAND, SECOND, STEP, MetaWorld

if TYPE_CHECKING:
    import mujoco

FRAMES = 64
"""Maximum number of frames of an episode."""
STEPS_A_SECOND = 40.0
"""Simulation steps per second of a vector film: half of real time."""
LOOK_AT, AZIMUTH, ELEVATION, DISTANCE = (0.0, 0.65, 0.12), 160.0, -32.0, 1.35
"""Camera: point in metres at the middle of the picture, angles in degrees and distance in metres. The model's own cameras lean."""
LOW, EXTENT, GAP = (-0.5, 0.35), (1.0, 0.65), 0.04
"""Lower left corner, width and height of what is in sight from above, and gap between the views, in metres."""
VIEWS = (((0, 1), (0.0, 0.0)), ((0, 2), (EXTENT[0] + GAP, 0.4)))
"""Columns of a place, and their shift in the picture in metres: from above and from the front."""
WINDOW = (LOW[0] - GAP / 2, LOW[1] - GAP / 2, 2 * EXTENT[0] + 2 * GAP, EXTENT[1] + GAP)
MIDDLE = (0.0, 0.6, 0.2)
"""Origin of plans without initial states in metres: about where the hand is at the start."""
SPREAD = 0.1
"""Distance of the fingers in metres at an opening of 1; they move along y."""
GROUND, TABLE, DARK, WAY = "#f1f3f5", "#d9cfc0", "#222222", "#56b4e9"
PLACES = ((FIRST, "#0072b2", 0.025, True), (SECOND, "#e69f00", 0.025, True), (GOAL, "#d55e00", 0.032, False))
"""Columns, colour, radius in metres and filling of objects and goal; colours of Okabe and Ito."""
MAX_COLUMNS = 4


def _views(points: NDArray[np.floating]) -> list[Points]:
    """Places ``(..., 3)`` in metres in the picture ``(..., 2)``, from above and from the front; NaN for those out of sight."""
    views = []
    for columns, shift in VIEWS:
        at = points[..., list(columns)] + np.array(shift)
        low = np.array((LOW[0] + shift[0], LOW[1]))
        inside = ((at >= low) & (at <= low + EXTENT)).all(axis=-1, keepdims=True)
        views.append(np.where(inside, at, np.nan).astype(np.float32))
    return views


def _backgrounds() -> list[tuple[Points, str]]:
    """Corners ``(4, 2)`` and colours of the views and of the table as seen from above and from the front."""
    (left, low), (width, height), shift = LOW, EXTENT, np.array(VIEWS[1][1])
    box = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    ground = box * (width, height) + (left + shift[0], low)
    below = box * (width, shift[1] - low) + (left + shift[0], low)  # what is below z = 0
    above = box * (width, height) + (left, low)
    return [(part.astype(np.float32), colour) for part, colour in ((above, TABLE), (ground, GROUND), (below, TABLE))]


def _present(world: NDArray[np.floating]) -> Iterator[tuple[NDArray[np.floating], str, float, bool]]:
    """Places ``(..., 3)``, colour, radius and filling of the objects and the goal of worlds ``(..., 21)``."""
    for columns, colour, radius, filled in PLACES:
        places = world[..., columns][..., :3]
        if np.abs(places).any():
            yield places, colour, radius, filled


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Draw the paths of the hand that plans ``(sample, horizon, 4)`` command, from above and, to the right, from the front.

    A path begins at the hand of the initial state, with a square; the first action of a plan is past and left out. Dark dots are
    steps that close the gripper. Frames are green, red, or grey for ``None``.
    """
    figure = framed(len(states), right, title, MAX_COLUMNS, (3.0, 1.25))
    for number, (axes, plan) in enumerate(zip(figure.axes, states.cpu(), strict=False)):
        for corners, colour in _backgrounds():
            axes.fill(*corners.T, color=colour, linewidth=0)
        hand = np.array(MIDDLE)
        if starts is not None:
            world = starts.observed["world"][number].cpu().numpy()
            hand = world[HAND]
            for place, colour, _, filled in _present(world):
                for at in _views(place):
                    axes.plot(*at, "o", color=colour, fillstyle="full" if filled else "none", markersize=6, mew=1.5)
        moves = plan[1:, :3].clamp(-1, 1).numpy() * STEP
        path = hand + np.concatenate((np.zeros((1, 3)), moves.cumsum(axis=0)))
        closing = path[1:][plan[1:, 3].numpy() > 0]
        for line, start, dots in zip(_views(path), _views(hand), _views(closing), strict=True):
            axes.plot(*line.T, color=WAY, linewidth=2)
            axes.plot(*dots.T, ".", color=DARK, markersize=3)
            axes.plot(*start, "s", color=DARK, markersize=3)
        left, low, width, height = WINDOW
        axes.set(xlim=(left, left + width), ylim=(low, low + height))
    return figure


def vector_film(rollout: Rollout) -> VectorFilm:
    """Film of an episode from above and, to the right, from the front, until nothing moves any more.

    The hand is two dots, as far apart as the fingers, with its past way; objects are discs, the goal is a ring.
    """
    world = rollout.observed["world"][0].numpy()
    moving = (world[1:] != world[:-1]).any(axis=1)
    end = int(moving.nonzero()[0].max()) + 2 if moving.any() else 1
    times = some(end, FRAMES)
    world = world[times]
    hand, apart = world[:, None, HAND], world[:, None, GRIPPER] * (0, SPREAD / 2, 0)
    shapes = [still("area", corners, colour) for corners, colour in _backgrounds()]
    shapes += [Shape("way", way, WAY, 0.01) for way in _views(hand)]
    for places, colour, radius, filled in _present(world[:, None]):
        shapes += [Shape("dots", at, colour, radius, filled) for at in _views(places)]
    shapes += [Shape("dots", fingers, DARK, 0.016) for fingers in _views(np.concatenate((hand - apart, hand + apart), axis=1))]
    return VectorFilm(shapes, WINDOW, STEPS_A_SECOND * len(times) / end)


def film(rollout: Rollout, plans: Tensor) -> Frames:
    """Film an episode: at most :data:`FRAMES` frames ``(height, width, 3)`` of the simulator, which executes the plans again.

    Without OpenGL, the frames are those of :func:`vector_film`. Plans ``(step, horizon, 4)`` are those that were followed.
    """
    env = MetaWorld()
    env.reset(options={"scene": rollout.starts.require_scenes()[0].numpy()})
    renderer = _renderer(env._simulator.model)
    if renderer is None:
        return _drawn(vector_film(rollout))
    actions, pictures = _actions(plans), []
    times = some(len(actions) + 1, min(FRAMES, len(actions) // 2 + 2))
    with renderer:
        for time in range(len(actions) + 1):
            if time:
                env.step(actions[time - 1])
            if time in times:
                renderer.update_scene(env._simulator.data, _camera())
                pictures.append(renderer.render().copy())
    return pictures


def _actions(plans: Tensor) -> list[NDArray[np.float32]]:
    """Actions ``(4,)`` of the plans ``(step, horizon, 4)`` followed at each step, up to one that is not finite."""
    actions: list[NDArray[np.float32]] = []
    age = 0
    for step, plan in enumerate(plans):
        age = age + 1 if step and torch.equal(plan, plans[step - 1]) else 0
        action = act(plan[None], age, {})[0]
        if not action.isfinite().all():
            break
        actions.append(action.numpy())
    return actions


def _camera() -> "mujoco.MjvCamera":
    import mujoco

    camera = mujoco.MjvCamera()
    camera.lookat[:] = LOOK_AT
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, DISTANCE
    return camera


def _renderer(model: "mujoco.MjModel") -> "mujoco.Renderer | None":
    """Renderer of pictures ``(SIZE, SIZE, 3)``; ``None`` without OpenGL."""
    import mujoco

    class Renderer(mujoco.Renderer):
        _gl_context = _mjr_context = None  # closing needs them, even if the constructor fails

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return Renderer(model, SIZE, SIZE)
        except Exception:  # each OpenGL library has its own
            return None


def _drawn(film: VectorFilm) -> Frames:
    """Draw the areas, ways and dots of a film as frames ``(height, width, 3)`` of the height ``SIZE``."""
    left, lower, width, height = film.window
    scale = SIZE * FINER / height
    wide, tall = round(SIZE * width / height), SIZE
    pictures = []
    for frame in range(film.frames):
        picture = Image.new("RGB", (wide * FINER, tall * FINER), PAPER)
        pen = ImageDraw.Draw(picture)
        for shape in film.shapes:
            points = (
                shape.points[: frame + 1].reshape(-1, 2) if shape.kind == "way" else shape.points[min(frame, len(shape.points) - 1)]
            )
            at = [((x - left) * scale, (lower + height - y) * scale) for x, y in points.tolist() if np.isfinite((x, y)).all()]
            radius = shape.size * scale
            if shape.kind == "area":
                pen.polygon(at, fill=shape.colour)
            elif shape.kind == "way":
                pen.line(at, fill=shape.colour, width=round(radius), joint="curve")
            else:
                for x, y in at:
                    edges = (x - radius, y - radius, x + radius, y + radius)
                    pen.ellipse(edges, fill=shape.colour if shape.filled else None, outline=shape.colour, width=round(0.3 * radius))
        pictures.append(np.asarray(picture.resize((wide, tall), Image.Resampling.BOX), dtype=np.uint8))
    return pictures
