"""Films of behaviour: animated GIFs at a readable speed, and vector films for web pages."""

import base64
import io
import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.films import VectorFilm, Wireframe, of_wireframe
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.evaluation.results import METHOD, Row
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.text import line

SECONDS, END_SECONDS = 4.0, 1.5
"""Default duration of an animation, and additional duration of its last frame."""
FRAME_SECONDS = (0.05, 0.8)
"""Minimum and maximum duration of a frame; browsers slow down frames below 0.02 s."""
COLOURS = 64
"""Default number of colours per picture: more colours preserve small objects but make larger files."""
FONT_SIZE, MARGIN = 14, 6  # of captions, in pixels
INK, PAPER = (32, 32, 32), (255, 255, 255)
FILMED = 4
"""Number of filmed samples or episodes per task."""
FORMAT = 1  # of film files
STEPS, ABSENT = 10_000, -32_768
"""Coordinate steps across the window's width, and the coordinate of an absent point."""
MILLIMETRES = 1000  # per metre; 3D coordinates are integers in millimetres


def frame_milliseconds(count: int, seconds: float | None = None) -> int:
    """Duration of each of ``count`` frames, in the format's steps of 10 ms; without a total near :data:`SECONDS` in all."""
    duration = float(np.clip(SECONDS / count, *FRAME_SECONDS)) if seconds is None else seconds / count
    return max(10 * round(100 * duration), 20)


def gif(pictures: Sequence[NDArray[np.uint8]], seconds: float | None = None, colours: int = COLOURS) -> bytes:
    """Encode an endless animation of pictures ``(height, width, 3)`` of equal size.

    Args:
        seconds: duration without the pause at the end; ``None`` for a readable speed.
        colours: number of colours per picture, up to 256.
    """
    first, *rest = (Image.fromarray(picture).quantize(colours) for picture in pictures)
    duration = frame_milliseconds(len(pictures), seconds)
    durations = [*[duration] * len(rest), duration + 10 * round(100 * END_SECONDS)]
    content = io.BytesIO()
    first.save(content, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)
    return content.getvalue()


def captioned(pictures: Sequence[NDArray[np.uint8]], text: str, ending: str = "") -> list[NDArray[np.uint8]]:
    """Add a caption below each picture ``(height, width, 3)``, all of equal size; long lines are wrapped.

    ``ending`` is added below the last picture, such as the outcome.
    """
    if not pictures or not (text or ending):
        return list(pictures)
    font = ImageFont.load_default(FONT_SIZE)
    width = pictures[0].shape[1]
    letters = max(1, int((width - 2 * MARGIN) / font.getlength("n")))
    always, ends = (
        [part for row in words.splitlines() for part in textwrap.wrap(line(row), letters) or [""]] for words in (text, ending)
    )
    spacing = round(1.35 * FONT_SIZE)

    def strip(lines: Sequence[str]) -> NDArray[np.uint8]:
        image = Image.new("RGB", (width, spacing * (len(always) + len(ends)) + 2 * MARGIN), PAPER)
        draw = ImageDraw.Draw(image)
        for number, part in enumerate(lines):
            draw.text((MARGIN, MARGIN + number * spacing), part, fill=INK, font=font)
        return np.asarray(image, dtype=np.uint8)

    below, last = strip(always), strip([*always, *ends])
    return [*(np.concatenate((picture, below)) for picture in pictures[:-1]), np.concatenate((pictures[-1], last))]


def side_by_side(films: Mapping[str, Sequence[NDArray[np.uint8]]]) -> list[NDArray[np.uint8]]:
    """Combine films, frames ``(height, width, 3)`` by name, side by side, each above its name.

    Shorter films repeat the last frame; films of smaller height are aligned at the top.
    """
    rows = [captioned(film, name) for name, film in films.items() if len(film)]
    height = max((row[0].shape[0] for row in rows), default=0)
    pictures = []
    for time in range(max(map(len, rows), default=0)):
        parts = []
        for row in rows:
            picture = row[min(time, len(row) - 1)]
            below = np.full((height - picture.shape[0], picture.shape[1], 3), PAPER, dtype=np.uint8)
            parts.append(np.concatenate((picture, below)))
        pictures.append(np.concatenate(parts, axis=1))
    return pictures


def outcome_text(outcomes: Mapping[str, Tensor], episode: int = 0) -> str:
    """Outcomes ``(episode,)`` of an episode by name, boolean or numeric, as text."""

    def text(value: Tensor) -> str:
        return ("yes" if value else "no") if value.dtype == torch.bool else f"{value.item():.2f}"

    return ", ".join(f"{name}: {text(values[episode])}" for name, values in outcomes.items())


def packed(film: VectorFilm) -> list[dict[str, Any]]:
    """Pack shapes as JSON: points as 16-bit integers, in :data:`STEPS` per window width from the lower left corner."""
    left, lower, width, _ = film.window
    entries = []
    for shape in film.shapes:
        points = _integers((np.asarray(shape.points, dtype=np.float64) - (left, lower)) / width * STEPS)
        points = points[:1] if (points == points[:1]).all() else points  # a single frame for static objects
        entry: dict[str, Any] = {"kind": shape.kind, "colour": shape.colour, "count": shape.points.shape[1]}
        entry |= {"size": round(shape.size, 4)} if shape.size else {}
        entry |= {} if shape.filled else {"hollow": True}
        entries.append(entry | {"points": base64.b64encode(points.tobytes()).decode()})
    return entries


def packed_space(motion: Wireframe) -> dict[str, Any]:
    """Pack a 3D motion as JSON: x and y along the floor, z upwards.

    Returns:
        ``points``, base64 of little-endian int16 ``(frame, point, 3)`` in millimetres, within 32 metres, :data:`ABSENT` for
        non-finite values; ``count``, number of points; ``lines``, pairs of points, with ``colours``; ``heads``, a point, a radius
        in metres and a colour each; ``rate``, frames per second; ``room``, radius of the floor and height in metres.
    """
    return {
        "points": base64.b64encode(_integers(motion.points.astype(np.float64) * MILLIMETRES).tobytes()).decode(),
        "count": motion.points.shape[1],
        "lines": [list(pair) for pair in motion.lines],
        "colours": list(motion.colours),
        "heads": [list(head) for head in motion.heads],
        "rate": motion.rate,
        "room": list(motion.room),
    }


def _integers(steps: NDArray[np.float64]) -> NDArray[np.int16]:
    """Round to 16-bit integers; non-finite values become :data:`ABSENT`."""
    finite = np.isfinite(steps)
    return np.where(finite, np.clip(np.rint(np.where(finite, steps, 0)), ABSENT + 1, -ABSENT - 1), ABSENT).astype("<i2")


def write_films(
    path: str | Path,
    domain: Domain,
    judged: Sequence[TaskResult],
    references: Mapping[str, Sequence[TaskResult]],
    rows: Sequence[Row],
) -> int:
    """Write the vector films of an evaluation to a JSON file, for ``report --html``, and return their number.

    Args:
        path, domain, judged: file, domain that draws, and behaviour of the method.
        references: behaviour of the references, by name.
        rows: rows of the evaluation, which describe the films.
    """
    shapes: dict[str, int] = {}  # many films share roads and tables
    by_subject: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        by_subject.setdefault(("" if row.role == METHOD else row.method, row.setting, row.task), []).append(row)
    tasks = []
    for name, behaviours in {"": judged, **references}.items():
        for behaviour in behaviours:
            measured = by_subject.get((name, behaviour.task.setting, behaviour.task.name))
            if measured is None:
                continue
            drawn = [_film_entry(behaviour, domain, number, shapes) for number in range(min(FILMED, len(behaviour.states)))]
            if films := [entry for entry in drawn if entry]:
                subject = {key: value for key, value in asdict(measured[0]).items() if key not in ("metric", "value")}
                values = {row.metric: row.value for row in measured}
                tasks.append({"row": subject, "values": values, "goal": behaviour.task.goal, "films": films})
    text = json.dumps({"format": FORMAT, "domain": domain.name, "shapes": [json.loads(shape) for shape in shapes], "tasks": tasks})
    write_text(Path(path), text + "\n")
    return sum(len(task["films"]) for task in tasks)


def _film_entry(behaviour: TaskResult, domain: Domain, number: int, shapes: dict[str, int]) -> dict[str, Any] | None:
    """Film of a sample or episode as JSON, with its outcomes; new shapes are added to ``shapes``."""
    film = _film(behaviour, domain, number)
    if film is None:
        return None
    return {
        "start": number,
        "rate": round(film.rate, 3),
        "frames": film.frames,
        "window": [round(edge, 4) for edge in film.window],
        "shapes": [shapes.setdefault(json.dumps(shape), len(shapes)) for shape in packed(film)],
        "outcomes": _outcomes(behaviour, number),
    }


def _film(behaviour: TaskResult, domain: Domain, number: int) -> VectorFilm | None:
    """Film of an episode, or of a plan without execution; ``None`` if the domain draws none."""
    loop, show, states = domain.closed_loop, domain.show, behaviour.states[number]
    if behaviour.rollout is not None and loop is not None:
        return loop.vector_film(behaviour.rollout.take(number, number + 1)) if loop.vector_film else None
    if not states.isfinite().all():
        return None
    if show.vector_film is not None:
        return show.vector_film(states, None if behaviour.starts is None else behaviour.starts.take([number]))
    return of_wireframe(show.wireframe(states)) if show.wireframe is not None else None


def _outcomes(behaviour: TaskResult, number: int) -> dict[str, bool | float]:
    """Outcomes of an episode in the domain's main environment, or metrics of a plan."""
    by_name = behaviour.outcomes if behaviour.rollout is not None else behaviour.measured
    outcomes: dict[str, bool | float] = {}
    for name, values in by_name.items():
        alternative = name.endswith(")")  # names of alternative environments are in brackets
        if values.dim() and not alternative and values[number].isfinite():
            outcomes[name] = bool(values[number]) if values.dtype == torch.bool else round(float(values[number]), 3)
    return outcomes
