"""The table-top: scenes, physics, success rules, experts, demonstrations and closed loop."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.tabletop import DOMAIN, WIDE, experts, interface, source
from ftl_lightning.domains.tabletop import scenes as layout
from ftl_lightning.domains.tabletop.domain import act, judge
from ftl_lightning.domains.tabletop.environment import TableTopEnvironment, judged
from ftl_lightning.domains.tabletop.experts import Manner, around, pushed
from ftl_lightning.domains.tabletop.interface import (
    ACTION,
    AROUND_BOWL,
    FEATURES,
    IMAGE,
    POSE,
    PUSH,
    PUSH_ON_BOOK,
    PUSH_TO_BOWL,
    TASKS,
    TO_BOOK,
    TO_TRIANGLE,
    TO_WHITE,
)
from ftl_lightning.domains.tabletop.scenes import BOOK, BOWL, CIRCLE, TRIANGLE, WHITE, gap, outline, scene_of, scenes, within
from ftl_lightning.domains.tabletop.world import COLOUR
from ftl_lightning.evaluation.closed_loop import PlanFollower, fixed_plans, roll_out
from ftl_lightning.networks.text_encoder import load_encoder
from ftl_lightning.services.errors import UserError
from tests.conftest import succeed

assert DOMAIN.closed_loop is not None
LOOP = DOMAIN.closed_loop
APART = {CIRCLE: (0.45, 0.0, 0.0), TRIANGLE: (0.60, 0.0, 0.0)}


@pytest.fixture(scope="module")
def env() -> Iterator[TableTopEnvironment]:
    """A simulator for all tests; each begins with a reset."""
    made = TableTopEnvironment()
    yield made
    made.close()


def test_outlines() -> None:
    circle, triangle = outline(CIRCLE, 0, 0, 0), outline(TRIANGLE, 0, 0, 0.3)
    assert np.linalg.norm(triangle[0] - triangle[1]) == pytest.approx(0.07)
    assert gap(circle, circle + np.array([0.06, 0])) == pytest.approx(0.01, abs=5e-4)
    assert gap(outline(BOOK, 0, 0, 0), outline(BOOK, 0.2, 0, 0)) == pytest.approx(-0.02)
    turned = outline(BOOK, 0, 0, math.pi / 2)
    assert np.abs(turned).max(axis=0).tolist() == pytest.approx([0.08, 0.11])
    assert within(circle, turned)
    assert not within(circle + np.array([0.07, 0]), turned)


@pytest.mark.parametrize("task", TASKS)
def test_scenes_of_a_task_can_be_built_and_repeat(task: str) -> None:
    drawn = scenes(task, 2, 3)
    assert drawn.shape == (2, layout.SCENE)
    assert torch.equal(drawn[:1], scenes(task, 1, 3))
    assert not torch.equal(drawn[:1], scenes(task, 1, 4))
    for scene in drawn.numpy():
        assert layout.check(scene) is not None
        assert layout.support(scene, CIRCLE) == (0.03 if task == PUSH_ON_BOOK else 0.0)


def test_objects_that_a_task_does_not_need_are_there_too_and_every_description_has_an_embedding() -> None:
    present = {task: scenes(task, 12, 0)[:, 0:20:4].mean(dim=0) for task in (PUSH, TO_BOOK, TO_WHITE)}
    assert all((0.1 < present[PUSH][number] < 0.95) for number in (2, 3, 4))
    assert present[TO_BOOK][1] > 0.1
    assert present[TO_WHITE][2] > 0.1
    for domain in (DOMAIN, WIDE):
        texts = domain.concepts.descriptions
        assert len(load_encoder("table", domain.concepts.table)(texts)) == len(texts)
    assert set(DOMAIN.concepts.descriptions) | set(WIDE.concepts.descriptions) == set(TASKS)


def test_bad_scenes_and_actions_and_no_simulator_are_told(env: TableTopEnvironment, monkeypatch: pytest.MonkeyPatch) -> None:
    for scene, expected in (
        (np.zeros(23), r"expected 24 numbers, found shape \(23,\)"),
        (np.full(24, np.nan), "expected finite numbers"),
        (np.full(24, 0.5), "green circle, present: expected 1, found 0.5"),
        (scene_of({TRIANGLE: (0.5, 0, 0)}), "green circle, present: expected 1, found 0"),
        (scene_of({CIRCLE: (0.45, 0, 0), TRIANGLE: (0.47, 0, 0)}), "green circle and orange triangle overlap"),
        (scene_of({CIRCLE: (0.45, 0, 0), BOOK: (0.57, 0, 0)}), "green circle and book overlap"),
        (scene_of({CIRCLE: (0.45, 0, 0), WHITE: (0.45, 0, 0)}), "green circle and white surface overlap"),
        (scene_of({CIRCLE: (0.45, 0.3, 0)}), r"green circle leaves the workspace: expected y -0.24..0.24, found 0.300"),
        (scene_of({CIRCLE: (0.45, 0, 0), BOWL: (0.77, 0, 0)}), r"purple bowl leaves the workspace: expected x 0.22..0.78"),
        (scene_of({CIRCLE: (0.45, 0, 0)}, (0.42, 0, 0.5, 0)), r"hand: expected z 0.17..0.23, found 0.500"),
    ):
        with pytest.raises(UserError, match=expected) as told:
            env.reset(options={"scene": scene})
        assert "\n" not in str(told.value)
    env.reset(options={"scene": scene_of(APART)})
    for action in (np.zeros(3), np.full(4, np.nan)):
        with pytest.raises(UserError, match=f"expected {ACTION} finite numbers"):
            env.step(action)
    monkeypatch.setattr("pybullet.connect", lambda *_: -1)
    with pytest.raises(UserError, match="table-top: the physics simulator does not start"):
        TableTopEnvironment()


def _run(env: TableTopEnvironment, scene: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    env.reset(options={"scene": scene})
    for action in actions:
        seen, *_, told = env.step(action)
    return np.stack(told["trace"]), seen[IMAGE]


def test_an_episode_is_a_function_of_scene_and_actions() -> None:
    first, second = TableTopEnvironment(), TableTopEnvironment()
    scene = scene_of(APART)
    places = [(0.42 + 0.012 * step, 0.002 * step, max(0.2 - 0.02 * step, 0.014), 0.0) for step in range(15)]
    actions = np.array(places, dtype=np.float32)
    trace, image = _run(first, scene, actions)
    _run(second, scenes(AROUND_BOWL, 1, 0)[0].numpy(), actions[:10])
    again, same = _run(second, scene, actions)
    assert np.array_equal(trace, again)
    assert np.array_equal(image, same)
    first._built = 200  # its simulator is started anew
    assert np.array_equal(trace, _run(first, scene, actions)[0])
    first.close()
    second.close()


def test_the_hand_goes_where_it_is_told_and_objects_rest(env: TableTopEnvironment) -> None:
    scene = scene_of({**APART, BOOK: (0.5, 0.2, 0.1), WHITE: (0.4, -0.2, 0), BOWL: (0.6, -0.2, 0)})
    seen, told = env.reset(options={"scene": scene})
    assert seen[POSE][:3] == pytest.approx([0.42, 0, 0.2], abs=1e-3)
    first = told["trace"][0]
    for _ in range(12):
        seen, *_, told = env.step(np.array([0.5, 0.1, 0.15, 0.0], dtype=np.float32))
    assert seen[POSE][:3] == pytest.approx([0.5, 0.1, 0.15], abs=3e-3)
    assert seen[POSE][7] < 0.01
    assert np.abs(told["trace"][-1][9:] - first[9:]).max() < 1e-3
    assert not any(told[name] for name in ("touched", "lifted", "released"))
    assert seen[IMAGE].shape == (3, 64, 64)
    assert seen[IMAGE].dtype == np.uint8


def test_the_camera_sees_the_objects_and_not_the_arm(env: TableTopEnvironment) -> None:
    image = env.reset(options={"scene": scene_of({CIRCLE: (0.45, 0.1, 0)})})[0][IMAGE].astype(int)
    green = (image[1] > image[0] + 40) & (image[1] > image[2] + 40)
    rows, columns = green.nonzero()
    assert 10 < len(rows) < 60
    assert (rows.mean(), columns.mean()) == (pytest.approx(32 + 0.05 * 91, abs=2), pytest.approx(32 - 0.1 * 91, abs=2))
    assert image.min(axis=0).max() <= 190  # nothing is as bright as the arm


def _told(circle: tuple[float, float, float], **more: Any) -> dict[str, Any]:
    places = {"circle": np.array(circle), "triangle": np.array([0.6, 0.0, 0.015]), "book place": np.array([0.5, 0.1, 0.015])}
    return {**places, "book": 0.0, "touched": False, "lifted": True, "released": True, **more}


PLACED = scene_of(
    {CIRCLE: (0.4, -0.1, 0), BOOK: (0.5, 0.1, 0), WHITE: (0.6, -0.15, 0), BOWL: (0.45, -0.2, 0), TRIANGLE: (0.6, 0, 0)}
)

JUDGED = [
    (TO_BOOK, _told((0.5, 0.1, 0.045)), True),
    (TO_BOOK, _told((0.5, 0.19, 0.045)), False),
    (TO_BOOK, _told((0.5, 0.1, 0.015)), False),
    (TO_BOOK, _told((0.5, 0.1, 0.045), released=False), False),
    (TO_BOOK, _told((0.5, 0.1, 0.045), lifted=False), False),
    (TO_WHITE, _told((0.65, -0.15, 0.075)), True),
    (TO_WHITE, _told((0.68, -0.15, 0.075)), False),
    (interface.BESIDE_BOWL, _told((0.55, -0.2, 0.015)), True),
    (interface.BESIDE_BOWL, _told((0.61, -0.2, 0.015)), False),
    (interface.BESIDE_BOOK, _told((0.5, -0.11, 0.015)), True),
    (interface.BESIDE_BOOK, _told((0.5, -0.15, 0.015)), False),
    (interface.TO_BOWL, _told((0.46, -0.19, 0.02)), True),
    (interface.TO_BOWL, _told((0.46, -0.19, 0.06)), False),
    (interface.TO_BOWL, _told((0.5, -0.2, 0.02)), False),
    (interface.TO_TRIANGLE, _told((0.6, 0.01, 0.045)), True),
    (interface.TO_TRIANGLE, _told((0.6, 0.01, 0.015)), False),
    (interface.LIFT, _told((0.6, 0, 0.14), released=False), True),
    (interface.LIFT, _told((0.6, 0, 0.14)), False),
    (interface.LIFT, _told((0.6, 0, 0.05), released=False), False),
    (PUSH, _told((0.55, 0, 0.015), touched=True), True),
    (PUSH, _told((0.55, 0, 0.015)), False),
    (PUSH, _told((0.55, 0, 0.045), touched=True), False),
    (PUSH_ON_BOOK, _told((0.55, 0, 0.045), touched=True, triangle=np.array([0.6, 0, 0.045])), True),
    (PUSH_ON_BOOK, _told((0.55, 0, 0.015), touched=True), False),
    (PUSH, {}, False),
]


@pytest.mark.parametrize(("task", "told", "expected"), JUDGED)
def test_success_is_judged_by_poses(task: str, told: dict[str, Any], expected: bool) -> None:
    assert judged(task, PLACED, told) is expected


def test_a_moved_book_is_told_and_a_failed_episode_is_no_success() -> None:
    infos = [_told((0.55, 0, 0.015), touched=True), _told((0.55, 0, 0.015), touched=True, book=0.021), {}]
    starts = InitialStates({}, torch.from_numpy(np.stack([PLACED] * 3)))
    found = judge(PUSH, Rollout(starts, {}, torch.tensor([True, False, False]), infos))
    assert found["success"].tolist() == [False, True, False]
    assert found["book moved"].tolist() == [False, True, False]


SOME = [PUSH, *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS if task != PUSH)]


@pytest.mark.parametrize("task", SOME)
def test_experts_succeed(task: str, env: TableTopEnvironment) -> None:
    scene = scenes(task, 1, 11)[0].numpy()
    episode = source.perform(env, task, scene, np.random.default_rng(0))
    assert episode.success
    assert episode.commands[0].tolist() == pytest.approx([*scene[layout.HAND][:3], 0.08])
    assert np.linalg.norm(np.diff(episode.commands[:, :3], axis=0), axis=-1).max() < 0.0201
    assert np.median(np.abs(episode.commands[:, :3] - episode.poses[:, :3])) < 0.005
    assert len(episode.images) == len(episode.commands)


@pytest.mark.slow
def test_coupled_fingers_hold_the_circle_in_place_and_objects_lie_under_it_in_pictures() -> None:
    drift, under = {}, {}
    for coupled in (False, True):
        env = TableTopEnvironment(coupled=coupled)
        scene = scenes(TO_TRIANGLE, 1, 77)[0].numpy()
        held = source.perform(env, TO_TRIANGLE, scene, np.random.default_rng([5, 0]))
        circle = np.stack(env._trace)[:, 9:12]
        lifted = circle[:, 2] > 0.1
        drift[coupled] = float(np.ptp((circle[:, :2] - held.poses[: len(circle), :2])[lifted], axis=0).max())
        scattered = source.perform(
            env, TO_BOOK, scene_of({**APART, BOOK: (0.58, -0.15, 0.0)}), np.random.default_rng(0), scatter=True
        )
        env.close()
        assert scattered.places is not None
        apart = np.linalg.norm(scattered.places[:, 1, 1:3] - scattered.places[:, 0, 1:3], axis=-1)
        under[coupled] = bool(((apart < 0.03) & (scattered.places[:, 1, 0] > 0) & (scattered.places[:, 0, 3] > 0.1)).any())
    assert drift[True] < 0.005
    assert drift[False] > 0.015
    assert under == {False: False, True: True}


@pytest.mark.slow
def test_pushing_at_the_height_of_the_table_moves_the_book(env: TableTopEnvironment) -> None:
    scene = scenes(PUSH_ON_BOOK, 1, 1)[0].numpy()
    assert not source.perform(env, PUSH_ON_BOOK, scene, np.random.default_rng(0), height=experts.PUSH_HEIGHT).success
    assert env._info()["book"] > 0.02


@pytest.mark.parametrize("task", SOME)
def test_tasks_begin_anew_wherever_hand_and_circle_are(task: str, env: TableTopEnvironment) -> None:
    sides = []
    for number, scene in enumerate(scenes(task, 5, 21).numpy()):
        env.reset(options={"scene": scene})
        before = env.places()[CIRCLE]
        seen = experts.led_astray(env, task, np.random.default_rng([2, number]))
        hand, circle = env.command[:2], env.places()[CIRCLE]
        assert seen[POSE][:3] == pytest.approx(env.command[:3], abs=2e-3)
        assert 0 <= np.linalg.norm(hand - circle[:2]) <= experts.AROUND[1] + 1e-6
        assert circle[2] == pytest.approx(before[2], abs=1e-3)
        sides.append(hand - circle[:2])
        if not number:
            assert source.perform(env, task, scene, np.random.default_rng([2, number]), begin=experts.led_astray).success
    assert np.ptp(sides, axis=0).min() > 0.03


HELD = Manner(height=0.014, speed=0.008)


@pytest.mark.parametrize(
    ("hand", "goes"),
    [
        ((0.40, 0.0, 0.014), (1, 0, 0)),  # behind: it pushes
        ((0.41, 0.02, 0.014), (1, -1, 0)),  # a little to the left of the line: it steers back behind
        ((0.41, -0.02, 0.014), (1, 1, 0)),
        ((0.50, 0.0, 0.014), (0, 0, 1)),  # before the circle: up, and nowhere else
        ((0.45, 0.05, 0.014), (0, 0, 1)),
        ((0.50, 0.0, 0.079), (-1, 0, 0)),  # high enough: back over the circle
        ((0.385, 0.0, 0.079), (0, 0, -1)),  # where a push begins: down
        ((0.30, 0.0, 0.20), (1, 0, -1)),  # from afar
    ],
)
def test_a_hand_pushes_behind_the_circle_and_goes_up_elsewhere(hand: tuple[float, ...], goes: tuple[int, ...]) -> None:
    step = pushed(np.array(hand), np.array([0.45, 0.0]), np.array([0.6, 0.0]), HELD) - hand
    assert np.where(np.abs(step) < 5e-4, 0, np.sign(step)).tolist() == list(goes)
    assert np.linalg.norm(step) < 0.02


def test_the_way_around_the_bowl_keeps_its_distance_and_ends_at_the_goal() -> None:
    bowl, goal = np.array([0.5, 0.01]), np.array([0.65, 0.0])
    circle, nearest = np.array([0.35, 0.0]), []
    for _ in range(200):
        step = around(circle, goal, bowl) - circle
        circle = circle + 0.004 * step / max(np.linalg.norm(step), 1e-6)
        nearest.append(np.linalg.norm(circle - bowl))
    assert min(nearest) > layout.RING - 0.012
    assert np.linalg.norm(circle - goal) < 0.01
    assert around(np.array([0.6, 0.0]), goal, bowl).tolist() == goal.tolist()  # the bowl is behind it
    assert around(np.array([0.35, 0.2]), np.array([0.65, 0.2]), bowl).tolist() == [0.65, 0.2]  # beside it


@pytest.mark.slow
def test_distractors_lie_elsewhere_in_each_picture_and_nothing_else_changes(env: TableTopEnvironment) -> None:
    scene = scene_of({**APART, BOOK: (0.4, -0.2, 0.0), BOWL: (0.62, 0.2, 0.0)})
    plain, scattered, again = (
        source.perform(env, PUSH, scene, np.random.default_rng(3), scatter=scatter) for scatter in (False, True, True)
    )
    assert (plain.commands == scattered.commands).all()
    assert (plain.poses == scattered.poses).all()
    assert (scattered.images == again.images).all()
    assert scattered.images.shape == plain.images.shape

    def seen(images: np.ndarray, name: str) -> np.ndarray:
        """Pixels of an object's colour ``(time, 64, 64)``."""
        colour = np.array(COLOUR[name])[:, None, None]
        light = images.max(axis=1, keepdims=True) / 255  # faces differ by how much light they get
        return (np.abs(images / 255 / np.maximum(light, 0.01) - colour / colour.max()) < 0.12).all(axis=1) & (light[:, 0] > 0.2)

    for name in (CIRCLE, TRIANGLE):
        assert (seen(plain.images, name) == seen(scattered.images, name)).mean() > 0.999
        assert seen(plain.images, name).any(axis=(1, 2)).all()
    assert seen(plain.images, BOOK).all(axis=0).sum() > 50
    assert seen(scattered.images, BOOK).all(axis=0).sum() == 0
    assert 0.4 < seen(scattered.images, BOOK).any(axis=(1, 2)).mean() < 0.95


def test_training_sets_are_scattered_and_demonstrations_of_a_task_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    expert, still, images = DOMAIN.source(None), np.zeros((2, 12), np.float32), np.zeros((2, *FEATURES[IMAGE].shape), np.uint8)
    nothing = source.Episode(still[:, :4], still[1:, :4], images, still[:, 4:], success=True)
    made = source.joined_episodes(PUSH_ON_BOOK, [nothing], None, {})
    monkeypatch.setattr(source, "cached", lambda settings, *_: drawn.append(settings) or made)
    expert.split("train", 2, 0)
    expert.draw(PUSH, 2, 0)
    assert [(one["count"], one["scatter"]) for one in drawn] == [(2, True), (2, True), (8, True), (2, True), (2, False)]
    drawn.clear()
    expert.recoveries("train", 3, 0)
    expert.recoveries("validation", 3, 0)
    assert [(one["task"], one["count"], one["scatter"], one["elsewhere"]) for one in drawn] == 2 * [
        (PUSH, 3, True, True),
        (AROUND_BOWL, 3, True, True),
    ]
    assert len({one["seed"] for one in drawn}) == 2


def test_scattered_pictures_tell_what_is_where_and_the_triangle_lies_on_all_surfaces(env: TableTopEnvironment) -> None:
    around_it = {BOOK: (0.58, -0.15, 0.0), WHITE: (0.6, 0.15, 0.0), BOWL: (0.42, 0.2, 0.0), TRIANGLE: (0.42, 0.08, 0)}
    placed = {CIRCLE: (0.4, -0.1, 0.0), **around_it}
    made = source.perform(env, TO_BOOK, scene_of(placed), np.random.default_rng(0), scatter=True)
    assert made.places is not None
    assert made.places.shape == (len(made.images), 5, 4)
    seen, x, y, z = torch.from_numpy(made.places).unbind(dim=-1)
    circle, triangle, book, white, bowl = range(5)
    assert seen[:, [circle, book]].all()
    for distractor in (triangle, white, bowl):
        assert 0.3 < seen[:, distractor].mean() < 0.95
    heights = z[:, triangle][seen[:, triangle] > 0.5]
    assert set(heights.mul(1000).round().tolist()) == {15, 45, 75}
    assert ((x - 0.5).abs() < 0.35)[seen > 0.5].all()
    assert (y.abs() < 0.36)[seen > 0.5].all()


def test_demonstrations_with_images_go_through_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    succeed("generate", "tabletop", "--task", PUSH_ON_BOOK, "--count", "1", "--out", "demos.safetensors")
    read = Demonstrations.load("demos.safetensors")
    assert {name: (one.shape, one.kind) for name, one in read.features.items()} == {
        name: (one.shape, one.kind) for name, one in DOMAIN.observed.items()
    }
    assert read.observed[IMAGE].dtype == torch.uint8
    assert read.states.shape[2] == ACTION
    assert read.scenes is not None
    monkeypatch.setattr(source, "perform", lambda *_, **__: pytest.fail("made again"))
    assert DOMAIN.source(None).draw(PUSH_ON_BOOK, 1, 0).hash == read.hash
    # What is seen in the beginning is what the environment shows in the same scene.
    starts = source.initial_states(read.scenes)
    assert torch.equal(starts.observed[IMAGE], read.observed[IMAGE][:, 0])
    assert torch.equal(starts.observed[POSE], read.observed[POSE][:, 0])


def test_hand_made_plans_in_closed_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftl_lightning.domains.tabletop.rendering.FRAMES", 5)
    starts = source.initial_states(torch.from_numpy(np.stack([scene_of(APART)] * 2)))
    push = [(0.39, 0.0, 0.06)] * 9 + [(0.39, 0.0, 0.014)] * 4 + [(0.39 + 0.01 * step, 0.0, 0.014) for step in range(40)]
    plan = torch.tensor([(*place, 0.0) for place in push])
    still = plan[:1].repeat(len(plan), 1)
    follower = PlanFollower(fixed_plans(torch.stack([plan, still])), act, 200)
    rollout = roll_out(replace(LOOP, steps=60), starts, follower)
    assert DOMAIN.judge(PUSH, rollout)["success"].tolist() == [True, False]
    assert set(rollout.observed) == {POSE}
    assert LOOP.film is not None
    frames = LOOP.film(rollout.take(0, 1), torch.stack(follower.followed[0]))
    assert len(frames) == 5
    assert frames[0].shape == (240, 320, 3)
    assert (frames[0] == (255, 0, 90)).all(axis=-1).any()  # the plan
    figure = DOMAIN.show.picture(torch.stack([plan, still]), [True, False], "two plans", starts)
    assert len(figure.axes) == 2


@pytest.mark.slow
def test_reference_lines() -> None:
    starts = DOMAIN.source(None).starts(PUSH_ON_BOOK, 1, 1)
    assert starts is not None
    expert = LOOP.policies["expert (oracle)"](PUSH_ON_BOOK, starts, None, 0)
    assert expert is not None
    assert DOMAIN.judge(PUSH_ON_BOOK, roll_out(LOOP, starts, expert))["success"].all()
    assert LOOP.policies["table-height push"](PUSH, starts, None, 0) is None
    assert LOOP.policies["straight push"](TO_BOOK, starts, None, 0) is None


@pytest.mark.slow
def test_an_experts_actions_come_to_the_same_in_another_simulation(env: TableTopEnvironment) -> None:
    other = TableTopEnvironment()
    scene = scenes(AROUND_BOWL, 1, 3)[0].numpy()  # long, and the hand slips farther than it can go
    episode = source.perform(other, AROUND_BOWL, scene, np.random.default_rng([0, 0]))
    env.reset(options={"scene": scene})
    told = [env.step(action)[-1] for action in episode.actions][-1]
    assert judged(AROUND_BOWL, scene, told) == episode.success
    assert (np.stack(env._trace) == np.stack(other._trace)).all()
    other.close()


@pytest.mark.slow
def test_the_wide_domain_draws_its_own_and_ends_at_any_touch() -> None:
    assert WIDE.closed_loop is not None
    source_ = WIDE.source(None)
    made = source_.draw(PUSH_TO_BOWL, 1, 0)
    assert made.domain == WIDE.name
    assert made.scenes is not None
    env = WIDE.closed_loop.environment()
    env.reset(options={"scene": made.scenes[0].numpy()})
    ended = [env.step(action.numpy())[2:] for action in made.states[0, 1:]]
    env.close()
    assert any(terminated for terminated, *_ in ended)
    assert ended[-1][-1]["touches"] == {BOWL}
    assert judged(PUSH_TO_BOWL, made.scenes[0].numpy(), ended[-1][-1])
    assert not judged(PUSH, made.scenes[0].numpy(), ended[-1][-1])
    assert [int(columns.start) for columns in layout.COLUMNS.values()] == [0, 4, 8, 12, 16]
