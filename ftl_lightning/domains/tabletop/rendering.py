"""Figures of plans from above, and films of episodes with their plans."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.films import Shape, VectorFilm, some, still
from ftl_lightning.domains.pictures import framed
from ftl_lightning.domains.tabletop.interface import FRONT, HERTZ, POSE, THRESHOLD, check_simulator
from ftl_lightning.domains.tabletop.scenes import BOOK, CIRCLE, COLUMNS, HEIGHT, OBJECTS, SIGHT, WHITE, outline, outlines, support
from ftl_lightning.domains.tabletop.world import ARM, COLOUR, FINGERS, TABLE_COLOUR

MAX_COLUMNS = 4
FRAMES = 60  # Maximum number of frames of an episode
_OPEN, _CLOSED = (0, 150, 255), (255, 0, 90)  # Colours of a plan's states in a film, by gripper command


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Tables from above with the hand's paths of plans ``(sample, horizon, 4)``; frames are green, red, or grey for ``None``."""
    figure = framed(len(states), right, title, MAX_COLUMNS, (2.2, 1.8))
    for number, (axes, plan) in enumerate(zip(figure.axes, states, strict=False)):
        scene = None if starts is None or starts.scenes is None else starts.scenes[number].numpy()
        _table(axes, plan.cpu().numpy(), scene)
    return figure


def _table(axes: Axes, plan: NDArray[np.float32], scene: NDArray[np.float32] | None) -> None:
    placed = {} if scene is None else outlines(scene)
    for name in sorted(placed, key=(BOOK, WHITE).__contains__, reverse=True):  # objects on the book are drawn after it
        points = placed[name][:, ::-1]  # y to the left and x up, as the camera sees it
        axes.add_patch(Polygon(points, facecolor=COLOUR[name], edgecolor="#404040" if name != CIRCLE else "none", linewidth=0.5))
    axes.plot(plan[:, 1], plan[:, 0], color="#d0006f", linewidth=1.2)
    axes.plot(plan[0, 1], plan[0, 0], "o", color="#d0006f", markersize=3)
    (low, high), (right, left) = SIGHT
    axes.set(xlim=(left, right), ylim=(low, high), facecolor="#d9cfc0")


def film(rollout: Rollout, plans: Tensor) -> list[NDArray[np.uint8]]:
    """Front views ``(240, 320, 3)`` of an episode, at most :data:`FRAMES`, with the plan of each step ``(step, horizon, 4)``."""
    check_simulator()
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

    trace, pictures = rollout.infos[0].get("trace", []), []
    times = np.unique(np.linspace(0, max(len(trace) - 1, 0), FRAMES).round().astype(int))
    env = TableTopEnvironment(arm_drawn=True)
    try:
        env.reset(options={"scene": rollout.starts.require_scenes()[0].numpy()})
        for time in times:
            if trace:
                env.show(trace[time])
            pictures.append(_with_plan(env.render(), plans[min(time, len(plans) - 1)].numpy()))
    finally:
        env.close()
    return pictures


def _with_plan(picture: NDArray[np.uint8], plan: NDArray[np.float32]) -> NDArray[np.uint8]:
    drawn, (height, width) = picture.copy(), picture.shape[:2]
    if not np.isfinite(plan).all():
        return drawn
    for (column, row), opening in zip(FRONT.pixels(plan[:, :3].astype(np.float64)), plan[:, 3], strict=True):
        x, y = round(float(column)), round(float(row))
        if 1 <= x < width - 1 and 1 <= y < height - 1:
            drawn[y - 1 : y + 2, x - 1 : x + 2] = _OPEN if opening > THRESHOLD else _CLOSED
    return drawn


DEPTH = 0.45  # Vertical shift per depth in vector films
LAYERS = 4  # Stacked outlines per object
SHAPE_FRAMES, SPEED = 50, 2.0  # Maximum number of frames and speed factor of vector films
HAND, WAY = "#5a5f66", "#d0006f"


def vector_film(rollout: Rollout) -> VectorFilm:
    """Vector film of an episode from the front: objects as stacked outlines, the gripper as two fingers."""
    trace = np.stack(rollout.infos[0]["trace"]) if rollout.infos[0].get("trace") else np.zeros((1, 0))
    scene = rollout.starts.require_scenes()[0].numpy()
    times = some(len(trace), SHAPE_FRAMES)
    hand = rollout.observed[POSE][0].numpy()[times]
    present = [name for name in OBJECTS if scene[COLUMNS[name]][0] > 0.5]
    poses = dict(zip(present, np.split(trace[times, len(ARM) + len(FINGERS) :], max(len(present), 1), axis=1), strict=False))
    placed = {name: np.array([(x, y, z - HEIGHT[name] / 2, _yaw(turn)) for x, y, z, *turn in rows]) for name, rows in poses.items()}
    return _from_front([*_objects(placed), *_hand(hand[:, :3], hand[:, 7])], len(times), len(trace))


def plan_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Vector film of a plan or a demonstration ``(time, 4)`` from the front; objects stay at their initial poses, if known."""
    times = some(len(states), SHAPE_FRAMES)
    hand = states.numpy()[times]
    placed = {}
    if starts is not None and starts.scenes is not None:
        scene = starts.scenes[0].numpy()
        for name in outlines(scene):
            _, x, y, yaw = scene[COLUMNS[name]]
            placed[name] = np.array([(x, y, support(scene, name), yaw)])
    way = Shape("way", _front(hand[:, :3])[:, None].astype(np.float32), WAY, 0.004)
    return _from_front([*_objects(placed), way, *_hand(hand[:, :3], hand[:, 3])], len(times), len(states))


def _from_front(shapes: Sequence[Shape], frames: int, steps: int) -> VectorFilm:
    """Film of shapes on the table: ``frames`` selected of ``steps``."""
    (low, high), (left, right) = SIGHT  # y grows to the right from the front
    table = [(low, right), (low, left), (high, left), (high, right)]
    top = still("area", _front(np.array([(*corner, 0.0) for corner in table])), _hex(TABLE_COLOUR, 1.25))
    window = (left, DEPTH * (FAR - high), right - left, DEPTH * (high - low) + 0.2)
    return VectorFilm((top, *shapes), window, SPEED * HERTZ * frames / max(steps, 1))


def _objects(placed: Mapping[str, NDArray[np.floating]]) -> Iterator[Shape]:
    """Outlines of objects at poses ``(frame, 4)``: x, y, height of the surface below, and yaw."""
    for name in sorted(placed, key=(BOOK, WHITE).__contains__, reverse=True):  # objects on the book are drawn after it
        for layer in range(LAYERS):
            above = HEIGHT[name] * layer / (LAYERS - 1)
            edges = [(outline(name, x, y, yaw), foot + above) for x, y, foot, yaw in placed[name].tolist()]
            points = np.stack([_front(np.column_stack((edge, np.full(len(edge), z)))) for edge, z in edges]).astype(np.float32)
            yield Shape("area", points, _hex(COLOUR[name], 0.75 if layer < LAYERS - 1 else 1.0))


def _hand(places: NDArray[np.floating], opening: NDArray[np.floating]) -> Iterator[Shape]:
    """Fingers with an opening ``(frame,)`` at positions ``(frame, 3)``, and a dot on the table below them."""
    yield Shape("dots", _front(places * (1, 1, 0))[:, None].astype(np.float32), _hex(TABLE_COLOUR, 0.8), 0.008)
    for side in (-0.5, 0.5):
        tip = places + np.outer(opening + 0.012, (0, side, 0))
        finger = np.stack((_front(tip), _front(tip + np.array((0, 0, 0.06)))), axis=1)
        yield Shape("line", finger.astype(np.float32), HAND, 0.01)


FAR = 0.78  # x that is drawn at height 0


def _front(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Oblique front projection of points ``(..., 3)`` in metres: ``(..., 2)``, to the right and upwards."""
    return np.stack((points[..., 1], points[..., 2] + DEPTH * (FAR - points[..., 0])), axis=-1)


def _yaw(quaternion: Sequence[float]) -> float:
    x, y, z, w = quaternion
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _hex(colour: Sequence[float], light: float) -> str:
    return "#" + "".join(f"{min(round(255 * part * light), 255):02x}" for part in colour)
