"""Films of an evaluation: what is written, and that it says what happened."""

import base64
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.vector_film import Shape, VectorFilm, still
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.evaluation.films import ABSENT, STEPS, packed
from ftl_lightning.evaluation.results import read_rows


def places(shape: dict[str, object], window: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Points of a packed shape ``(frame, point, 2)`` in the film's unit."""
    at = np.frombuffer(base64.b64decode(str(shape["points"])), dtype="<i2").reshape(-1, int(str(shape["count"])), 2).astype(float)
    return np.where(at == ABSENT, np.nan, at * window[2] / STEPS + window[:2])


def test_packed_points_are_within_a_step_and_absent_ones_stay_absent() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 5, (4, 3, 2)).astype(np.float32)
    points[1, 2] = np.nan
    film = VectorFilm((Shape("line", points, "#000000", 0.1), still("dots", [(0, 0)], "#ffffff", 0.2)), (-3, -3, 8, 8), 10)
    line, dot = packed(film)
    assert np.allclose(places(line, film.window), points, atol=film.window[2] / STEPS, equal_nan=True)
    assert dot["size"] == 0.2
    assert film.frames == 4


def test_an_evaluation_writes_films_of_its_rows(invert: Callable[..., Path], tmp_path: Path) -> None:
    path, results = tmp_path / "films" / "a.json", tmp_path / "rows.csv"
    invert(f"--evaluation.films={path}", f"--evaluation.results={results}")
    content, rows = json.loads(path.read_text()), read_rows(results)
    assert content["domain"] == "object_rearrangement"
    ours = [task for task in content["tasks"] if task["row"]["role"] == "method"]
    assert {task["row"]["task"] for task in ours} == set(rows.loc[rows["role"] == "method", "task"])
    for task in ours:
        own = rows[(rows["role"] == "method") & (rows["task"] == task["row"]["task"]) & (rows["setting"] == task["row"]["setting"])]
        assert task["values"]["accuracy"] == own.loc[own["metric"] == "accuracy", "value"].item()
        assert task["row"]["config_hash"] == own["config_hash"].iloc[0]
        right = [film["outcomes"]["accuracy"] for film in task["films"]]
        assert len(right) == 3  # as many as there are samples
        assert np.mean(right) == pytest.approx(task["values"]["accuracy"], abs=1e-6)
    used = {index for task in content["tasks"] for film in task["films"] for index in film["shapes"]}
    assert used == set(range(len(content["shapes"])))


def test_the_agent_of_a_film_goes_where_it_went() -> None:
    domain = load_domain("agent")
    assert domain.closed_loop is not None
    assert domain.closed_loop.vector_film is not None
    starts = domain.source(None).starts("go to red bowl", 1, 0)
    plans = domain.references["expert (oracle)"]("go to red bowl", 1, starts, 0)
    rollout = roll_out(domain.closed_loop, starts, PlanFollower(fixed_plans(plans), domain.closed_loop.act, 200))
    film = domain.closed_loop.vector_film(rollout)
    way = next(shape for shape in film.shapes if shape.kind == "way")
    world = rollout.observed["world"][0]
    assert torch.equal(torch.from_numpy(way.points[0, 0]), world[0, [0, 2]])
    assert torch.equal(torch.from_numpy(way.points[-1, 0]), world[-1, [0, 2]])
    assert film.frames > 10


def test_roads_stay_and_the_controlled_vehicle_drives() -> None:
    domain = load_domain("driving")
    assert domain.closed_loop is not None
    assert domain.closed_loop.vector_film is not None
    starts = domain.source(None).starts("roundabout", 1, 0)
    faster = domain.closed_loop.policies["FASTER"]("roundabout", starts, None, 0)
    assert faster is not None
    rollout = roll_out(domain.closed_loop, starts, faster)
    film = domain.closed_loop.vector_film(rollout)
    roads = [shape for shape in film.shapes if shape.kind == "line"]
    others = [shape.points for shape in film.shapes if shape.kind == "area"][:-1]
    assert roads
    assert all(len(road.points) == 1 for road in roads)
    ego = film.shapes[-1].points
    traffic = rollout.observed["traffic"][0][: len(ego)].numpy()
    assert np.allclose(ego.mean(axis=1), traffic[:, 1:3] * (1, -1), atol=1e-3)
    assert np.linalg.norm(ego[-1].mean(axis=0) - ego[0].mean(axis=0)) > 10
    present = traffic.reshape(len(ego), -1, 7)[:, 1:, 0].sum(axis=1)
    assert (sum(np.isfinite(one).all(axis=(1, 2)).astype(int) for one in others) == present).all()
    jumps = [np.linalg.norm(np.diff(one.mean(axis=1), axis=0), axis=-1) for one in others]
    assert np.nanmax(np.concatenate(jumps)) < 50  # metres in a second: nobody becomes somebody else


@pytest.mark.parametrize("columns", [2, 4])
def test_own_behaviour_is_filmed_by_its_columns(columns: int) -> None:
    from ftl_lightning.domains.domain import Plans, line_drawings

    names = tuple(f"c{number}" for number in range(columns))
    show = line_drawings(Plans(12, names, ("m",) * columns))
    assert show.vector_film is not None
    film = show.vector_film(torch.randn(12, columns, generator=torch.Generator().manual_seed(0)), None)
    left, lower, width, height = film.window
    for shape in film.shapes:
        assert (shape.points >= (left, lower)).all()
        assert (shape.points <= (left + width, lower + height)).all()
    assert film.frames == 12
