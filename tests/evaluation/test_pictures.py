"""Animated GIFs, and the vector films of an evaluation."""

import base64
import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving.traffic import SHIPPED
from ftl_lightning.domains.films import Shape, VectorFilm, Wireframe, still
from ftl_lightning.domains.registry import domain_names, load_domain
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.evaluation.pictures import ABSENT, STEPS, captioned, frame_milliseconds, gif, outcome_text, packed, packed_space
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


@pytest.mark.slow
def test_an_evaluation_writes_films_of_its_rows(evaluated: Path, log: Path) -> None:
    content, rows = json.loads((evaluated / "films.json").read_text()), read_rows(log)
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
    starts = domain.source(None).starts("go to red bowl", 1, 0)
    plans = domain.comparison.references["expert (oracle)"]("go to red bowl", 1, starts, 0)
    rollout = roll_out(domain.closed_loop, starts, PlanFollower(fixed_plans(plans), domain.closed_loop.act, 200))
    film = domain.closed_loop.vector_film(rollout)
    way = next(shape for shape in film.shapes if shape.kind == "way")
    world = rollout.observed["world"][0]
    assert torch.equal(torch.from_numpy(way.points[0, 0]), world[0, [0, 2]])
    assert torch.equal(torch.from_numpy(way.points[-1, 0]), world[-1, [0, 2]])
    assert film.frames > 10


@pytest.mark.slow
def test_roads_stay_and_the_controlled_vehicle_drives() -> None:
    domain = load_domain("driving")
    starts = domain.source(None).starts("roundabout", 1, 0)
    faster = domain.closed_loop.policies["FASTER"]("roundabout", starts, None, 0)
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
    from ftl_lightning.domains.pictures import line_drawings

    names = tuple(f"c{number}" for number in range(columns))
    show = line_drawings(names)
    film = show.vector_film(torch.randn(12, columns, generator=torch.Generator().manual_seed(0)), None)
    left, lower, width, height = film.window
    for shape in film.shapes:
        assert (shape.points >= (left, lower)).all()
        assert (shape.points <= (left + width, lower + height)).all()
    assert film.frames == 12


def test_points_in_space_are_within_a_millimetre() -> None:
    points = np.random.default_rng(0).uniform(-2, 2, (5, 3, 3)).astype(np.float32)
    points[2, 1] = np.inf
    motion = Wireframe(points, ((0, 1), (1, 2)), ("#ff0000", "#00ff00"), ((2, 0.11, "#0000ff"),), 30.0, (0.75, 2.1))
    found = json.loads(json.dumps(packed_space(motion)))
    at = np.frombuffer(base64.b64decode(found.pop("points")), dtype="<i2").reshape(5, 3, 3)
    assert (at[2, 1] == ABSENT).all()
    finite = np.isfinite(points)
    assert np.abs(at[finite] / 1000 - points[finite]).max() <= 0.00051
    assert found == {
        "count": 3,
        "lines": [[0, 1], [1, 2]],
        "colours": ["#ff0000", "#00ff00"],
        "heads": [[2, 0.11, "#0000ff"]],
        "rate": 30.0,
        "room": [0.75, 2.1],
    }


@pytest.mark.parametrize("name", [name for name in domain_names() if not name.startswith("ftl_")])
def test_plans_of_every_domain_that_ships_can_be_drawn(name: str) -> None:
    show = load_domain(name).show
    assert show.vector_film is not None or show.wireframe is not None


def middle(film: VectorFilm) -> NDArray[np.float32]:
    """Where the film's last shape is ``(frame, 2)``."""
    return np.asarray(film.shapes[-1].points.mean(axis=1), dtype=np.float32)


@pytest.mark.parametrize("length", [1, 2, 30])
def test_a_plan_of_the_agent_is_a_way_in_its_scene(length: int) -> None:
    domain = load_domain("agent")
    starts = domain.source(None).starts("go to red bowl", 1, 0)
    states = domain.comparison.references["nearest object"]("go to red bowl", 1, starts, 0)[0, :length]
    film = domain.show.vector_film(states, starts)
    assert film.frames == length
    assert np.allclose(middle(film), states[:, [0, 2]].numpy(), atol=1e-5)
    assert film.frames / film.rate == pytest.approx(length / 30)  # seconds, for the shorter and the longer ones
    assert sum(len(shape.points) == 1 for shape in film.shapes) >= 4  # two objects, each in its ring


def test_a_demonstration_of_driving_is_drawn_on_its_road_among_the_others_at_its_start() -> None:
    domain = load_domain("driving")
    shipped = Demonstrations.load(SHIPPED / "merge.safetensors").rows([3])
    length = int(shipped.lengths[0])
    for states in (shipped.states[0, :length], shipped.states[0, :8] * 1.01):  # a plan's headings and presence are about 1
        film = domain.show.vector_film(states, shipped.initial_states)
        assert film.frames == len(states)
        assert np.allclose(middle(film), states[:, 1:3].numpy() * (1, -1), atol=1e-2)
        sides = np.linalg.norm(np.diff(film.shapes[-1].points, axis=1), axis=-1)
        assert np.allclose(sides, (2, 5, 2), atol=1e-2)  # a vehicle, whatever the heading's length
        others = [shape for shape in film.shapes[:-1] if shape.kind == "area"]
        seen = shipped.observed["traffic"][0, 0].reshape(5, 7)[1:].numpy()
        present = seen[seen[:, 0] > 0]
        assert len(others) == len(present) > 0
        assert np.allclose(np.stack([one.points[0].mean(axis=0) for one in others]), present[:, 1:3] * (1, -1), atol=1e-3)
        assert any(shape.kind == "line" for shape in film.shapes)


def test_a_demonstration_on_the_table_is_the_hands_way_among_objects_that_stay() -> None:
    domain = load_domain("tabletop")
    shown = domain.source(None).draw("pick green circle to book", 1, 1)
    states = shown.states[0, : int(shown.lengths[0])]
    film = domain.show.vector_film(states, shown.initial_states)
    way = next(shape for shape in film.shapes if shape.kind == "way")
    left, lower, width, height = film.window
    inside = (way.points >= (left, lower)) & (way.points <= (left + width, lower + height))
    assert inside.all()
    # Where the hand closes, it is at the circle: seen from the front, in the middle of the circle's layers.
    circle = [shape for shape in film.shapes if shape.kind == "area" and shape.colour in ("#13731a", "#1a9933", "#137326")]
    assert len(circle) == 4
    heart = np.concatenate([layer.points[0] for layer in circle]).mean(axis=0)
    closed = int((states[:, 3] < 0.06).nonzero()[0])
    assert np.linalg.norm(way.points[round(closed / len(states) * film.frames), 0] - heart) < 0.05
    assert all(len(shape.points) == 1 for shape in film.shapes if shape.kind == "area")
    bare = domain.show.vector_film(states, None)
    assert sum(shape.kind == "area" for shape in bare.shapes) == 1  # the table
    assert film.frames / film.rate == pytest.approx(len(states) / 20)  # twice as fast as it was


def pictures(count: int) -> list[NDArray[np.uint8]]:
    return [np.full((30, 120, 3), 5 * number, dtype=np.uint8) for number in range(count)]


def durations(content: bytes) -> list[int]:
    return [frame.info["duration"] for frame in ImageSequence.Iterator(Image.open(io.BytesIO(content)))]


@pytest.mark.parametrize("count", [3, 9, 40])
def test_an_animation_can_be_followed_whatever_its_number_of_frames(count: int) -> None:
    found = durations(gif(pictures(count)))
    assert len(found) == count
    assert Image.open(io.BytesIO(gif(pictures(count)))).info["loop"] == 0
    assert len(set(found[:-1])) == 1
    assert 3000 <= sum(found) <= 6000
    assert found[-1] == found[0] + 1500  # it rests at the end


def test_the_speed_can_be_chosen() -> None:
    assert durations(gif(pictures(4), seconds=2)) == [500, 500, 500, 2000]
    assert frame_milliseconds(1000, seconds=1) == 20  # browsers slow down what is shorter
    assert frame_milliseconds(2) == 800


def test_a_caption_stands_below_every_picture_and_breaks_its_lines() -> None:
    plain = pictures(2)
    short, long = (captioned(plain, text) for text in ("goal", "a goal that is told in many more words than fit"))
    for one, other in zip(short, plain, strict=True):
        assert np.array_equal(one[:30], other)
        assert one.shape[1] == 120
        assert (one[30:] < 128).any()  # ink
    assert len(long[0]) > len(short[0]) > 30
    edge = long[0][30:, -4:]
    assert (edge == 255).all()  # nothing runs out of the picture
    assert captioned(plain, "")[0].shape == plain[0].shape


def test_how_it_ended_is_told_in_words_and_stands_below_the_last_picture_alone() -> None:
    plain = pictures(3)
    first, second, last = captioned(plain, "goal", "success: yes")
    assert first.shape == second.shape == last.shape
    alone = captioned(plain, "goal")[0]
    assert np.array_equal(first[: len(alone) - 6], alone[:-6])
    assert (first[len(alone) - 6 :] == 255).all()
    assert np.array_equal(first[30:], second[30:])
    assert (last[len(alone) - 6 :] < 128).any()
    outcomes = {"success": torch.tensor([True, False]), "return": torch.tensor([1.0, 2.345])}
    assert outcome_text(outcomes) == "success: yes, return: 1.00"
    assert outcome_text(outcomes, 1) == "success: no, return: 2.35"
    assert outcome_text({}) == ""
