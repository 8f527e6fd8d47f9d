"""Checks of a domain's functions, evaluation tasks and suites, and the registry of domains."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.domain import Domain, Metric
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.domains.object_rearrangement import DOMAIN
from ftl_lightning.domains.registry import domain_names, load_domain
from ftl_lightning.domains.tasks import EvaluationTask, Suite, few_shot_suites
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.evaluation.references import references
from ftl_lightning.services.errors import UserError

STATES = torch.zeros(5, 1, 21)
GOAL = "circle right of square"


def with_metric(values: Any) -> Domain:
    return replace(DOMAIN, metrics={"mine": Metric(lambda goal, states, starts: values)})


def test_metrics_judges_and_reference_lines_of_another_shape_are_refused() -> None:
    for wrong in (torch.zeros(5, 5), torch.zeros(3), [True] * 5, STATES.numpy()[:, 0, 0]):
        with pytest.raises(UserError, match=r"metric 'mine': expected a tensor of shape \(5,\) or \(\), found"):
            TaskResult.of(EvaluationTask("s", GOAL), STATES, None, with_metric(wrong))
    for values in (torch.ones(5), torch.tensor(0.5)):  # for each plan, or for all
        assert with_metric(values).measure(GOAL, STATES, None) == {"mine": values}
    rollout = Rollout(InitialStates({}, torch.zeros(2, 1)), {}, torch.zeros(2, dtype=torch.bool), [{}, {}])
    for outcomes, expected in (
        ({"success": torch.ones(2, 2, dtype=torch.bool)}, r"outcome 'success': expected a tensor of shape \(2,\)"),
        ({"crash": torch.ones(2)}, "expected outcomes by name, 'success' among them, found crash"),
        (torch.ones(2), "expected outcomes by name, 'success' among them, found Tensor"),
    ):
        loop = ClosedLoop(lambda: None, lambda plans, step, observed: plans, 1, lambda *_, said=outcomes: said)  # type: ignore[arg-type,misc,return-value]
        with pytest.raises(UserError, match=expected):
            replace(DOMAIN, closed_loop=loop).judge(GOAL, rollout)
    domain = replace(
        DOMAIN,
        name="other",
        comparison=Comparison(references={"mine": lambda goal, count, starts, seed: torch.zeros(count, 2, 21)}),
    )
    one = TaskResult.of(EvaluationTask("s", GOAL), STATES, None, domain)
    with pytest.raises(UserError, match=r"reference 'mine': expected plans \(5, 1, 21\), found \(5, 2, 21\)"):
        references([one], domain, 0)


def test_a_misspelt_goal_is_told_with_goals_that_are_near() -> None:
    with pytest.raises(UserError, match="goal: expected a task of agent, such as 'go to red bowl'"):
        load_domain("agent").check_goal("go to red bowll")


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


BUILT_IN = ("agent", "driving", "driving_wide", "mocap", "mocap_root", "object_rearrangement", "tabletop", "tabletop_wide")
MODULE = """
from dataclasses import replace
from ftl_lightning.domains.object_rearrangement import DOMAIN as OTHER
DOMAIN = replace(OTHER, name="chess")
NOTHING = "a text"
"""
OFFERED = """[ftl_lightning.domains]
chess = chess_domain:DOMAIN
checkers = not_installed_anywhere:DOMAIN
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed package that offers two domains, of which one cannot be imported."""
    (tmp_path / "chess_domain.py").write_text(MODULE)
    with offering(tmp_path, "chess-domain", OFFERED, monkeypatch):
        yield


@contextmanager
def offering(folder: Path, name: str, points: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder on Python's path in which a package of some entry points is installed."""
    card = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    card.mkdir(parents=True)
    (card / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (card / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(folder)
    load_domain.cache_clear()
    yield
    load_domain.cache_clear()


def test_the_built_in_domains_and_that_of_a_package_are_offered_alike_and_also_named_by_where_they_are(package: None) -> None:
    assert domain_names() == tuple(sorted((*BUILT_IN, "chess", "checkers")))
    found = load_domain("chess")
    assert found.name == load_domain("chess_domain:DOMAIN").name == "chess"
    assert load_domain("chess") is found
    assert found.plans == DOMAIN.plans
    assert load_domain("ftl_lightning.domains.object_rearrangement:DOMAIN") is DOMAIN
    for name in BUILT_IN:
        assert load_domain(name).name == name
    assert load_domain("object_rearrangement") is DOMAIN


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("go", r"domain: expected one of agent, checkers, chess, driving, .*, or package.module:DOMAIN, found 'go'"),
        ("", "or package.module:DOMAIN, found ''"),
        ("checkers", r"domain 'checkers': cannot be imported \(No module named 'not_installed_anywhere'\); install its package"),
        ("chess_domain:GAME", r"domain 'chess_domain:GAME': cannot be imported \(.*has no attribute 'GAME'\)"),
        ("nowhere.at_all:DOMAIN", r"domain 'nowhere.at_all:DOMAIN': cannot be imported \(No module named 'nowhere'\)"),
        ("chess_domain:NOTHING", "domain 'chess_domain:NOTHING': expected a Domain, found str"),
        ("chess_domain:", "domain 'chess_domain:': cannot be imported"),
        (":DOMAIN", "domain ':DOMAIN': cannot be imported"),
        (".chess_domain:DOMAIN", "domain '.chess_domain:DOMAIN': cannot be imported"),
    ],
)
def test_each_mistake_in_a_name_is_told(name: str, message: str, package: None) -> None:
    with pytest.raises(UserError, match=message):
        load_domain(name)
