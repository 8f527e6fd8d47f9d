"""Stick figures: strips of poses and films, limbs coloured by side, on a floor, at equal scale."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.films import Points, Wireframe, drawn, seen
from ftl_lightning.domains.mocap import skeleton
from ftl_lightning.domains.mocap.skeleton import BONES, FPS, HIPS, SHOULDERS, as_joints
from ftl_lightning.domains.pictures import frame_colours
from ftl_lightning.services.text import figure_text

LEFT, RIGHT, TRUNK = "#0a6fb5", "#d9591c", "#3b3f45"
"""Colours of the person's left and right limbs and of the trunk; safe for colour blindness."""
MAX_SAMPLES, POSES = 8, 8  # Maximum rows of a figure, and poses per row
STEP = 1.4  # Distance in metres between poses; arms may reach into the next pose
SOLE = 0.08  # Metres from an ankle down to the floor
HEAD = 0.11  # Radius of the drawn head in metres


_TRUNK = {*HIPS, *SHOULDERS, *skeleton.MIDDLE}
COLOURS = tuple(TRUNK if {*bone} <= _TRUNK else RIGHT if bone[0] in skeleton.RIGHT else LEFT for bone in BONES)


def wireframe(states: Tensor) -> Wireframe:
    """Wireframe of a motion ``(frame, 42)`` or ``(frame, 46)`` on a floor.

    Without root the floor is unknown, and below the lowest joint in every frame: squats come down, and jumps only stretch. With
    root people move over the floor.
    """
    if skeleton.has_root(states):
        moving = np.ascontiguousarray(skeleton.in_space(states.detach().cpu()).numpy(), dtype=np.float32)
        return Wireframe(moving + np.array((0, 0, SOLE), dtype=np.float32), BONES, COLOURS, ((skeleton.HEAD, HEAD, TRUNK),), FPS)
    points = np.ascontiguousarray(as_joints(states.detach().cpu()).numpy(), dtype=np.float32)
    up = np.zeros(3, dtype=np.float32)
    up[2] = 1
    lowest = points[..., 2].min(axis=1)
    return Wireframe(points + (SOLE - lowest)[:, None, None] * up, BONES, COLOURS, ((skeleton.HEAD, HEAD, TRUNK),), FPS)


def film(states: Tensor) -> list[NDArray[np.uint8]]:
    """Frames ``(240, 240, 3)`` of a motion, see :func:`wireframe`."""
    return drawn(wireframe(states))


def picture(states: Tensor, right: Sequence[bool] | None, title: str, starts: InitialStates | None) -> Figure:
    """Strips of poses over time from left to right, of the first :data:`MAX_SAMPLES` of ``(sample, frame, 42)``, without root.

    Frames show success per sample: green, red, or grey for ``None``. Plans start with the initial poses ``starts``.
    """
    shown = states[:MAX_SAMPLES]
    figure = Figure(figsize=(8.2, 1.65 * len(shown) + 0.5), layout="constrained")
    heading = title if len(shown) == len(states) else f"{title} ({len(shown)} of {len(states)} shown)"
    figure.suptitle(figure_text(heading), fontsize=9)
    panels = figure.subplots(len(shown), 1, squeeze=False).flat
    for axes, plan, frame in zip(panels, shown, frame_colours(len(states), right), strict=False):
        _strip(axes, wireframe(plan[:, : len(skeleton.COLUMNS)]), frame)
    for colour, label in ((LEFT, "left"), (RIGHT, "right"), (TRUNK, "trunk")):
        figure.axes[0].plot([], [], color=colour, linewidth=2, label=label)
    figure.legend(loc="outside lower center", ncols=3, fontsize=7, frameon=False, handlelength=1.2)
    return figure


def _strip(axes: Axes, motion: Wireframe, frame: str) -> None:
    times = np.linspace(0, len(motion.points) - 1, min(POSES, len(motion.points))).round().astype(int)
    axes.axhline(0, color="#b9bec4", linewidth=1, zorder=0)
    for place, time in enumerate(times):
        _pose(axes, seen(motion.points[time]), motion, STEP * place)
        seconds = f"{time / motion.rate:.2f} s" if place else "0 s"
        axes.text(STEP * place, -0.08, seconds, fontsize=6, color="#60656b", ha="center", va="top")
    axes.set(xlim=(-STEP * 0.7, STEP * (POSES - 0.3)), ylim=(-0.34, motion.room[1] + 0.05), xticks=[], yticks=[], aspect="equal")
    for spine in axes.spines.values():
        spine.set(color=frame, linewidth=2.0)


def _pose(axes: Axes, points: Points, motion: Wireframe, across: float) -> None:
    depth = [float(points[a, 2] + points[b, 2]) for a, b in motion.lines]
    order = np.argsort(depth).tolist()  # nearer lines last
    at = points[:, :2] + (across, 0)
    lines, colours = [at[list(motion.lines[index])] for index in order], [motion.colours[index] for index in order]
    axes.add_collection(LineCollection(lines, colors=colours, linewidths=2.0, capstyle="round"))
    for point, radius, colour in motion.heads:
        angle = np.linspace(0, 2 * np.pi, 24)
        axes.fill(at[point, 0] + radius * np.cos(angle), at[point, 1] + radius * np.sin(angle), color=colour, linewidth=0)
