"""How a person shows behaviour with a pointer: what is seen before a demonstration, what moves, and what becomes of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.vector_film import VectorFilm
from ftl_lightning.errors import UserError, shown

Kind = Literal["draw", "arrange", "steer"]
Numbers = NDArray[np.float64]

MOST_STEPS = 20_000
"""Of a path: more than five minutes at 60 a second."""
AROUND = 4.0
"""A path stays within so many widths and heights of the window around it: a hand may leave what is in sight, but not get lost."""


@dataclass(frozen=True)
class Piece:
    """Something that the hand moves.

    Attributes:
        name: such as ``'circle'``; read aloud by a screen reader.
        at: where it is before it is moved, x and y in the film's unit.
        shapes: which of the film's shapes move with it, by their numbers.
    """

    name: str
    at: tuple[float, float]
    shapes: tuple[int, ...]


@dataclass(frozen=True)
class Scene:
    """What a person sees before a demonstration.

    Attributes:
        film: one frame.
        pieces: what is moved; none where a line is drawn.
        speed: the most that a piece moves in a second of the person's time, in the film's unit; 0 for any speed.
        seconds: the most that a demonstration takes, in the person's time; 0 for any time.
        starts: of one episode, where behaviour has initial states.
        state: ``(state,)`` float32, what a domain's ``record`` needs to know of the scene; ``None`` for nothing.
    """

    film: VectorFilm
    pieces: tuple[Piece, ...] = ()
    speed: float = 0.0
    seconds: float = 0.0
    starts: InitialStates | None = None
    state: Tensor | None = None


@dataclass(frozen=True)
class Recorder:
    """How behaviour of a domain is shown by hand.

    Attributes:
        kind: ``'draw'``, one line, a path ``(step, 1, 2)``; ``'arrange'``, pieces are put where they belong, of which the last
            places ``(1, piece, 2)`` count; ``'steer'``, the path ``(step, 1, 2)`` of one piece from its place on.
        hint: one sentence that says what to do.
        scene: ``(task or '', seed) -> what is seen``; the same two give the same scene.
        record: ``(scene, path (step, piece, 2) in the film's unit, seconds (step,)) -> one demonstration`` without a text. It
            raises a :class:`~ftl_lightning.errors.UserError` for a path that shows nothing. What it is given was checked by
            :func:`expect_path`.
        tasks: of which scenes can be drawn; empty where scenes are alike.
    """

    kind: Kind
    hint: str
    scene: Callable[[str, int], Scene]
    record: Callable[[Scene, Numbers, Numbers], Demonstrations]
    tasks: tuple[str, ...] = ()


def expect_path(scene: Scene, path: Any, seconds: Any) -> tuple[Numbers, Numbers]:
    """What a person's hand did, checked once, where it comes in.

    Args:
        scene: that was seen.
        path: numbers ``(step, piece, 2)`` in the film's unit, as nested lists or an array; one piece where a line is drawn.
        seconds: ``(step,)``, when the hand was there.

    Returns:
        The same as arrays.

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
        found = np.asarray(values)
    except (TypeError, ValueError):  # lists of different lengths
        found = np.empty(0, dtype=object)
    if found.dtype.kind not in "fiu":
        raise UserError(f"{key}: expected numbers in lists of equal lengths, found {shown(values)}")
    return found.astype(np.float64)
