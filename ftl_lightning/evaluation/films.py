"""Vector films of an evaluation with their rows, for ``report --html``."""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.vector_film import Shape, VectorFilm, of_wireframe
from ftl_lightning.domains.wireframe import Wireframe
from ftl_lightning.evaluation.judged import TaskResult
from ftl_lightning.evaluation.results import METHOD, Row
from ftl_lightning.services.tensor_file import write_text

FILMED = 4
"""Number of filmed samples or episodes per task."""
FORMAT = 1
STEPS, ABSENT = 10_000, -32_768
"""Coordinate steps across the window's width, and the coordinate of an absent point."""


def film_of(behaviour: TaskResult, domain: Domain, number: int) -> VectorFilm | None:
    """Film of an episode, or of a plan without execution; ``None`` if the domain draws none."""
    loop = domain.closed_loop
    if behaviour.rollout is not None and loop is not None:
        return loop.vector_film(behaviour.rollout.take(number, number + 1)) if loop.vector_film else None
    states = behaviour.states[number]
    if not states.isfinite().all():
        return None
    if domain.show.vector_film is not None:
        return domain.show.vector_film(states, None if behaviour.starts is None else behaviour.starts.take([number]))
    return of_wireframe(domain.show.wireframe(states)) if domain.show.wireframe is not None else None


def write_films(
    path: str | Path,
    domain: Domain,
    judged: Sequence[TaskResult],
    references: Mapping[str, Sequence[TaskResult]],
    rows: Sequence[Row],
) -> int:
    """Write the films of an evaluation.

    Args:
        path: JSON file.
        domain: domain that draws.
        judged: behaviour of the method.
        references: behaviour of the reference lines, by name.
        rows: rows of the evaluation, which describe the films.

    Returns:
        Number of films.
    """
    shapes: dict[str, int] = {}  # many films share roads and tables
    films = []
    sources = [(None, judged), *references.items()]
    for name, behaviours in sources:
        for behaviour in behaviours:
            measured = [
                row
                for row in rows
                if (row.setting, row.task) == (behaviour.task.setting, behaviour.task.name)
                and (row.role == METHOD if name is None else row.method == name)
            ]
            if not measured:
                continue
            values = {row.metric: row.value for row in measured}
            subject = {key: value for key, value in asdict(measured[0]).items() if key not in ("metric", "value")}
            drawn = [_entry(behaviour, domain, number, shapes) for number in range(min(FILMED, len(behaviour.states)))]
            if entries := [entry for entry in drawn if entry]:
                films.append({"row": subject, "values": values, "goal": behaviour.task.goal, "films": entries})
    text = json.dumps({"format": FORMAT, "domain": domain.name, "shapes": [json.loads(shape) for shape in shapes], "tasks": films})
    write_text(Path(path), text + "\n")
    return sum(len(task["films"]) for task in films)


def _entry(behaviour: TaskResult, domain: Domain, number: int, shapes: dict[str, int]) -> dict[str, Any] | None:
    film = film_of(behaviour, domain, number)
    if film is None:
        return None
    used = [shapes.setdefault(json.dumps(shape), len(shapes)) for shape in packed(film)]
    window = [round(edge, 4) for edge in film.window]
    return {"start": number, "rate": round(film.rate, 3), "frames": film.frames, "window": window, "shapes": used} | {
        "outcomes": dict(_outcomes(behaviour, number))
    }


def _outcomes(behaviour: TaskResult, number: int) -> Iterator[tuple[str, bool | float]]:
    """Outcomes of an episode in the domain's main environment, or metrics of a plan."""
    by_name: Mapping[str, Tensor] = behaviour.outcomes if behaviour.rollout is not None else behaviour.measured
    for name, values in by_name.items():
        if values.dim() and not name.endswith(")"):  # names of alternative environments stand in brackets
            value = values[number]
            if value.dtype == torch.bool:
                yield name, bool(value)
            elif value.isfinite():
                yield name, round(float(value), 3)


def packed(film: VectorFilm) -> list[dict[str, Any]]:
    """Pack shapes as JSON: points as 16-bit integers, in :data:`STEPS` per window width from the lower left corner."""
    return [_packed(shape, film.window) for shape in film.shapes]


def _packed(shape: Shape, window: tuple[float, float, float, float]) -> dict[str, Any]:
    left, lower, width, _ = window
    steps = (np.asarray(shape.points, dtype=np.float64) - (left, lower)) / width * STEPS
    whole = _whole(steps)
    whole = whole[:1] if (whole == whole[:1]).all() else whole  # a single frame for static objects
    entry: dict[str, Any] = {"kind": shape.kind, "colour": shape.colour, "count": shape.points.shape[1]}
    entry |= {"size": round(shape.size, 4)} if shape.size else {}
    entry |= {} if shape.filled else {"hollow": True}
    return entry | {"points": base64.b64encode(whole.tobytes()).decode()}


MILLIMETRES = 1000
"""Millimetres per metre; 3D coordinates are integers in millimetres."""


def packed_space(motion: Wireframe) -> dict[str, Any]:
    """Pack a 3D motion as JSON: x and y along the floor, z upwards.

    Returns:
        ``points``, base64 of little-endian int16 ``(frame, point, 3)`` in millimetres, within 32 metres, :data:`ABSENT` for
        non-finite values; ``count``, number of points; ``lines``, pairs of points, with ``colours``; ``heads``, a point, a radius
        in metres and a colour each; ``rate``, frames per second; ``room``, radius of the floor and height in metres.
    """
    steps = motion.points.astype(np.float64) * MILLIMETRES
    return {
        "points": base64.b64encode(_whole(steps).tobytes()).decode(),
        "count": motion.points.shape[1],
        "lines": [list(pair) for pair in motion.lines],
        "colours": list(motion.colours),
        "heads": [list(head) for head in motion.heads],
        "rate": motion.rate,
        "room": list(motion.room),
    }


def _whole(steps: NDArray[np.float64]) -> NDArray[np.int16]:
    """Round to 16-bit integers; non-finite values become :data:`ABSENT`."""
    there = np.isfinite(steps)
    return np.where(there, np.clip(np.rint(np.where(there, steps, 0)), ABSENT + 1, -ABSENT - 1), ABSENT).astype("<i2")
