"""Behaviour shown by hand: what comes in is checked, and what becomes of it is behaviour of the domain."""

import json
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import recognised, strokes
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.films import VectorFilm, still
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.domains.object_rearrangement.scenes import EXTENT, TRAINING_RELATIONS, holds, overlap
from ftl_lightning.domains.recorder import AROUND, MOST_STEPS, Recorder, Scene, at_even_steps, check_path, reached, smoothed
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import LONGEST, UserError

SHAPES = load_domain("object_rearrangement")
assert SHAPES.recordings.recorder is not None
ARRANGED = SHAPES.recordings.recorder
EMPTY = Scene(VectorFilm((still("line", [(0, 0), (1, 1)], "#000000"),), (0.0, 0.0, 10.0, 10.0), 1.0))


def examples(horizon: int = 40, columns: int = 2) -> Demonstrations:
    states = torch.from_numpy(strokes("heart", 6, 0)).repeat(1, 1, columns // 2)[:, :horizon]
    names = tuple(f"c{number}" for number in range(columns))
    return Demonstrations(states, torch.full((6,), horizon), "", names, ("cm",) * columns, ("heart",) * 6)


def drawn(horizon: int = 40) -> Recorder:
    found = own_domain(examples(horizon), ("heart",), horizon, {}).recordings.recorder
    assert found is not None
    return found


def shown(recorder: Recorder, path: Any, seconds: Any = None) -> Demonstrations:
    scene = recorder.scene("", 0)
    return recorder.record(scene, *check_path(scene, path, list(range(len(path))) if seconds is None else seconds))


def as_hand(line: np.ndarray, rng: np.random.Generator, pixel: float) -> list[Any]:
    """A line as a page sends it: on the grid of a screen, quick and slow, and at rest twice."""
    fine = at_even_steps(line, 300)
    uneven = np.sort(rng.choice(300, 150, replace=False))
    path = fine[np.concatenate(([0] * 20, uneven, [299] * 30))]
    on_grid: list[Any] = json.loads(json.dumps((np.rint(path / pixel) * pixel)[:, None].tolist()))
    return on_grid


def test_a_path_that_is_none_is_one_plain_line_and_one_near_what_is_in_sight_is_taken_as_it_is() -> None:
    path: Any
    shape, lists = "shape (step, 1, 2)", "numbers in lists of equal lengths"
    for path, seconds, expected in (
        ([], [], shape),
        ([[[0, 0], [1, 1]]], [0], shape),
        ([[[0, 0]], [[1]]], [0, 1], lists),
        ([[["0", "0"]]], [0], lists),
        ([[[None, 0]]], [0], lists),
        ({"x": 1}, [0], lists),
        ([[[0, float("nan")]]], [0], "finite"),
        ([[[0, 0]]], [float("inf")], "finite"),
        ([[[0, 0]], [[1, 1]]], [0], "a time for each of 2 steps"),
        ([[[0, 0]], [[1, 1]]], [1, 0.5], "never go back"),
        ([[[0, 0]]] * (MOST_STEPS + 1), [0] * (MOST_STEPS + 1), "at most 20,000"),
        ([[[5 + 10 * (AROUND + 0.51), 5]]], [0], "near what is in sight"),
    ):
        with pytest.raises(UserError) as error:
            check_path(EMPTY, path, seconds)
        assert expected in str(error.value)
        assert "\n" not in str(error.value)
        assert len(str(error.value)) <= LONGEST
    places, times = check_path(EMPTY, [[[-3, 12]], [[4, 5.5]], [[4, 5.5]]], [0, 0.1, 0.1])
    assert places.tolist() == [[[-3, 12]], [[4, 5.5]], [[4, 5.5]]]
    assert times.tolist() == [0, 0.1, 0.1]


@pytest.mark.parametrize("kind", ["heart", "zigzag", "square"])
def test_a_drawn_line_is_a_stroke_like_those_of_the_data(kind: str) -> None:
    recorder, rng = drawn(), np.random.default_rng(0)
    pixel = recorder.scene("", 0).film.window[2] / 500
    originals = strokes(kind, 8, 5)
    found = [shown(recorder, as_hand(one.astype(np.float64), rng, pixel)) for one in originals]
    states = torch.cat([one.states for one in found])
    assert states.shape == originals.shape
    assert recognised(states.numpy()) == [kind] * 8
    for one, original in zip(states.double().numpy(), originals, strict=True):
        steps = np.linalg.norm(np.diff(one, axis=0), axis=1)
        assert steps.max() < 1.35 * np.median(steps)  # even but for what a chord cuts off at corners; no pause is left
        assert np.allclose(one[[0, -1]], original[[0, -1]], atol=pixel)
        whole = at_even_steps(original.astype(np.float64), 2000)
        apart = np.linalg.norm(one[:, None] - whole, axis=-1).min(axis=1)
        assert apart.max() < 2 * pixel + 0.03  # no smoother than the screen is fine, and the strokes' trembling
    assert found[0].concepts == ("",)
    assert found[0].lengths.tolist() == [40]


def test_smoothing_takes_the_pixels_and_leaves_the_ends_and_the_corners() -> None:
    line = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)])
    even = at_even_steps(line, 1000)
    stairs = np.rint((even + 0.004 * np.arange(1000)[:, None]) / 0.02) * 0.02
    smooth = smoothed(stairs, 0.03)
    assert np.array_equal(smooth[[0, -1]].round(9), stairs[[0, -1]].round(9))
    exact = smoothed(line, 0.03)
    assert np.linalg.norm(exact - (4, 0), axis=1).min() < 0.03
    assert reached(exact)[-1] == pytest.approx(7, abs=0.05)
    turns, rough = (np.abs(np.diff(np.diff(at_even_steps(one, 1000), axis=0), axis=0)).mean() for one in (smooth, stairs))
    assert turns < 0.2 * rough


def test_lines_are_drawn_within_a_square_around_the_examples_and_slips_and_other_behaviour_are_not() -> None:
    recorder = drawn()
    scene = recorder.scene("any", 3)
    left, lower, width, height = scene.film.window
    assert width == height
    states = examples().states.numpy()
    assert (states > (left, lower)).all()
    assert (states < (left + width, lower + height)).all()
    assert scene.film.frames == 1
    x, y = left + width / 2, lower + height / 2
    for length in (0.0, 0.019):
        with pytest.raises(UserError, match="draw it again"):
            shown(recorder, [[[x, y]], [[x + length * width, y]]])
    assert shown(recorder, [[[x, y]], [[x + 0.03 * width, y]]]).states.shape == (1, 40, 2)
    for horizon, columns in ((1, 2), (40, 4)):
        assert own_domain(examples(horizon, columns), ("heart",), horizon, {}).recordings.recorder is None


def test_shapes_are_put_where_they_belong_and_judged_as_any_scene() -> None:
    seen = [ARRANGED.scene("", seed) for seed in range(20)]
    states = torch.stack([scene.state for scene in seen if scene.state is not None])
    assert not overlap(states).any()
    assert not any(holds(relation, states, relaxed=False).any() for relation in TRAINING_RELATIONS)
    assert len({tuple(row) for row in states.tolist()}) == 20
    assert torch.equal(states[3], ARRANGED.scene("", 3).state)  # type: ignore[arg-type]
    scene = seen[0]
    assert [piece.name for piece in scene.pieces] == ["circle", "triangle", "square"]
    for piece in scene.pieces:
        (number,) = piece.shapes
        assert np.allclose(scene.film.shapes[number].points[0].mean(axis=0), piece.at, atol=1e-5)
    path = [[[4.5, 2.0], [0.5, 0.4], [-0.7, 5.9]]]
    found = ARRANGED.record(scene, *check_path(scene, path, [0]))
    before, after = states[0].reshape(3, 7), found.states[0, 0].reshape(3, 7)
    assert torch.equal(after[:, 2:], before[:, 2:])
    assert torch.allclose(after[:, :2], torch.tensor([[4.5, 2.0], [0.5, 0.4], [0.0, EXTENT]]))
    assert found.state_names == SHAPES.plans.columns
    assert found.concepts == ("",)
    scene = ARRANGED.scene("", 1)
    found = ARRANGED.record(scene, *check_path(scene, [[[4.5, 1.0], [2.5, 4.5], [1.0, 1.0]]], [0]))
    found.save("one.safetensors")
    states = Demonstrations.load("one.safetensors").states
    assert SHAPES.metrics["accuracy"].measure("circle right of square", states, None).all()
    assert not SHAPES.metrics["accuracy"].measure("square right of circle", states, None).any()
