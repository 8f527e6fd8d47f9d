"""What an evaluation task may ask for."""

from typing import Any

import pytest

from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import EvaluationTask, Suite, few_shot_suites
from ftl_lightning.services.errors import UserError


def test_a_suite_learns_every_concept_that_a_task_names_once_and_a_component_is_named_after_its_own() -> None:
    tasks = (
        EvaluationTask("two", "a and b", learned=("a", "b")),
        EvaluationTask("one", "b", learned=("b",)),
        EvaluationTask("text", "c", texts=("c",)),
        EvaluationTask("two", "d and a", learned=("d", "a")),
    )
    assert Suite(tasks).learned == ("a", "b", "d")
    assert few_shot_suites(("known",), ("new",))["new"].tasks == (EvaluationTask("new concept", "new", learned=("new",)),)
    assert EvaluationTask("s", "a", learned=("a and b",), component=1).name == "a (learned from: a and b)"
    assert EvaluationTask("s", "a and b", learned=("a", "b")).name == "a and b"


def test_tasks_that_make_no_sense_are_refused() -> None:
    options: dict[str, Any]
    for options, message in (
        ({"learned": "up"}, "evaluation task 'g': learned: expected a tuple of names, found 'up'"),
        ({"texts": ["up"]}, r"texts: expected a tuple of names, found \['up'\]"),
        ({"without": "up"}, "without: expected a tuple of names"),
        ({"learned": ("a", "b"), "component": 1}, "component: expected one learned concept, found 2"),
        ({"component": 1}, "component: expected one learned concept, found 0"),
        ({"learned": ("a", "b"), "initial": "demonstrated"}, "initial: expected one learned concept, found 2"),
    ):
        with pytest.raises(UserError, match=message):
            EvaluationTask("s", "g", **options)


@pytest.mark.parametrize("name", ["agent", "driving", "object_rearrangement"])
def test_texts_of_every_suite_are_training_concepts_and_learned_ones_are_not_among_them(name: str) -> None:
    concepts = load_domain(name).concepts
    for suite in concepts.suites.values():
        for task in suite.tasks:
            assert {*task.texts, *task.without} <= set(concepts.training)
            assert not set(task.learned) & set(concepts.training)


def test_compositions_of_navigation_are_judged_on_the_validation_suites_targets() -> None:
    suites = load_domain("agent").concepts.suites
    assert set(suites["compositions"].goals) == set(suites["validation"].goals)
    assert not set(suites["compositions"].learned) & {*suites["paper"].learned, *suites["validation"].learned}
