"""Driving: scenarios, the faster simulation, save and restore, expert, planner."""

import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from highway_env import utils
from highway_env.vehicle.behavior import IDMVehicle

from ftl_lightning.domains.driving import expert, traffic
from ftl_lightning.domains.driving.environment import DrivingEnvironment
from ftl_lightning.domains.driving.fast import _apart
from ftl_lightning.domains.driving.scenarios import SCENARIOS, advance, arrived, make, observe, restore, save
from ftl_lightning.domains.driving.traffic import (
    BARRIER,
    FIRST_EXIT,
    NAMES,
    OBSERVED,
    PRACTICE,
    RULES,
    SCENARIO,
    SCENE,
    STEP,
    TRAFFIC,
    decision_seconds,
    origin,
    scene,
    training_set,
)
from ftl_lightning.services.errors import UserError


def slow(*names: str) -> list[Any]:
    """Scenarios that only a full run looks at."""
    return [pytest.param(name, marks=pytest.mark.slow) for name in names]


SIMULATED = ["merge", "intersection", *slow(*(name for name in SCENARIOS if name not in ("merge", "intersection")))]


def places(env: object) -> np.ndarray:
    return np.array([vehicle.position for vehicle in env.road.vehicles])  # type: ignore[attr-defined]


def start(name: str, seed: int = 0, fast: bool = True) -> object:
    env = make(name, fast)
    env.reset(seed=seed)
    return env


def test_scenarios_are_known_without_the_simulator_and_the_exit_is_entered_from_any_lane() -> None:
    assert tuple(SCENARIOS) == NAMES
    for name, found in SCENARIOS.items():
        assert decision_seconds(name) == 1 / (found.environment.default_config() | found.config)["policy_frequency"]
    with pytest.raises(UserError, match="expected one of highway, exit, merge"):
        make("motorway")
    env = make("exit")
    lanes = set()
    for seed in range(14):
        env.reset(seed=seed)
        lanes.add(env.vehicle.lane_index[2])
    assert lanes == {0, 1, 2, 3}


@pytest.mark.parametrize("name", SIMULATED)
def test_the_seed_decides_an_episode(name: str) -> None:
    first, again, other = start(name, 3), start(name, 3), start(name, 4)
    for env in (first, again, other):
        assert not arrived(env, name)  # nobody starts where a scenario ends
        env.step(1)
    assert np.array_equal(places(first), places(again))
    assert places(first).shape != places(other).shape or not np.array_equal(places(first), places(other))
    assert np.isfinite(observe(first)).all()


def test_no_state_leaks_from_one_scenario_to_the_next() -> None:
    before = {name: value for name, value in vars(IDMVehicle).items() if name.isupper()}
    alone = start("merge")
    alone.step(1)
    start("intersection").step(1)
    after = start("merge")
    after.step(1)
    assert np.array_equal(places(alone), places(after))
    assert {name: value for name, value in vars(IDMVehicle).items() if name.isupper()} == before


@pytest.mark.parametrize("name", SIMULATED)
@pytest.mark.parametrize(("seeds", "decisions"), [pytest.param((0,), 10, marks=pytest.mark.slow), ((2,), 3)], ids=["many", "few"])
def test_the_faster_simulation_is_the_published_one(name: str, seeds: tuple[int, ...], decisions: int) -> None:
    draw = np.random.default_rng(0)
    for seed in seeds:
        fast, published = start(name, seed), start(name, seed, fast=False)
        for _ in range(min(decisions, 4) if name == "highway" else decisions):
            decision = int(draw.integers(fast.action_space.n))
            seen, reward, ended, late, _ = fast.step(decision)
            expected, expected_reward, expected_end, expected_late, _ = published.step(decision)
            np.testing.assert_allclose(seen, expected, atol=1e-4)
            np.testing.assert_allclose(places(fast), places(published), atol=1e-6)
            assert (round(reward, 6), ended, late) == (round(expected_reward, 6), expected_end, expected_late)
            np.testing.assert_array_equal(observe(fast), fast.observation_type.observe())
            if ended or late:
                break


def test_vehicles_that_are_apart_do_not_collide_in_the_published_test() -> None:
    draw, apart = np.random.default_rng(0), 0
    road = start("merge").road
    for _ in range(2_000):
        one, other = (IDMVehicle(road, draw.uniform(-5, 5, 2), draw.uniform(-np.pi, np.pi), draw.uniform(0, 30)) for _ in range(2))
        moves = one.velocity / 15, other.velocity / 15
        touching, will_touch, _ = utils.are_polygons_intersecting(one.polygon(), other.polygon(), *moves)
        assert _apart(one, other, 1 / 15) == (not touching and not will_touch)
        apart += not will_touch
    assert 200 < apart < 1_800


@pytest.mark.parametrize("name", SIMULATED)
def test_save_and_restore_are_exact(name: str) -> None:
    env = start(name, 1)
    advance(env, 1)
    saved, draw = save(env), np.random.default_rng(0)
    futures = [draw.integers(env.action_space.n, size=3).tolist() for _ in range(4)]

    def go(decisions: list[int]) -> list[tuple[float, bool, bytes, bytes]]:
        restore(env, saved)
        found = []
        for decision in decisions:
            reward, ended = advance(env, decision)
            found.append((reward, ended, places(env).tobytes(), observe(env).tobytes()))
            if ended:
                break
        return found

    first = [go(future) for future in futures]
    assert [go(future) for future in reversed(futures)] == first[::-1]
    assert len({str(one) for one in first}) > 1


SHORT = 8
"""Decisions that an expert simulates who searches a tenth as much, which is enough here."""


@pytest.mark.parametrize(("name", "budget"), [("roundabout", SHORT), pytest.param("merge", 75, marks=pytest.mark.slow)])
def test_the_expert_arrives(name: str, budget: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(expert.SEARCH, name, replace(expert.SEARCH[name], budget=budget))
    env = make(name)
    seen, succeeded = expert.drive(name, 1, env)
    assert succeeded
    assert arrived(env, name)
    assert not env.vehicle.crashed
    assert seen.shape[1:] == (5, 7)


def test_an_expert_drives_the_same_again_and_planning_leaves_the_simulation_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(expert.SEARCH, "roundabout", replace(expert.SEARCH["roundabout"], budget=3))
    assert np.array_equal(expert.drive("roundabout", 1)[0], expert.drive("roundabout", 1)[0])
    monkeypatch.setitem(expert.SEARCH, "roundabout", replace(expert.SEARCH["roundabout"], budget=SHORT))
    env = start("roundabout")
    before, random = places(env), env.np_random.bit_generator.state
    assert expert.plan(env, "roundabout") == expert.plan(env, "roundabout")
    assert np.array_equal(places(env), before)
    assert env.np_random.bit_generator.state == random
    assert env.config["simulation_frequency"] == 15


def scene_of(name: str, seed: int) -> np.ndarray:
    """The scene ``(37,)`` that a scenario and a seed lead to."""
    return scene(observe(start(name, seed)), name, seed)


def follow(actions: list[np.ndarray], seed: int = 0) -> tuple[np.ndarray, dict[str, float]]:
    """Traffic ``(time, 35)`` in the roundabout and how it ended."""
    env = DrivingEnvironment(STEP)
    seen, info = [env.reset(options={"scene": scene_of("roundabout", seed)})[0][TRAFFIC]], {}
    for action in actions:
        observation, _, ended, late, info = env.step(action)
        seen.append(observation[TRAFFIC])
        if ended or late:
            break
    env.close()
    return np.stack(seen), info


def test_the_planner_does_what_the_expert_did(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(expert.SEARCH, "roundabout", replace(expert.SEARCH["roundabout"], budget=SHORT))
    seen, succeeded = expert.drive("roundabout", 5)
    assert succeeded
    driven, info = follow(list(seen[1:, 0]), seed=5)
    np.testing.assert_allclose(driven, seen.reshape(len(seen), -1), atol=1e-4)
    assert info["arrived"]
    assert info["passed"]
    assert not info["crashed"]
    assert info["length"] == len(seen) - 1


def test_the_planner_takes_what_comes_nearest_without_a_crash() -> None:
    fast, slow = (np.array([1, 0, y, 0, 0, 0, 0]) for y in (-999.0, 999.0))
    ahead, behind = follow([fast] * 3)[0], follow([slow] * 3)[0]
    assert ahead[-1, 2] < behind[-1, 2] - 3  # farther up the page
    quick, gentle = (np.array([metres, 0, metres, 0]) for metres in (99.0, 0.0))  # as drives, on whatever road
    assert np.array_equal(follow([quick] * 3)[0], ahead)
    assert np.array_equal(follow([gentle] * 3)[0], behind)
    idle = follow([np.array([1.0])] * 3)[0]
    assert behind[-1, 2] >= idle[-1, 2] - 1e-3


def test_an_episode_repeats_and_starts_where_its_numbers_say() -> None:
    first, again = follow([np.array([3.0])] * 4, seed=9)[0], follow([np.array([3.0])] * 4, seed=9)[0]
    assert np.array_equal(first, again)
    env, other = DrivingEnvironment(), DrivingEnvironment()
    given = scene_of("roundabout", 9)
    seen, _ = env.reset(options={"scene": given})
    assert np.array_equal(seen[TRAFFIC], first[0])
    assert np.array_equal(given[:OBSERVED], first[0])
    assert seen[SCENARIO].tolist() == [NAMES.index("roundabout")]
    other.reset(options={"scene": given})
    assert env.np_random.random() == other.np_random.random()  # draws among equal decisions
    with pytest.raises(UserError, match="expected the initial state of 'roundabout'"):
        env.reset(options={"scene": np.concatenate((first[2], given[OBSERVED:]))})


def test_without_a_scene_the_seed_and_the_task_decide_and_scenes_and_actions_that_are_none_are_refused() -> None:
    env = DrivingEnvironment()
    first, again, other = (env.reset(seed=seed, options={"task": "merge"})[0] for seed in (3, 3, 4))
    assert first[SCENARIO].tolist() == [NAMES.index("merge")]
    assert np.array_equal(first[TRAFFIC], again[TRAFFIC])
    assert not np.array_equal(first[TRAFFIC], other[TRAFFIC])
    assert env.observation_space.contains(first)
    for wrong, expected in (
        (np.zeros(35), "expected 37 finite numbers"),
        (np.full(SCENE, np.nan), "expected 37 finite numbers"),
        (np.concatenate((np.zeros(OBSERVED), [99, 0])), "a scenario from 0 to"),
        (np.concatenate((np.zeros(OBSERVED), [0, 0.5])), "and a seed, found 0 and 0.5"),
    ):
        with pytest.raises(UserError, match=expected):
            env.reset(options={"scene": wrong})
    env.reset(seed=0)
    for wrong in (np.zeros(3), np.full(7, np.nan)):
        with pytest.raises(UserError, match="driving action: expected 7 finite numbers, 4 or 1"):
            env.step(wrong)
    row = scene(np.ones((5, 7), dtype=np.float32), "merge", 12345)
    assert row.shape == (SCENE,)
    assert (row[:OBSERVED] == 1).all()
    assert origin(row) == ("merge", 12345)


@pytest.mark.parametrize("name", ["merge", *slow("highway", "exit", "intersection")])
def test_who_drives_as_a_recorded_episode_succeeds_as_it_did(name: str) -> None:
    recorded = training_set("train", 1).select(name)
    env = DrivingEnvironment(STEP)
    env.reset(options={"scene": recorded.initial_states.require_scenes()[0].numpy()})
    length = int(recorded.lengths[0])
    for time in range(1, length):
        seen, _, terminated, truncated, info = env.step(recorded.states[0, time].numpy())
        for feature, values in recorded.observed.items():
            np.testing.assert_allclose(seen[feature], values[0, time], atol=1e-3)
    assert terminated or truncated
    assert info["arrived"]
    assert info["passed"]
    assert not info["crashed"]
    assert info["length"] == length - 1
    env.close()


WHOLE = np.ones((3, 5, 7), dtype=np.float32)


def test_demonstrations_drive_on_and_go_on_where_they_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[int] = []
    again = np.random.default_rng(0)

    def drive(name: str, seed: int, blind: bool) -> tuple[np.ndarray, bool]:
        driven.append(seed)
        return WHOLE * again.random(dtype=np.float32), seed != traffic.episode_seed(0, 1)

    monkeypatch.setattr(expert, "drive", drive)
    told: list[int] = []
    found = expert.demonstrations("merge", 2, 0, 1, lambda: told.append(1))
    assert len(told) == 2
    assert torch.equal(found.states, found.observed[TRAFFIC][..., :7])
    assert (found.provenance["driven"], found.provenance["rejected"]) == (3, 1)
    scenes = found.initial_states.require_scenes().numpy()
    for row, (length, begun) in enumerate(zip(found.lengths.tolist(), scenes, strict=True)):
        beyond = torch.arange(1, found.states.shape[1] - length + 1)  # seconds
        assert len(beyond) >= 8
        straight = found.states[row, length - 1, 1] + beyond * found.states[row, -1, 3]
        torch.testing.assert_close(found.states[row, length:, 1], straight)
        assert origin(begun) == ("merge", traffic.episode_seed(0, 2 * row))
    shard = expert.shard("merge", driven[-1])
    shard.write_bytes(shard.read_bytes()[:-20])  # damaged: driven again
    other = expert.demonstrations("merge", 2, 0, 1, lambda: None)
    assert driven == [traffic.episode_seed(0, number) for number in (0, 1, 2, 2)]
    assert other.hash != found.hash
    assert expert.demonstrations("merge", 2, 0, 1, lambda: None).hash == other.hash
    assert len(driven) == 4


@pytest.mark.slow
def test_demonstrations_do_not_depend_on_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(expert.SEARCH, "roundabout", replace(expert.SEARCH["roundabout"], budget=SHORT))
    fork = multiprocessing.get_context("fork")  # whose processes know the smaller budget
    monkeypatch.setattr(multiprocessing, "get_context", lambda kind: fork)
    found = []
    for workers in (1, 2):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / f"{workers}"))
        found.append(expert.demonstrations("roundabout", 1, 0, workers, lambda: None))
    assert found[0].hash == found[1].hash


def test_an_episode_that_raises_counts_as_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    def drive(name: str, seed: int, blind: bool) -> tuple[np.ndarray, bool]:
        if seed == traffic.episode_seed(0, 0):
            raise RuntimeError("the simulator broke")
        return WHOLE, seed != traffic.episode_seed(0, 1)

    monkeypatch.setattr(expert, "drive", drive)
    found = expert.demonstrations("merge", 2, 0, 1, lambda: None)
    assert (found.provenance["driven"], found.provenance["rejected"]) == (4, 2)
    assert not expert.shard("merge", traffic.episode_seed(0, 0)).exists()  # next time it is driven again
    assert expert.shard("merge", traffic.episode_seed(0, 1)).exists()
    monkeypatch.setattr(expert, "drive", lambda *_, **options: (WHOLE, False))
    with pytest.raises(UserError, match="expected 1 successful episodes of 4, found 0"):
        expert.demonstrations("exit", 1, 0, 1, lambda: None)


@pytest.mark.parametrize("failure", [MemoryError(), OSError(24, "Too many open files")])
def test_a_machine_that_fails_decides_nothing(failure: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str, seed: int, blind: bool) -> tuple[np.ndarray, bool]:
        raise failure

    with monkeypatch.context() as broken:
        broken.setattr(expert, "drive", fail)
        with pytest.raises(UserError, match=r"driving 'merge', seed \d+: the machine failed"):
            expert.demonstrations("merge", 1, 0, 1, lambda: None)
    monkeypatch.setattr(expert, "drive", lambda *_, **options: (WHOLE, True))
    assert expert.demonstrations("merge", 1, 0, 1, lambda: None).provenance["rejected"] == 0


@pytest.mark.parametrize(("name", "seconds"), [("merge", 1.0), ("intersection", 0.5)])
def test_after_an_episode_every_vehicle_drives_straight_on(name: str, seconds: float) -> None:
    seen = np.zeros((2, 5, 7), dtype=np.float32)
    seen[-1, :2] = (1, 10, 20, 4, -2, 1, 0)
    longer = expert.driven_on(seen, name, 5)
    assert np.array_equal(longer[:2], seen)
    assert longer[2:, 1, 1].tolist() == [10 + 4 * seconds * k for k in (1, 2, 3)]
    assert longer[2:, 0, 2].tolist() == [20 - 2 * seconds * k for k in (1, 2, 3)]
    assert (longer[2:, :2, 3:] == seen[-1, :2, 3:]).all()
    assert (longer[2:, 2:] == 0).all()


def final(name: str, decide: Any, seed: int = 0) -> Any:
    """Environment after an episode of decisions by name; ``decide`` maps an environment to a decision."""
    env = make(name)
    env.reset(seed=seed)
    while not advance(env, env.action_type.actions_indexes[decide(env)])[1]:
        pass
    return env


def test_a_red_light_is_passed_when_it_is_green_and_otherwise_passing_is_an_offence() -> None:
    colours = set()
    for seed in range(8):
        env = final("red light", lambda env: "FASTER", seed)
        assert env.vehicle.offence == (env.green > 0) == (not arrived(env, "red light"))
        waited = final(
            "red light", lambda env: "SLOWER" if env.time < env.green and env.vehicle.position[0] > env.line - 25 else "IDLE", seed
        )
        assert not waited.vehicle.offence
        colours.add(env.green > 0)
    assert colours == {False, True}


def test_signs_are_observed_as_standing_vehicles_and_do_not_collide() -> None:
    env = next(env for env in (start("red light", seed) for seed in range(20)) if env.green > 0)  # type: ignore[attr-defined]
    seen = observe(env)  # type: ignore[arg-type]
    at_line = seen[:, 0] * (abs(seen[:, 1] - env.line) < 1e-4)  # type: ignore[attr-defined]
    assert at_line.sum() >= 1
    assert (seen[at_line > 0, 3:5] == 0).all()
    through = final("give way", lambda env: "FASTER", 3)
    assert through.vehicle.offence or not through.vehicle.crashed


def test_to_enter_a_column_of_vehicles_without_a_gap_is_an_offence_and_an_overtaker_returns_to_its_lane() -> None:
    assert any(final("ramp", lambda env: "LANE_LEFT", seed).vehicle.offence for seed in range(4))
    env = start("overtake")
    env.vehicle.position = np.array([env.leader.position[0] + 20, 0.0])  # type: ignore[attr-defined]
    env.vehicle.on_state_update()  # type: ignore[attr-defined]
    assert not arrived(env, "overtake")  # type: ignore[arg-type]
    env.vehicle.position = np.array([env.leader.position[0] + 20, 4.0])  # type: ignore[attr-defined]
    env.vehicle.on_state_update()  # type: ignore[attr-defined]
    assert arrived(env, "overtake")  # type: ignore[arg-type]


def test_a_stop_sign_is_passed_after_a_halt_and_a_bridge_or_lane_with_room_alone() -> None:
    assert final("stop sign", lambda env: "IDLE").vehicle.offence

    def halting(env: Any) -> str:
        near = env.line - env.vehicle.position[0] < 16
        return "FASTER" if env.vehicle.halted else "SLOWER" if near else "IDLE"

    halted = final("stop sign", halting)
    assert arrived(halted, "stop sign")
    ends = [final("narrow bridge", lambda env: "FASTER", seed).vehicle.offence for seed in range(8)]
    assert {*ends} == {False, True}
    assert any(final("lane ends", lambda env: "LANE_RIGHT", seed).vehicle.offence for seed in range(8))


def test_a_barrier_is_gone_once_the_train_has_passed_and_a_leader_halts_and_goes_on() -> None:
    env = final("barrier", lambda env: "SLOWER", next(seed for seed in range(9) if start("barrier", seed).train))  # type: ignore[attr-defined]
    assert all(vehicle.position[1] > 5 for vehicle in env.train)
    assert len(env.road.vehicles) == 1 + len(env.train)
    env = start("stop and go")
    speeds = []
    while env.time < env.goes + 4:  # type: ignore[attr-defined]
        advance(env, env.action_type.actions_indexes["SLOWER"])  # type: ignore[attr-defined, arg-type]
        speeds.append(env.leader.speed)  # type: ignore[attr-defined]
    assert min(speeds) < 1 < speeds[-1]


@pytest.mark.slow
@pytest.mark.parametrize("name", RULES)
def test_constant_decisions_fail_in_half_of_the_scenes_or_more(name: str) -> None:
    for decision in ("FASTER", "IDLE", "SLOWER"):
        ends = [final(name, lambda env, decision=decision: decision, seed) for seed in range(12)]
        assert sum(arrived(env, name) and not env.vehicle.crashed for env in ends) <= 6, decision


@pytest.mark.slow
@pytest.mark.parametrize("name", [*RULES, *PRACTICE, BARRIER, FIRST_EXIT])
def test_the_expert_keeps_the_rules(name: str) -> None:
    assert expert.drive(name, 0)[1]
