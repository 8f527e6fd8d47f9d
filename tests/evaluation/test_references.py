"""Novelty, coverage and their references."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import path_distance, scaled_distance, warped_distances
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.from_file import own_domain
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation import references
from ftl_lightning.evaluation.generation import TaskResult
from ftl_lightning.evaluation.references import FRESH, REPLAYED, Real, coverage, lines, novelty
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import DEMONSTRATION_SEED
from tests.evaluation.conftest import invert

SCENES = load_domain("object_rearrangement")
NEW = "square diagonal to triangle"
TASK = EvaluationTask("new concept", NEW, learned=(NEW,))


def five(domain: Domain = SCENES, goal: str = NEW) -> Demonstrations:
    return domain.source(None).draw(goal, 5, DEMONSTRATION_SEED)


def real_of(task: EvaluationTask, domain: Domain, count: int, demonstrations: Demonstrations | None) -> Real:
    """Real behaviour for as many generated plans."""
    plans = torch.zeros(count, domain.plans.horizon, len(domain.plans.columns))
    return Real.of(TaskResult(task, plans, {}, demonstrations=demonstrations), domain)


def test_novelty_and_coverage_of_three_plans_and_the_distance_of_paths_by_hand() -> None:
    """Plans at 0, 1 and 5 on a line; demonstrations at 0 and 4; fresh samples at 0, 2 and 9."""
    plans, known, fresh = (torch.tensor(one)[:, None, None] for one in ([0.0, 1.0, 5.0], [0.0, 4.0], [0.0, 2.0, 9.0]))
    assert novelty(path_distance(plans, known)) == pytest.approx((0 + 1 + 1) / 3)
    assert coverage(path_distance(plans, fresh)) == pytest.approx((0 + 1 + 4) / 3)
    path = torch.zeros(1, 2, 2)
    others = torch.tensor([[[3.0, 4.0], [0.0, 0.0]], [[3.0, 4.0], [3.0, -4.0]]])
    assert torch.allclose(path_distance(path, others), torch.tensor([[(25 / 2) ** 0.5, 5.0]]))


def test_a_scaled_distance_does_not_depend_on_units_and_leaves_constant_columns_alone() -> None:
    draw = torch.Generator().manual_seed(0)
    real, plans = torch.randn((20, 3, 2), generator=draw), torch.randn((4, 3, 2), generator=draw)
    real[..., 1] = 2.0
    units = torch.tensor([100.0, 1.0])
    found = scaled_distance(real)(plans, real)
    assert torch.allclose(scaled_distance(real * units)(plans * units, real * units), found, rtol=1e-4)
    alone = plans.clone()
    alone[..., 1] += 3
    assert torch.allclose(scaled_distance(real)(plans, alone).diagonal(), torch.full((4,), 3.0), rtol=1e-4)


def test_replayed_demonstrations_have_novelty_0_and_fresh_samples_are_none_nor_those_that_are_to_be_covered() -> None:
    real = real_of(TASK, SCENES, 20, five())
    found = real.lines()
    assert found[REPLAYED].values["novelty"] == 0
    assert found[REPLAYED].values["accuracy"] == found[FRESH].values["accuracy"] == 1
    assert found[FRESH].values["novelty"] > 1
    assert found[FRESH].values["coverage"] < found[REPLAYED].values["coverage"]
    assert len(found[REPLAYED].states) == len(found[FRESH].states) == 20
    assert torch.equal(found[REPLAYED].states[:5], found[REPLAYED].states[5:10])  # in turn
    covered, own = real.fresh
    assert SCENES.distances(own.states, covered.states, path_distance).min() > 0
    assert SCENES.distances(own.states, five().states, path_distance).min() > 0
    assert real.values(covered.states)["coverage"] == 0


def test_more_plans_never_increase_the_distance_of_coverage() -> None:
    real = real_of(TASK, SCENES, 40, five())
    plans = SCENES.comparison.references["random scenes"](NEW, 40, None, 0)
    found = [real.values(plans[:count])["coverage"] for count in range(1, 41)]
    assert found == sorted(found, reverse=True)
    assert found[-1] < found[0]


def test_wider_plans_do_not_seem_nearer_for_it() -> None:
    """Scales are those of real behaviour, so that noise has its full distance."""
    real = real_of(TASK, replace(SCENES, comparison=replace(SCENES.comparison, distance=None)), 10, five())
    values = [real.values(five().states * width)["novelty"] for width in (2, 20)]
    assert values[1] > 5 * values[0] > 0


@pytest.mark.parametrize(
    ("task", "names"),
    [
        (TASK, ["novelty", "coverage"]),
        (EvaluationTask("new + training", f"{NEW} and circle above square", (NEW,), ("circle above square",)), ["coverage"]),
        (EvaluationTask("component 1", "circle above square", learned=(NEW,), component=1), ["coverage"]),
        (EvaluationTask("training concept", "circle above square", texts=("circle above square",)), ["coverage"]),
        (EvaluationTask("own demonstrations", "my way", learned=("my way",)), ["novelty"]),
        (replace(TASK, initial="demonstrated"), []),
    ],
)
def test_what_there_is_to_compare_with_depends_on_the_task(task: EvaluationTask, names: list[str]) -> None:
    known = five() if task.learned else None
    assert list(real_of(task, SCENES, 5, known).values(five().states)) == names


@pytest.mark.slow
def test_a_task_that_cannot_be_drawn_has_no_coverage(caplog: pytest.LogCaptureFixture) -> None:
    impossible = "circle above square and square above circle"
    real = real_of(EvaluationTask("s", impossible, texts=("circle above square",)), SCENES, 1, None)
    assert real.values(five().states) == {}
    assert real.lines() == {}
    assert lines([real]) == {}
    assert "no coverage" in caplog.text


def test_driving_has_novelty_alone_since_its_expert_is_slow() -> None:
    driving = load_domain("driving")
    demonstrations = driving.source(None).split("validation", 3, 0)
    task = EvaluationTask("new initial state", "highway", learned=("highway",))
    real = real_of(task, driving, 3, demonstrations)
    rows = torch.arange(3)
    plans = demonstrations.windows(rows, 0 * rows, driving.plans.horizon)[0]
    assert real.values(plans) == {"novelty": 0}
    assert real.lines() == {}  # nothing else is measured of plans
    assert real.values(plans[:, :2]) == {}  # of a method that plans a step at a time


def test_distances_that_do_not_fit_are_refused_in_one_line() -> None:
    states = five().states
    with pytest.raises(UserError, match=r"^domain object_rearrangement, distance: .*\(5, 1, 21\), found shape \(5, 1, 20\)$"):
        SCENES.distances(states, states[..., 1:], path_distance)
    with pytest.raises(UserError, match=r"^domain object_rearrangement, distance: .*shape \(2, 5\), found shape \(2,\)$"):
        SCENES.distances(states[:2], states, lambda one, other: torch.zeros(2))


def test_a_plan_that_is_not_finite_covers_nothing_and_is_far_from_everything() -> None:
    states = five().states
    broken = torch.full_like(states[:1], torch.nan)
    real = real_of(TASK, SCENES, 5, five())
    assert real.values(torch.cat((states, broken)))["coverage"] == real.values(states)["coverage"]
    assert real.values(broken)["novelty"] == torch.inf


def test_scenes_differ_by_their_shapes_centres_alone() -> None:
    scene = five().states[:1]
    turned, moved = scene.clone(), scene.clone()
    turned[..., 2:7] += 0.1  # radius, angle and type of the circle
    moved[..., 7] += 3  # x of the triangle
    moved[..., 8] += 4
    assert SCENES.comparison.distance(scene, torch.cat((turned, moved))).tolist() == [[0, pytest.approx(5)]]


def test_paths_of_navigation_are_seen_from_their_start() -> None:
    agent = load_domain("agent")
    path = torch.randn((1, 128, 13), generator=torch.Generator().manual_seed(0))
    elsewhere, faster, longer = path.clone(), path.clone(), path.clone()
    elsewhere[..., [0, 2]] += 1  # x and z
    faster[..., 3:] += 1
    longer[:, 1:, 0] += 1
    found = agent.comparison.distance(path, torch.cat((elsewhere, faster, longer)))[0].tolist()
    assert found == pytest.approx([0, 0, (127 / 128) ** 0.5], abs=1e-5)


def test_paths_of_driving_are_seen_from_their_start_and_heading() -> None:
    driving = load_domain("driving")
    north, east = torch.zeros(1, 8, 7), torch.zeros(1, 8, 7)
    ahead = 5 * torch.arange(8.0)
    north[..., 1], north[..., 5] = ahead + 3, 1.0  # along x with cosine 1
    east[..., 2], east[..., 6] = ahead - 7, 1.0  # along y with sine 1
    assert driving.comparison.distance(north, torch.cat((east, north.roll(1, 0)))).tolist()[0] == pytest.approx([0, 0], abs=1e-5)
    slower = north.clone()
    slower[:, -1, 1] -= 8
    assert driving.comparison.distance(north, slower).item() == pytest.approx((64 / 8) ** 0.5)


def test_the_cache_forgets_the_oldest_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(references, "_CACHE", {})
    monkeypatch.setattr(references, "KEPT", 2)
    computed: list[str] = []

    def value(key: str) -> str:
        computed.append(key)
        return key

    for key in "aabcba":
        assert references._cached(key, lambda key=key: value(key)) == key
    assert computed == ["a", "b", "c", "a"]


def test_own_behaviour_is_compared_by_time_warping_and_has_no_fresh_samples() -> None:
    time = torch.linspace(0, 1, 12)

    def wave(shift: float) -> Tensor:
        return torch.stack((10 * time, (6.28 * (time + shift)).sin()), dim=1)

    states = torch.stack([wave(shift) for shift in (0.0, 0.1, 0.2)])
    examples = Demonstrations(states, torch.full((3,), 12), "own", ("x", "y"), ("", ""), ("a", "a", "b"))
    domain = own_domain(examples, ("a", "b"), 12, {"nearest_demonstration": 1})
    task = EvaluationTask("new concept", "a", learned=("a",))
    real = real_of(task, domain, 4, examples.select("a"))
    assert list(real.values(states)) == ["novelty"]
    assert real.lines()[REPLAYED].values["novelty"] == 0
    assert FRESH not in real.lines()
    scale, whole = states.flatten(0, 1).std(dim=0), torch.full((3,), 12)
    expected = warped_distances(states / scale, whole, states / scale, whole)
    assert torch.allclose(domain.comparison.distance(states, states), expected)
    assert torch.allclose(domain.comparison.distance(states, states[:1]), expected[:, :1])


@pytest.mark.slow
def test_diversity_adds_rows_and_changes_none(log: Path, tiny: Path) -> None:
    invert(tiny, "--evaluation.diversity=false")
    more, before = read_rows(log), read_rows(Path("logs"))
    assert not {"novelty", "coverage"} & set(before["metric"])
    kept = more[~more["metric"].isin(["novelty", "coverage"]) & ~more["method"].isin([REPLAYED, FRESH])]
    assert kept.reset_index(drop=True).equals(before)  # configuration hashes too
    own = more[(more["metric"] == "novelty") & (more["role"] == "method")]
    assert set(own["setting"]) == {"training composition", "new concept"}
    assert (own["value"] > 0).all()
    assert set(more.loc[more["metric"] == "coverage", "setting"]) == {*own["setting"], "new + training", "training concept"}
    replayed = more[(more["method"] == REPLAYED) & (more["metric"] == "novelty")]
    assert replayed["value"].tolist() == [0] * 10
