"""Top-view pictures of roads, vehicles and plans."""

import functools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates, check_starts, take
from ftl_lightning.domains.driving.traffic import NAMES, SCENARIO, TRAFFIC, VEHICLES, check_simulator, decision_seconds
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.films import Shape, VectorFilm, still
from ftl_lightning.domains.pictures import frame_colours
from ftl_lightning.services.text import figure_text

MAX_COLUMNS, MAX_PANELS = 4, 8
BETWEEN = 4  # frames per decision in films of episodes
EGO, OTHER, ROAD, PLAN, MARK = "#2f8f57", "#3f6fb5", "#d8d8d8", "#e4704a", "#f4f4f4"
LENGTH, WIDTH, LANE = 5.0, 2.0, 4.0
"""Length and width of a vehicle and width of a lane in metres."""
MARGIN, MAX_ASPECT = 20.0, 1.8
"""Metres of road shown around moving objects, and maximum aspect ratio of a picture."""
AREA, PAGE = 9.0, 13.0
"""Area of a panel in square inches and width of a figure in inches."""
PLAN_REACH = 25.0
"""Maximum distance in metres from the driven path at which plans extend the window of a film."""
LEGEND = (
    Patch(color=EGO, label="controlled vehicle, its way"),
    Patch(color=OTHER, label="other vehicles"),
    Line2D([], [], color=PLAN, marker=".", label="plan"),
)

Window = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lower and upper corner ``(2,)`` of a map section."""


@functools.cache
def _lanes(name: str) -> tuple[NDArray[np.float64], ...]:
    """Centre lines ``(points, 2)`` of a scenario's lanes."""
    check_simulator()
    from ftl_lightning.domains.driving.scenarios import make

    env = make(name)
    env.reset(seed=0)
    known = env.road.network.lanes_list()
    lanes = tuple(np.array([lane.position(s, 0) for s in np.linspace(0, min(lane.length, 1000), 60)]) for lane in known)
    env.close()
    return lanes


def _window(around: NDArray[np.float32]) -> Window:
    """Map section around points ``(points, 2)``, within :data:`MAX_ASPECT`."""
    low, high = around.min(axis=0).astype(float) - MARGIN, around.max(axis=0).astype(float) + MARGIN
    missing = np.maximum((high - low).max() / MAX_ASPECT - (high - low), 0) / 2
    return low - missing, high + missing


def _draw(axes: Axes, name: str, vehicles: NDArray[np.float32], plan: NDArray[np.float32] | None, window: Window) -> None:
    """Draw lanes and vehicles ``(vehicle, 7)`` to scale, the controlled vehicle first."""
    low, high = window
    for lane in _lanes(name):
        along = np.gradient(lane, axis=0)
        length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        across = np.stack((-along[:, 1], along[:, 0]), axis=1) / length * LANE / 2
        axes.add_patch(Polygon(np.concatenate((lane + across, (lane - across)[::-1])), color=ROAD, linewidth=0, zorder=0))
        for side in (lane + across, lane - across):
            axes.plot(*side.T, color="white", linewidth=0.6, zorder=0.5)
    for number, (present, x, y, _, _, cos, sin) in enumerate(vehicles.tolist()):
        if present > 0:
            ahead, aside = np.array((cos, sin)) * LENGTH / 2, np.array((-sin, cos)) * WIDTH / 2
            corners = (ahead + aside, ahead - aside, -ahead - aside, -ahead + aside)
            axes.add_patch(Polygon([(x + dx, y + dy) for dx, dy in corners], color=OTHER if number else EGO, zorder=2))
    if plan is not None:
        axes.plot(plan[:, 1], plan[:, 2], ".-", color=PLAN, linewidth=1.2, markersize=5, zorder=3)
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), xticks=[], yticks=[], aspect="equal")  # y points down the page


def render(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Draw a grid of at most :data:`MAX_PANELS` scenes with their plans ``(scene, horizon, 7)``, to scale, and a legend."""
    starts = check_starts(starts)
    shown = states[:MAX_PANELS].numpy()
    windows = [_window(plan[:, 1:3]) for plan in shown]
    sizes = np.array([high - low for low, high in windows]).max(axis=0)
    width = float(np.sqrt(AREA * sizes[0] / sizes[1]))
    columns = min(len(shown), MAX_COLUMNS, max(1, int(PAGE / width)))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(max(width * columns, 5.0), AREA / width * rows + 0.8), layout="constrained")
    caption = title if len(shown) == len(states) else f"{title} ({len(shown)} of {len(states)} shown)"
    figure.suptitle(figure_text(caption), fontsize=11)
    colours = frame_colours(len(states), right)
    for number, axes in enumerate(figure.subplots(rows, columns, squeeze=False).flat):
        if number >= len(shown):
            axes.set_axis_off()
            continue
        observed = take(starts.observed, number)
        vehicles = observed[TRAFFIC].unflatten(0, (VEHICLES, -1)).numpy()
        _draw(axes, NAMES[int(observed[SCENARIO].item())], vehicles, shown[number], windows[number])
        for spine in axes.spines.values():
            spine.set(color=colours[number], linewidth=1.5)
    figure.legend(handles=LEGEND, loc="outside lower center", ncols=len(LEGEND), frameon=False)
    return figure


def _driven(rollout: Rollout) -> tuple[str, NDArray[np.float32]]:
    """Scenario, and vehicles ``(decision, 5, 7)`` of an episode until nothing moves any more."""
    episode = take(rollout.observed, 0)
    traffic = episode[TRAFFIC].unflatten(1, (VEHICLES, -1))
    moving = traffic[:, 0, 1:3].diff(dim=0).abs().amax(dim=1) > 0
    end = int(moving.nonzero().max()) + 2 if moving.any() else 1
    return NAMES[int(episode[SCENARIO][0].item())], traffic[:end].numpy()


def film(rollout: Rollout, plans: Tensor) -> list[NDArray[np.uint8]]:
    """Film an episode: frames ``(height, width, 3)``, :data:`BETWEEN` per decision, until nothing moves any more.

    The driven path is green, the current plan of ``plans (time, 8, 7)`` orange. The caption shows scenario, time and speed, and in
    the last frame the outcome.
    """
    name, traffic = _driven(rollout)
    end, ways = len(traffic), traffic[:, 0, 1:3]
    planned = plans[:end, :, 1:3].reshape(-1, 2).numpy()
    near = np.clip(planned[np.isfinite(planned).all(axis=1)], ways.min(axis=0) - PLAN_REACH, ways.max(axis=0) + PLAN_REACH)
    window = _window(np.concatenate((ways, near)))
    width, height = np.sqrt(1.7 * AREA) * np.sqrt((window[1] - window[0]) / (window[1] - window[0])[::-1])
    info = rollout.infos[0]
    ended = "crashed" if info.get("crashed") else "arrived" if info.get("arrived") else "time is up" if info else "broke off"
    vehicles = np.stack([traffic[:, 0], *_followed(traffic[:, 1:], decision_seconds(name))], axis=1)
    pictures = []
    for moment in np.arange((end - 1) * BETWEEN + 1) / BETWEEN:
        time = int(moment)
        figure = Figure(figsize=(max(width, 4.0), height + 0.4), dpi=90, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        axes = figure.subplots()
        current = _between(vehicles[time], vehicles[min(time + 1, end - 1)], moment - time)
        _draw(axes, name, current, plans[time].numpy() if time < len(plans) else None, window)
        axes.plot(*np.concatenate((ways[: time + 1], current[:1, 1:3])).T, color=EGO, linewidth=1.5, zorder=1)
        now = f"{name}, {time * decision_seconds(name):g} s, {np.linalg.norm(traffic[time, 0, 3:5]):.0f} m/s"
        axes.set_title(f"{now}: {ended}" if moment == end - 1 else now, fontsize=9)
        figure.legend(handles=LEGEND, loc="outside lower center", ncols=len(LEGEND), frameon=False, fontsize=7, columnspacing=1)
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return pictures


def _between(before: NDArray[np.float32], after: NDArray[np.float32], part: float) -> NDArray[np.float32]:
    """Interpolate vehicles ``(vehicle, 7)`` between decisions; vehicles absent at either stay."""
    moved = before + part * (after - before)
    return np.where((before[:, :1] > 0) & (after[:, :1] > 0), moved, before).astype(np.float32)


PLAYED, FAR = 2.0, 100.0
"""Playback speed of vector films, and metres of road around moving objects in them; a page shows a part of it."""
PIXELS = 20.0  # of the length of a vehicle
SAME = 12.0  # metres at most from the predicted position to match a vehicle


def vector_film(rollout: Rollout) -> VectorFilm:
    """Top-view film of an episode, a frame per decision, until nothing moves; roads grey, controlled vehicle green."""
    name, traffic = _driven(rollout)
    others = [Shape("area", _corners(seen), OTHER) for seen in _followed(traffic[:, 1:], decision_seconds(name))]
    return _from_above(name, others, traffic[:, 0])


def plan_film(states: Tensor, starts: InitialStates | None) -> VectorFilm:
    """Top-view film of a plan or demonstration ``(time, 7)`` among resting vehicles; raises a ``UserError`` without the
    simulator.
    """
    observed = take(check_starts(starts).observed, 0)
    vehicles = observed[TRAFFIC].unflatten(0, (VEHICLES, -1)).numpy()
    ego = states.numpy().copy()
    ego[:, 0] = 1
    ego[:, 5:] /= np.maximum(np.linalg.norm(ego[:, 5:], axis=1, keepdims=True), 1e-6)  # generated headings are not normalised
    others = [Shape("area", _corners(vehicle[None]), OTHER) for vehicle in vehicles[1:] if vehicle[0] > 0]
    planned = Shape("dots", (ego[None, :, 1:3] * (1, -1)).astype(np.float32), PLAN, 0.9)
    return _from_above(NAMES[int(observed[SCENARIO].item())], [planned, *others], ego)


def _from_above(name: str, others: Sequence[Shape], ego: NDArray[np.float32]) -> VectorFilm:
    """Film of roads, other shapes and the controlled vehicle's path ``(time, 7)``; the controlled vehicle is the last shape."""
    low, high = _window(ego[:, 1:3])
    near = [lane[((lane > low - FAR) & (lane < high + FAR)).all(axis=1)] for lane in _lanes(name)]
    lanes = [lane * (1, -1) for lane in near if len(lane) > 1]
    roads = [still("line", lane, colour, size) for colour, size in ((ROAD, LANE), (MARK, 0.3)) for lane in lanes]
    way = Shape("way", (ego[:, None, 1:3] * (1, -1)).astype(np.float32), EGO, 0.6)
    window = (float(low[0]), float(-high[1]), float(high[0] - low[0]), float(high[1] - low[1]))
    shapes = (*roads, way, *others, Shape("area", _corners(ego), EGO))
    return VectorFilm(shapes, window, PLAYED / decision_seconds(name), PIXELS / LENGTH)


def _corners(seen: NDArray[np.float32]) -> NDArray[np.float32]:
    """Outline ``(decision, 4, 2)`` of a vehicle ``(decision, 7)``, NaN where absent."""
    present, x, y, _, _, cos, sin = (column[:, None] for column in seen.T)
    along, aside = np.array((1, 1, -1, -1)) * LENGTH / 2, np.array((1, -1, -1, 1)) * WIDTH / 2
    corners = np.stack((x + cos * along - sin * aside, -(y + sin * along + cos * aside)), axis=-1)
    return np.where(present[..., None] > 0, corners, np.nan).astype(np.float32)


def _followed(traffic: NDArray[np.float32], seconds: float) -> list[NDArray[np.float32]]:
    """Track vehicles ``(decision, 7)`` in the nearest vehicles ``(decision, vehicle, 7)``, whose order changes."""
    known: list[NDArray[np.float32]] = []
    for time, seen in enumerate(traffic):
        unmatched = [vehicle for vehicle in seen if vehicle[0] > 0]
        for track in known:
            before = track[time - 1]
            expected = before[1:3] + seconds * before[3:5]
            distances = [float(np.linalg.norm(vehicle[1:3] - expected)) for vehicle in unmatched] if before[0] > 0 else []
            if distances and min(distances) < SAME:
                track[time] = unmatched.pop(int(np.argmin(distances)))
        for vehicle in unmatched:
            known.append(np.zeros((len(traffic), seen.shape[1]), dtype=np.float32))
            known[-1][time] = vehicle
    return known
