"""The planner's veto: how far it looks, and that beliefs know nothing that cannot be seen."""

import itertools
from typing import Any

import numpy as np
import pytest

from ftl_lightning.domains.driving.environment import DrivingEnvironment
from ftl_lightning.domains.driving.expert import BLIND, Blind, plan_blind
from ftl_lightning.domains.driving.foresight import FRAMES, VETOES, Beliefs, Foresight, Worlds
from ftl_lightning.domains.driving.scenarios import EXITS, SCENARIOS, make, save
from ftl_lightning.domains.driving.traffic import BELIEF, SIMULATION, STEP


def slow(*cases: Any) -> list[Any]:
    """Cases that only a full run looks at."""
    return [pytest.param(*([case] if isinstance(case, str) else case), marks=pytest.mark.slow) for case in cases]


def start(name: str, seed: int) -> Any:
    env: Any = make(name)
    env.reset(seed=seed)
    return env


def worlds(env: Any, name: str, veto: str, seed: int = 0) -> Worlds:
    beliefs = Beliefs(env, name)
    beliefs.look()
    return Worlds(env, VETOES[veto], beliefs, np.random.default_rng(seed))


def risks(env: Any, name: str, veto: str, seed: int = 0) -> list[float]:
    found = worlds(env, name, veto, seed)
    return [found.risk(decision) for decision in range(env.action_space.n)]


def blocked(distance: float) -> Any:
    """Two lanes; on that of the controlled vehicle, which drives at 30 m/s, one stands so many metres ahead."""
    env = start("merge", 0)
    ego, wreck = env.vehicle, env.road.vehicles[1]
    wreck.position, wreck.speed, wreck.target_speed, wreck.crashed = ego.position + np.array([distance, 0.0]), 0.0, 0.0, True
    wreck.on_state_update()
    env.road.vehicles = [ego, wreck]
    return env


@pytest.mark.parametrize(("veto", "keeps"), [(STEP, True), (SIMULATION, False), (BELIEF, False)])
def test_who_looks_ahead_sees_a_crash_that_cannot_be_averted_any_more(veto: str, keeps: bool) -> None:
    env = blocked(42.0)
    named = env.action_type.actions_indexes
    found = risks(env, "merge", veto)
    assert (found[named["IDLE"]] == 0) == keeps
    assert found[named["LANE_LEFT"]] == 0
    assert risks(blocked(20.0), "merge", veto)[named["IDLE"]] == 1  # everybody sees a crash in the next step


FAST = [("merge", BELIEF), ("roundabout", SIMULATION), ("intersection", STEP)]
PAIRS = itertools.product(("roundabout", "intersection", "merge"), VETOES)


@pytest.mark.parametrize(("name", "veto"), [*FAST, *slow(*(pair for pair in PAIRS if pair not in FAST))])
def test_looking_ahead_leaves_the_simulation_as_it_was(name: str, veto: str) -> None:
    env = start(name, 3)
    before, config = save(env), dict(env.config)
    first, again = risks(env, name, veto), risks(env, name, veto)
    after = save(env)
    assert first == again
    assert env.config == config
    counters = ("time", "steps", "road_steps", "random")
    assert [getattr(after, name) for name in counters] == [getattr(before, name) for name in counters]
    for (one, was), (other, now) in zip(before.vehicles, after.vehicles, strict=True):
        assert one is other
        assert was.keys() == now.keys()
        assert np.array_equal(was["position"], now["position"])


def hide(env: Any, rng: np.random.Generator) -> None:
    """Change all that nobody can see."""
    for vehicle in env.road.vehicles:
        if vehicle is not env.vehicle:
            vehicle.plan_route_to(str(rng.choice(EXITS)))
            vehicle.DELTA = rng.uniform(1, 8)
            vehicle.target_speed = rng.uniform(0, 40)
            vehicle.timer = rng.uniform()
            vehicle.action = {"steering": 0.5, "acceleration": -3.0}
            vehicle.is_yielding, vehicle.yield_timer = True, 5
            lanes = env.road.network.lanes_dict()
            vehicle.target_lane_index = list(lanes)[rng.integers(len(lanes))]
    env.np_random.bit_generator.state = np.random.default_rng(rng.integers(99)).bit_generator.state


@pytest.mark.parametrize("name", ["merge", *slow("roundabout", "intersection")])
def test_beliefs_know_nothing_that_cannot_be_seen(name: str) -> None:
    told = []
    for hidden in (None, 0, 1):
        env = start(name, 0)
        if hidden is not None:
            hide(env, np.random.default_rng(hidden))
        looked = worlds(env, name, BELIEF)
        decisions = range(env.action_space.n)
        told.append([(looked.risk(one), None if (at := looked.state(one)) is None else at.tolist()) for one in decisions])
    assert told[0] == told[1] == told[2]


def test_the_simulation_knows_what_is_hidden() -> None:
    env, other = start("roundabout", 1), start("roundabout", 1)
    hide(other, np.random.default_rng(0))
    ways = []
    for one in (env, other):
        for _ in range(3):
            one.step(1)
        ways.append([vehicle.position.tolist() for vehicle in one.road.vehicles[1:]])
    assert ways[0] != ways[1]  # else the test before this one could not fail


def test_who_has_passed_an_exit_does_not_take_it() -> None:
    env = start("roundabout", 0)
    beliefs = Beliefs(env, "roundabout")
    vehicle, network = env.road.vehicles[2], env.road.network
    env.road.vehicles = [env.vehicle, vehicle]
    for lane in (("we", "sx", 0), ("sx", "se", 0), ("ex", "ee", 0)):
        place = network.get_lane(lane)
        vehicle.position, vehicle.heading = place.position(place.length / 2, 0), place.heading_at(place.length / 2)
        vehicle.on_state_update()
        beliefs.look()
    exits = set()
    for seed in range(20):
        before = save(env)
        beliefs.draw(np.random.default_rng(seed))
        exits.add(env.road.vehicles[1].route[-1][1])
        env.road.vehicles = [one for one, _ in before.vehicles]
    assert exits == {"nxr"}


def test_beliefs_have_the_same_time_between_decisions_as_the_simulation() -> None:
    for name, found in SCENARIOS.items():
        env = make(name)
        policy = env.config["policy_frequency"]
        frames = env.config["simulation_frequency"] // policy
        assert abs(frames / env.config["simulation_frequency"] - 1 / policy) <= 0.04, found
        assert (FRAMES * policy) // policy == FRAMES


@pytest.mark.parametrize("veto", VETOES)
def test_an_episode_repeats(veto: str) -> None:
    ways = []
    for _ in range(2):
        env = DrivingEnvironment(veto)
        env.reset(seed=5, options={"task": "roundabout"})
        faster = np.array([env.simulation.action_type.actions_indexes["FASTER"]], dtype=np.float32)
        ways.append([env.step(faster)[0]["traffic"].tolist() for _ in range(2)])
    assert ways[0] == ways[1]


def decided(env: Any, name: str) -> int:
    beliefs = Beliefs(env, name)
    beliefs.look()
    return plan_blind(env, name, beliefs, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["merge", *slow("roundabout")])
def test_the_blind_expert_knows_nothing_that_cannot_be_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftl_lightning.domains.driving.expert.BLIND", Blind(beliefs=2, expansions=2))
    monkeypatch.setitem(VETOES, BELIEF, Foresight(2, 2))
    for seed in range(2):
        env, other = start(name, seed), start(name, seed)
        hide(other, np.random.default_rng(seed))
        assert decided(env, name) == decided(other, name)


@pytest.mark.parametrize("keeping", [BLIND.tolerated, BLIND.tolerated + 0.1])
def test_the_blind_expert_takes_the_best_decision_of_tolerated_risk(keeping: float, monkeypatch: pytest.MonkeyPatch) -> None:
    env = start("roundabout", 0)
    named = env.action_type.actions_indexes
    earned = {named["FASTER"]: 3.0, named["IDLE"]: 2.0, named["SLOWER"]: 1.0}
    risk = {named["FASTER"]: 1.0, named["IDLE"]: keeping, named["SLOWER"]: 0.0}

    def values(env: Any, name: str, search: Any, first: list[int], budget: int) -> dict[int, float]:
        return {first[0]: earned.get(first[0], 0.0)}

    monkeypatch.setattr("ftl_lightning.domains.driving.expert._values", values)
    monkeypatch.setattr(Worlds, "risk", lambda self, decision: risk.get(decision, 1.0))
    assert decided(env, "roundabout") == named["IDLE" if keeping <= BLIND.tolerated else "SLOWER"]
