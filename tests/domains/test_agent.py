"""Navigation: scenes, physics, expert, metrics."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from ftl_lightning.domains.agent import expert
from ftl_lightning.domains.agent import scenes as world
from ftl_lightning.domains.agent.domain import DOMAIN, act, progressed, reached
from ftl_lightning.domains.agent.environment import AgentEnvironment, bowl, cone
from ftl_lightning.domains.agent.expert import initial_states
from ftl_lightning.domains.agent.scenes import FEATURE, MAX_FORCE, MAX_STEPS, OBSERVED, REACH, STEP, pairs, parse, scenes, target
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.services.errors import UserError

SOURCE = DOMAIN.source(None)


@pytest.fixture(scope="module")
def environment() -> Iterator[AgentEnvironment]:
    """A simulator for all tests; each begins with a reset."""
    made = AgentEnvironment()
    yield made
    made.close()


def scene(right: tuple[float, float] = (1.0, -3.8), left: tuple[float, float] = (-1.0, -3.8)) -> Tensor:
    """A red bowl to the right, a red sphere to the left."""
    return torch.from_numpy(world.initial_state([("red", "bowl"), ("red", "sphere")], [right, left]))[None]


def test_the_grammar_and_that_a_scene_has_one_target() -> None:
    assert parse("go to red object").colour == "red"
    assert parse("go to red object").shape is None
    assert parse("go to bowl").shape == "bowl"
    for wrong in ("go to object", "go to blue bowl", "go to bowl red", "red bowl", ""):
        with pytest.raises(UserError, match="expected 'go to"):
            parse(wrong)
    with pytest.raises(UserError, match="expected one target in initial state 0, found 2"):
        target("go to red object", scene())
    with pytest.raises(UserError, match="found 0"):
        target("go to green cone", scene())


def test_pairs_are_the_papers_distractors_and_sixteen_of_pretraining_with_none_of_its_targets() -> None:
    for task, distractors in (
        ("go to red bowl", {("red", "cone"), ("red", "sphere"), ("purple", "bowl"), ("green", "bowl")}),
        ("go to yellow cube", {("yellow", "cone"), ("yellow", "sphere"), ("purple", "cube"), ("green", "cube")}),
        ("go to purple cone", {("purple", "bowl"), ("purple", "cube"), ("red", "cone"), ("yellow", "cone")}),
    ):
        assert {distractor for _, distractor in pairs(parse(task))} == distractors
    found = [pair for task in world.TRAINING_CONCEPTS for pair in pairs(parse(task))]
    assert len(set(found)) == 16
    seen = {look for pair in found for look in pair}
    assert {colour for colour, _ in seen} == set(world.COLOURS)
    assert {shape for _, shape in seen} == set(world.SHAPES)
    assert not seen & {(parse(task).colour, parse(task).shape) for task in DOMAIN.concepts.suites["paper"].goals}


@pytest.mark.parametrize("task", ["go to bowl", "go to purple cone"])
def test_scenes(task: str) -> None:
    drawn = scenes(task, 200, 0)
    assert drawn.shape == (200, 52)
    assert drawn.dtype == torch.float32
    places = world.object_positions(drawn)
    assert (places[:, 0, 0] >= 0).all()
    assert (places[:, 1, 0] <= 0).all()
    assert (places.abs()[..., 0] <= 1.66).all()
    assert ((places[..., 2] >= -4.355) & (places[..., 2] <= -3.257)).all()
    assert torch.linalg.vector_norm(places[:, 0] - places[:, 1], dim=-1).min() >= world.OBJECT_CLEARANCE
    assert torch.linalg.vector_norm(places - drawn[:, None, :3], dim=-1).min() >= world.AGENT_CLEARANCE - 1e-6
    chosen = target(task, drawn)
    assert 80 <= chosen.sum() <= 120
    counts = [sum(tuple(world.looks(row.tolist())) in (pair, pair[::-1]) for row in drawn) for pair in pairs(parse(task))]
    assert counts == [50] * 4
    assert torch.equal(drawn, scenes(task, 200, 0))
    assert torch.equal(drawn[:5], scenes(task, 5, 0))
    assert not torch.equal(drawn, scenes(task, 200, 1))


@pytest.mark.parametrize("mesh", [cone(0.1, 0.1), bowl(0.13, 0.1, 0.025)])
def test_bodies_are_closed_and_wound_outwards(mesh: tuple[list[list[float]], list[int]]) -> None:
    points = np.array(mesh[0])[np.array(mesh[1]).reshape(-1, 3)]
    volume = np.einsum("ij,ij->i", points[:, 0], np.cross(points[:, 1], points[:, 2])).sum() / 6
    assert 0 < volume < 0.3 * 0.3 * 0.2
    assert np.abs(points[..., 1]).max() == pytest.approx(0.1)


def test_a_picture_shows_the_scene_and_its_bowl_is_concave(environment: AgentEnvironment) -> None:
    environment.reset(options={"scene": scene()[0].numpy()})
    hit = environment.client.rayTest([1.0, 1.0, -3.8], [1.0, 0.0, -3.8])[0]
    assert hit[3][1] < 0.1  # a ray from above ends at the bottom of the bowl, not at its rim
    picture = environment.render().astype(int)
    red = (picture[..., 0] > 1.5 * picture[..., 1]) & (picture[..., 0] > 100)
    assert red[:, : picture.shape[1] // 2].sum() > 50
    assert red[:, picture.shape[1] // 2 :].sum() > 50


def run(environment: AgentEnvironment, actions: list[tuple[float, float]]) -> np.ndarray:
    """What is observed ``(time, 52)``."""
    seen = [environment.reset(options={"scene": scene()[0].numpy()})[0]]
    seen += [environment.step(np.array(action, dtype=np.float32))[0] for action in actions]
    return np.stack([one[OBSERVED] for one in seen])


def test_forces_move_the_agent_and_nothing_else_and_bodies_are_solid(environment: AgentEnvironment) -> None:
    still, glides = run(environment, [(0, 0)] * 10), run(environment, [(0.1, 0.05)] * 30)
    assert np.ptp(glides[:, 1]) < 1e-4  # it does not hop
    assert np.abs(glides[:, 8]).max() < 1e-4
    pushed = glides[:11]
    assert np.abs(still[-1, :3] - still[0, :3]).max() < 2e-3
    assert pushed[-1, 0] > 0.1
    assert pushed[-1, 2] - pushed[0, 2] == pytest.approx(pushed[-1, 0] / 2, rel=1e-3)
    assert np.abs(pushed[:, 3:7] - [0, 0, 0, 1]).max() < 1e-6
    assert (pushed[:, 13:] == pushed[0, 13:]).all()
    # A force in newtons that equals the way in metres LOOKAHEAD steps ahead holds a steady speed.
    assert pushed[-1, 7] == pytest.approx(0.1 / (world.LOOKAHEAD * STEP), rel=0.05)
    strong, limited = run(environment, [(5, 0)] * 3), run(environment, [(MAX_FORCE, 0)] * 3)
    assert strong[-1, 0] == pytest.approx(limited[-1, 0])
    seen = run(environment, [(MAX_FORCE, 0)] * 80)
    assert 0.15 < np.linalg.norm(seen[:, [0, 2]] - [1.0, -3.8], axis=-1).min() < 0.3  # it slides along the bowl, around it


def test_determinism_within_and_between_instances(environment: AgentEnvironment) -> None:
    first, second = environment, AgentEnvironment()
    rng = np.random.default_rng(0)
    actions = [tuple(action) for action in rng.uniform(-0.2, 0.2, (30, 2))]
    once = run(first, actions)
    run(second, [(0.2, 0.0)] * 50)
    assert np.array_equal(once, run(second, actions))
    assert np.array_equal(once, run(first, actions))
    assert np.array_equal(first.reset(seed=3)[0][OBSERVED], second.reset(seed=3)[0][OBSERVED])
    second.close()


def test_an_episode_ends_at_an_object_or_after_its_steps(environment: AgentEnvironment) -> None:
    environment.reset(options={"scene": scene()[0].numpy()})
    for _ in range(60):
        observation, _, terminated, truncated, _ = environment.step(np.array([0.1, 0.0], dtype=np.float32))
        if terminated:
            break
    assert terminated
    assert not truncated
    assert 1.0 - observation[OBSERVED][0] < REACH
    environment.reset(options={"scene": scene()[0].numpy()})
    ends = [environment.step(np.zeros(2, dtype=np.float32))[2:4] for _ in range(MAX_STEPS)]
    assert ends == [(False, False)] * (MAX_STEPS - 1) + [(False, True)]


def test_wrong_states_and_actions_and_a_simulator_that_does_not_start(
    environment: AgentEnvironment, monkeypatch: pytest.MonkeyPatch
) -> None:
    for initial, expected in (
        (np.zeros(51), "expected 52 numbers"),
        (scene((0.1, -3.8))[0].numpy(), "the agent and object 1 overlap"),
        (np.full(52, np.nan), "expected finite numbers"),
    ):
        with pytest.raises(UserError, match=expected):
            environment.reset(options={"scene": initial})
    environment.reset(seed=0)
    for action in (np.zeros(3), np.array([np.nan, 0])):
        with pytest.raises(UserError, match="expected 2 finite numbers"):
            environment.step(action)
    monkeypatch.setattr("pybullet.connect", lambda *_: -1)
    with pytest.raises(UserError, match="simulator does not start"):
        AgentEnvironment()


@pytest.mark.parametrize("count", [5, pytest.param(50, marks=pytest.mark.slow)])
def test_the_expert_reaches_its_target_in_99_of_100_scenes(count: int) -> None:
    tasks = ("go to red bowl", "go to purple cone", "go to bowl", "go to yellow object")
    drives = {task: SOURCE.draw(task, count, 7) for task in tasks}
    success = torch.cat([reached(task, episodes(made.observed[OBSERVED]))["success"] for task, made in drives.items()])
    assert len(success) == 4 * count
    assert success.float().mean() >= 0.99
    assert torch.cat([made.lengths for made in drives.values()]).max() < expert.LENGTH
    assert all(torch.equal(made.states[0, made.lengths[0] - 1], made.states[0, -1]) for made in drives.values())


def test_the_expert_drives_around_the_distractor() -> None:
    start, goal, distractor = np.array([0.0, 0.0]), np.array([2.0, 0.0]), np.array([1.0, 0.1])
    corners = expert.route(start, goal, distractor)
    way = np.stack([expert.along(corners, distance) for distance in np.linspace(0, 3, 200)])
    assert np.linalg.norm(way - distractor, axis=-1).min() > REACH
    assert np.linalg.norm(way[-1] - goal) == pytest.approx(expert.STOP)


def test_demonstrations_are_cached_and_repeat(monkeypatch: pytest.MonkeyPatch) -> None:
    first = SOURCE.draw("go to red bowl", 2, 0)
    assert first.states.shape == (2, 150, 13)
    assert first.per_step == (OBSERVED,)
    assert DOMAIN.observed == {OBSERVED: FEATURE}
    assert torch.equal(first.observed[OBSERVED][..., list(FEATURE.state)], first.states)
    assert first.scenes is not None
    assert torch.equal(first.scenes, first.observed[OBSERVED][:, 0])
    monkeypatch.setattr(expert, "_drive", lambda *_: pytest.fail("made again"))
    assert SOURCE.draw("go to red bowl", 2, 0).hash == first.hash


def plan_to(*places: tuple[float, float]) -> Tensor:
    """A plan ``(1, time, 13)`` through places."""
    states = torch.zeros(1, len(places), 13)
    states[0, :, [0, 2]] = torch.tensor(places)
    states[..., 1] = 0.102
    return states


def episodes(observations: Tensor) -> Rollout:
    """Episodes with these observations ``(episode, time, 52)``."""
    count = len(observations)
    return Rollout(initial_states(observations[:, 0]), {OBSERVED: observations}, torch.zeros(count, dtype=torch.bool), [{}] * count)


def observed(*places: tuple[float, float]) -> Tensor:
    """Observations ``(1, time, 52)`` of the same."""
    whole = scene()[:, None].repeat(1, len(places), 1)
    whole[..., :13] = plan_to(*places)
    return whole


def test_progress() -> None:
    for x, good in ((0.01, True), (-0.01, False), (0.9, True), (2.1, False), (1.99, True), (float("nan"), False)):
        plan = plan_to((-5.0, 0.0), (x, -3.806))  # only the end counts, against where the agent starts
        assert progressed("go to bowl", plan, initial_states(scene())).tolist() == [good]


@pytest.mark.parametrize(
    ("places", "success", "distractor"),
    [
        ([(0.0, -3.8), (1.0 - REACH + 0.001, -3.8)], True, False),
        ([(0.0, -3.8), (1.0 - REACH - 0.001, -3.8)], False, False),
        ([(0.0, -3.8), (-1.0 + REACH - 0.001, -3.8), (0.9, -3.8)], False, True),
        ([(0.0, -3.8), (-1.0 + REACH + 0.001, -3.8), (0.9, -3.8)], True, False),
        ([(0.0, -3.8), (0.9, -3.8), (0.0, -3.8)], False, False),
    ],
)
def test_reaching_the_target_first(places: list[tuple[float, float]], success: bool, distractor: bool) -> None:
    outcome = reached("go to bowl", episodes(observed(*places)))
    assert (outcome["success"].item(), outcome["distractor"].item()) == (success, distractor)


def test_actions_point_to_the_plan_five_steps_ahead() -> None:
    plan = plan_to(*((0.1 * step, -3.8) for step in range(20)))
    for step, ahead in ((0, 0.5), (3, 0.8), (19, 1.9)):
        assert act(plan, step, {OBSERVED: observed((0.0, -3.8))[:, 0]})[0].tolist() == pytest.approx([ahead, 0.0])


def test_references_stand_where_they_must() -> None:
    initial = initial_states(scenes("go to red bowl", 20, 0))
    rate = {
        name: progressed("go to red bowl", draw("go to red bowl", 20, initial, 0), initial).float().mean().item()
        for name, draw in DOMAIN.comparison.references.items()
    }
    assert rate["expert (oracle)"] == 1.0
    assert 0.2 < rate["random object"] < 0.8
    assert 0.2 < rate["nearest object"] < 0.8


def test_entities_are_columns_of_position_colour_and_shape() -> None:
    first, second = (scene()[0][list(columns)] for columns in FEATURE.entities)
    assert first[:3].tolist() == pytest.approx([1.0, 0.102, -3.8])
    assert torch.equal(first[3:7], second[3:7])
    assert [world.SHAPES[int(one[-4:].argmax())] for one in (first, second)] == ["bowl", "sphere"]
    assert len(set(itertools.chain(*FEATURE.entities))) == 22
    assert torch.equal(first[list(FEATURE.attributes)], first[3:])  # colour and shape
