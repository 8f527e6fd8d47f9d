"""Object rearrangement: relations, and the scenes that show them."""

import itertools
from collections import Counter
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.domains.object_rearrangement import scenes
from ftl_lightning.domains.object_rearrangement.scenes import SHAPES, Relation, columns, holds, overlap, parse
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import UserError

DOMAIN = load_domain("object_rearrangement")
SOURCE = DOMAIN.source(None)
TASKS = [task.goal for suite in ("training", "paper", "validation", "compositions") for task in DOMAIN.concepts.suites[suite].tasks]


def succeeded(task: str, states: torch.Tensor) -> torch.Tensor:
    return DOMAIN.metrics["accuracy"].measure(task, states, None)


def scene(**shapes: tuple[float, float, float]) -> torch.Tensor:
    """One state from ``shape=(x, y, radius)``."""
    state = torch.zeros(len(SHAPES), scenes.PER_SHAPE)
    for index, shape in enumerate(SHAPES):
        state[index, :3] = torch.tensor(shapes.get(shape, (0.0, 5.0, 0.3)))
        state[index, 4 + index] = 1
    return state.reshape(1, -1)


def test_the_papers_numbers_of_concepts_and_tasks_and_compositions_for_tuning_that_hold_none_of_them() -> None:
    assert len(DOMAIN.concepts.training) == 12
    suites = DOMAIN.concepts.suites
    count = {name: [task.setting for task in suite.tasks] for name, suite in suites.items()}
    settings = suites["paper"].settings
    assert Counter(count["paper"]) == dict.fromkeys(settings, 5)
    assert set(settings) == {"training composition", "new concept", "new + training"}
    assert count["validation"].count("training composition") >= 6
    assert not set(suites["validation"].learned) & set(suites["paper"].learned)
    assert len(suites["paper"].learned) == 10
    assert set(suites["compositions"].learned) <= set(suites["validation"].learned)
    for goal in suites["compositions"].goals:
        parts = {str(relation) for relation in parse(goal)}
        assert not any({str(relation) for relation in parse(other)} <= parts for other in suites["paper"].goals)
        assert goal not in suites["validation"].goals


def test_the_training_set_is_the_papers_size_and_quick_and_a_task_is_independent_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    batches: list[Any] = []
    plain = scenes._propose
    monkeypatch.setattr(scenes, "_propose", lambda *arguments: batches.append(arguments) or plain(*arguments))
    training = SOURCE.split("train", 920, 0)
    assert len(batches) == 2 * 12  # two of PROPOSALS scenes at once for each concept
    assert training.states.shape == (11_040, 1, 21)
    assert torch.equal(SOURCE.draw(training.concepts[0], 920, 0).states, training.states[:920])
    assert not torch.equal(training.states[:920], SOURCE.draw(training.concepts[0], 920, 1).states)
    task = "circle right of square"
    training = SOURCE.split("train", 8, 5).select(task).states
    for count in (8, 4):
        assert torch.equal(SOURCE.draw(task, count, 5).states, training[:count])


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth of the scenes proposed at a time."""
    monkeypatch.setattr(scenes, "PROPOSALS", scenes.PROPOSALS // 8)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("task", TASKS)
def test_generated_scenes_show_the_task_and_nothing_else(task: str) -> None:
    states = SOURCE.draw(task, 20, 3).states
    assert succeeded(task, states).all()
    flat = states[:, 0]
    assert not overlap(flat).any()
    x, y, radius = columns(flat)
    assert ((x >= 0) & (x <= 5) & (y >= 0) & (y <= 5)).all()
    assert ((radius >= 0.3) & (radius <= 1.0)).all()
    assert torch.equal(flat.unflatten(-1, (3, 7))[..., 4:], torch.eye(3).expand(20, 3, 3))
    named = parse(task)
    for relation in named:
        assert holds(relation, flat, relaxed=False).all()
    about = {frozenset(relation.shapes) for relation in named if relation.kind in ("diagonal to", "antidiagonal to", "next to")}
    for relation in scenes.TRAINING_RELATIONS:
        if relation not in named and frozenset(relation.shapes) not in about:
            assert not holds(relation, flat, relaxed=False).any()


@pytest.mark.parametrize(
    ("relation", "shapes", "exact", "relaxed"),
    [
        ("circle right of square", {"circle": (3, 2, 0.5), "square": (1, 1.6, 0.9)}, True, True),
        ("circle right of square", {"circle": (3, 2, 0.5), "square": (1, 1, 0.9)}, False, True),
        ("circle right of square", {"circle": (3, 4, 0.5), "square": (1, 1, 0.9)}, False, False),
        ("circle right of square", {"circle": (1, 2, 0.5), "square": (3, 2, 0.9)}, False, False),
        ("circle above square", {"circle": (2, 4, 0.5), "square": (2.5, 1, 0.3)}, True, True),
        ("circle above square", {"circle": (2, 4, 0.5), "square": (2.9, 1, 0.3)}, False, True),
        ("square diagonal to triangle", {"square": (3, 3, 0.5), "triangle": (1, 1, 0.3)}, True, True),
        ("square diagonal to triangle", {"square": (3, 3.9, 0.5), "triangle": (1, 1, 0.3)}, False, True),
        ("square diagonal to triangle", {"square": (3, 4.1, 0.5), "triangle": (1, 1, 0.3)}, False, False),
        ("square diagonal to triangle", {"square": (1, 1, 0.5), "triangle": (3, 3, 0.3)}, False, False),
        ("square antidiagonal to triangle", {"square": (1, 4, 0.5), "triangle": (4, 1, 0.3)}, True, True),
        ("square next to triangle", {"square": (1, 1, 0.5), "triangle": (2, 1, 0.3)}, True, True),
        ("square next to triangle", {"square": (1, 1, 0.5), "triangle": (2.5, 1, 0.3)}, False, True),
    ],
)
def test_relations_by_hand(relation: str, shapes: dict[str, tuple[float, float, float]], exact: bool, relaxed: bool) -> None:
    state = scene(**shapes)
    assert holds(parse(relation)[0], state, relaxed=False).item() == exact
    assert holds(parse(relation)[0], state, relaxed=True).item() == relaxed


def test_ring_by_hand() -> None:
    ring = Relation("ring", SHAPES, 1.67)
    for radius, good in ((1.67, True), (1.9, True), (2.0, False), (1.3, False)):
        state = scene(circle=(2.5 + radius, 2.5, 0.4), triangle=(2.5, 2.5 + radius, 0.4), square=(2.5 - radius, 2.5, 0.4))
        assert holds(ring, state, relaxed=True).item() == good
    line = scene(circle=(1, 1, 0.4), triangle=(2, 2, 0.4), square=(3, 3, 0.4))
    assert not holds(ring, line, relaxed=True).item()


def test_a_negated_relation_is_read_written_and_holds_where_the_relation_does_not_even_hold_relaxed() -> None:
    task = "circle above square and not square diagonal to triangle and not circle, triangle and square in a circle of radius 2"
    above, diagonal, ring = parse(task)
    assert (above.negated, diagonal.negated, ring.negated) == (False, True, True)
    assert ring == Relation("ring", SHAPES, 2.0, negated=True)
    assert " and ".join(map(str, (above, diagonal, ring))) == task
    assert scenes.sentence(task).split(" and not ")[1] == "square right and above diagonally to triangle"
    for dx in (0.5, 0.9, 1.1):  # 0.5: exact; 0.9: only relaxed; 1.1: not even that
        state = scene(circle=(2 + dx, 4, 0.5), square=(2, 1, 0.3))
        for relaxed in (False, True):
            assert holds(parse("not circle above square")[0], state, relaxed).item() == (dx > 1)
        assert not succeeded("circle above square and not circle above square", state[:, None]).item()


@pytest.mark.usefixtures("few")
def test_generated_scenes_of_a_negation_are_right_and_no_line_is_forced_on_them() -> None:
    task = "circle right of square and not circle diagonal to triangle"
    states = SOURCE.draw(task, 50, 0).states
    assert succeeded(task, states).all()
    x, y, _ = columns(states[:, 0])
    assert ((x[:, 0] - y[:, 0]).abs() > 1e-2).float().mean() > 0.9


@pytest.mark.usefixtures("few")
def test_a_ring_can_be_laid_onto_either_diagonal() -> None:
    ring = str(Relation("ring", SHAPES, 1.25))
    for pair in ("circle diagonal to triangle", "square antidiagonal to circle"):
        for task in (f"{ring} and {pair}", f"{pair} and {ring}"):
            states = SOURCE.draw(task, 40, 1).states[:, 0]
            assert all(holds(relation, states, relaxed=False).all() for relation in parse(task))
            assert states[:, 0].std() > 0.2  # not always at the same place


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31))
def test_relaxed_contains_exact_and_right_of_excludes_its_reverse(seed: int) -> None:
    states = DOMAIN.comparison.references["random scenes"]("", 200, None, seed)[:, 0]
    for kind, pair in itertools.product(("right of", "above", "next to"), itertools.permutations(SHAPES, 2)):
        relation, reverse = Relation(kind, pair), Relation(kind, pair[::-1])
        exact = holds(relation, states, relaxed=False)
        assert (holds(relation, states, relaxed=True) | ~exact).all()
        if kind != "next to":
            assert not (exact & holds(reverse, states, relaxed=False)).any()


@settings(max_examples=30, deadline=None)
@given(radius=st.floats(0.5, 3), x=st.floats(-2, 2), y=st.floats(-2, 2), turn=st.floats(0, 6.28), gap=st.floats(0.5, 1.5))
def test_the_circumradius_is_that_of_the_circle_points_were_put_on(
    radius: float, x: float, y: float, turn: float, gap: float
) -> None:
    angle = torch.tensor([turn, turn + gap, turn + 3.1 * gap])
    found = scenes.circumradius((x + radius * angle.cos())[None], (y + radius * angle.sin())[None])
    assert found.item() == pytest.approx(radius, rel=1e-3)


@pytest.mark.usefixtures("few")
def test_contradicting_relations_and_an_unreadable_task_are_clear_errors() -> None:
    with pytest.raises(UserError, match="0 of 3 scenes found"):
        SOURCE.draw("circle right of square and square right of circle", 3, 0)
    of_two = ("circle left of square", "circle right of circle", "circle right of squarex", "not not circle above square")
    for task in (*of_two, "circle right of square and", "", "not"):
        with pytest.raises(UserError, match="expected 'A <relation> B'"):
            parse(task)


@pytest.mark.usefixtures("few")
def test_the_oracle_is_right_and_chance_is_not() -> None:
    for task in TASKS[::7]:
        assert succeeded(task, DOMAIN.comparison.references["generator (oracle)"](task, 20, None, 0)).all()
        assert succeeded(task, DOMAIN.comparison.references["random scenes"](task, 500, None, 0)).float().mean() < 0.5
