"""Recording of demonstrations with a pointer: scenes, movable pieces and conversion of paths."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.vector_film import VectorFilm
from ftl_lightning.services.errors import UserError, shown

Kind = Literal["draw", "arrange", "steer"]
Numbers = NDArray[np.float64]

MOST_STEPS = 20_000
"""Maximum number of steps in a path: more than five minutes at 60 per second."""
AROUND = 4.0
"""Maximum distance of a path from the window, in widths and heights of the window."""


@dataclass(frozen=True)
class Piece:
    """Movable object of a scene.

    Attributes:
        name: such as ``'circle'``; read aloud by screen readers.
        at: initial position, x and y in the film's unit.
        shapes: indices of the film's shapes that move with the piece.
    """

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
    """Validate a recorded path.

    Args:
        scene: scene shown to the user.
        path: numbers ``(step, piece, 2)`` in the film's unit, as nested lists or an array; a drawn line has a single piece.
        seconds: time of each step ``(step,)``.

    Returns:
        Path and times as arrays.

    Raises:
        UserError: for anything else, numbers that are not finite, too many steps, places far outside the window, or times that
            go back.
    """
    pieces = max(len(scene.pieces), 1)
    places, times = _numbers("path", path), _numbers("seconds", seconds)
    if places.ndim != 3 or places.shape[1:] != (pieces, 2) or not len(places):
        raise UserError(f"path: expected places of shape (step, {pieces}, 2), found {places.shape}")
    if len(places) > MOST_STEPS:
        raise UserError(f"path: expected at most {MOST_STEPS:,} steps, found {len(places):,}; show it more quickly")
    if times.shape != places.shape[:1]:
        raise UserError(f"seconds: expected a time for each of {len(places):,} steps, found shape {times.shape}")
    if not (np.isfinite(places).all() and np.isfinite(times).all()):
        raise UserError("path and seconds: expected finite numbers, found others")
    if (np.diff(times) < 0).any():
        raise UserError("seconds: expected times that never go back, found some that do")
    left, lower, width, height = scene.film.window
    away = np.abs((places - (left + width / 2, lower + height / 2)) / (width, height)).max()
    if away > 0.5 + AROUND:
        raise UserError(f"path: expected places near what is in sight, found one {away:.3g} times its size from its middle")
    return places, times


def _numbers(key: str, values: Any) -> Numbers:
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # lists of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "fiu":
        raise UserError(f"{key}: expected numbers in lists of equal lengths, found {shown(values)}")
    return array.astype(np.float64)
