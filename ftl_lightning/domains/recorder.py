"""Recording of demonstrations with a pointer: scenes, movable pieces, and conversion of paths and drawn lines."""

from collections.abc import Callable, Sized
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, paths_of
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.films import VectorFilm, still
from ftl_lightning.services.errors import require, shown

Kind = Literal["draw", "arrange", "steer"]
Numbers = NDArray[np.float64]

MOST_STEPS, FINEST = 20_000, 20_000
"""Maximum number of steps in a path, more than five minutes, and of points of a line during smoothing."""
AROUND = 4.0
"""Maximum distance of a path from the window, in widths and heights of the window."""
MARGIN = 0.15
"""Margin of the window around the examples, relative to their extent."""
SHORTEST, PIXEL = 0.02, 1 / 400
"""Minimum length of a line, and scale of smoothing (a screen pixel), relative to the window's width."""
FRAME = "#dfe3e8"


@dataclass(frozen=True)
class Piece:
    """Movable object of a scene: name, initial position in the film's unit, and indices of the film's shapes that move with it."""

    name: str
    at: tuple[float, float]
    shapes: tuple[int, ...]


@dataclass(frozen=True)
class Scene:
    """Scene shown before a demonstration.

    Attributes:
        film: a single frame.
        pieces: movable pieces; empty for drawing a line.
        speed: maximum speed of a piece per second of real time, in the film's unit; 0 for no limit.
        seconds: maximum duration of a demonstration in real time; 0 for no limit.
        starts: initial state of an episode, if behaviour has initial states.
        state: ``(state,)`` float32, data of the scene for the domain's ``record``; ``None`` for none.
    """

    film: VectorFilm
    pieces: tuple[Piece, ...] = ()
    speed: float = 0.0
    seconds: float = 0.0
    starts: InitialStates | None = None
    state: Tensor | None = None


@dataclass(frozen=True)
class Recorder:
    """Recorder of demonstrations by hand.

    Attributes:
        kind: ``'draw'``, a line, as path ``(step, 1, 2)``; ``'arrange'``, placing pieces, where only the last places
            ``(1, piece, 2)`` count; ``'steer'``, the path ``(step, 1, 2)`` of a piece from its initial place.
        hint: instruction in a sentence.
        scene: ``(task or '', seed) -> scene``; deterministic.
        record: ``(scene, path (step, piece, 2) in the film's unit, seconds (step,)) -> demonstration`` without a text. Raises
            :class:`~ftl_lightning.services.errors.UserError` for an unusable path. Arguments are validated by :func:`check_path`.
        tasks: tasks with different scenes; empty if scenes do not depend on the task.
    """

    kind: Kind
    hint: str
    scene: Callable[[str, int], Scene]
    record: Callable[[Scene, Numbers, Numbers], Demonstrations]
    tasks: tuple[str, ...] = ()


def check_path(scene: Scene, path: Any, seconds: Any) -> tuple[Numbers, Numbers]:
    """Validate a recorded path ``(step, piece, 2)`` in the film's unit and times ``(step,)``, and return them as arrays.

    Raises:
        UserError: for anything else, numbers that are not finite, too many steps, places far outside the window, or times that
            go back.
    """
    pieces = max(len(scene.pieces), 1)
    for key, values in (("path", path), ("seconds", seconds)):  # sizes before contents
        count = len(values) if isinstance(values, Sized) else 0
        require(count <= MOST_STEPS, key, f"at most {MOST_STEPS:,} steps", f"{count:,}; show it more quickly")
    places, times = _numbers("path", path), _numbers("seconds", seconds)
    fits = places.ndim == 3 and places.shape[1:] == (pieces, 2) and len(places)
    require(fits, "path", f"places of shape (step, {pieces}, 2)", str(places.shape))
    count = len(places)
    require(times.shape == (count,), "seconds", f"a time for each of {count:,} steps", f"shape {times.shape}")
    require(np.isfinite(places).all() and np.isfinite(times).all(), "path and seconds", "finite numbers", "others")
    require((np.diff(times) >= 0).all(), "seconds", "times that never go back", "some that do")
    left, lower, width, height = scene.film.window
    distance = np.abs((places - (left + width / 2, lower + height / 2)) / (width, height)).max()
    far_away = f"one {distance:.3g} times its size from its middle"
    require(distance <= 0.5 + AROUND, "path", "places near what is in sight", far_away)
    return places, times


def _numbers(key: str, values: Any) -> Numbers:
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # lists of different lengths
        array = np.empty(0, dtype=object)
    require(array.dtype.kind in "fiu", key, "numbers in lists of equal lengths", shown(values))
    return array.astype(np.float64)


def reached(line: Numbers) -> Numbers:
    """Arc length at each point ``(point,)`` of a line ``(point, 2)``; the last is the line's length."""
    return np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))


def at_even_steps(line: Numbers, count: int) -> Numbers:
    """Resample a line to points ``(count, 2)`` at even steps, including its ends; pauses of the hand vanish."""
    lengths = reached(line)
    targets = np.linspace(0, lengths[-1], count)
    return np.stack([np.interp(targets, lengths, column) for column in line.T], axis=-1)


def smoothed(line: Numbers, blur: float) -> Numbers:
    """Smooth a line ``(point, 2)`` by Gaussian weights of standard deviation ``blur`` along its length; its ends stay."""
    count = min(int(np.ceil(2 * reached(line)[-1] / blur)) + 2, FINEST)  # two points per blur
    even = at_even_steps(line, count)
    reach = min(6, count - 1)  # three times the blur
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / 2) ** 2)
    # Extend the line by point reflection at its ends, so that the ends stay.
    before, after = 2 * even[:1] - even[reach:0:-1], 2 * even[-1:] - even[-2 : -2 - reach : -1]
    whole = np.concatenate((before, even, after))
    return np.stack([np.convolve(column, weights / weights.sum(), mode="valid") for column in whole.T], axis=-1)


def drawn_by_hand(examples: Demonstrations, horizon: int) -> Recorder | None:
    """Recorder of lines of ``horizon`` states in a window around examples; ``None`` if behaviour is not a line in a plane."""
    if examples.states.shape[2] != 2 or horizon < 2 or examples.observed:
        return None
    covered = torch.cat(paths_of(examples))
    low, high = covered.amin(dim=0).double().numpy(), covered.amax(dim=0).double().numpy()
    middle, side = (low + high) / 2, max(float((high - low).max()), 1e-6)
    corners = middle + side / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    half = side * (0.5 + MARGIN)
    window = (float(middle[0]) - half, float(middle[1]) - half, 2 * half, 2 * half)
    empty = Scene(VectorFilm((still("line", corners, FRAME),), window, 1.0))

    def record(scene: Scene, path: Numbers, seconds: Numbers) -> Demonstrations:
        line, width = path[:, 0], scene.film.window[2]
        length, expected = reached(line)[-1], f"one longer than {SHORTEST:.0%} of the window"
        require(length >= SHORTEST * width, "line", expected, f"{length / width:.1%}; draw it again")
        # Even steps along the line, not in time: the speed of the hand is accidental, and states would accumulate at pauses.
        states = at_even_steps(smoothed(line, PIXEL * width), horizon)
        return Demonstrations(
            states=torch.from_numpy(states).float()[None],
            lengths=torch.tensor([horizon]),
            domain=examples.domain,
            state_names=examples.state_names,
            state_units=examples.state_units,
            concepts=("",),
            provenance={"generator": "by hand"},
        )

    hint = "Draw one line of the kind that you mean. The frame shows where other lines lie; speed does not matter."
    return Recorder("draw", hint, lambda task, seed: empty, record)
