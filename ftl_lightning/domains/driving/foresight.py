"""The planner's veto of decisions, by the risk of a crash within a look-ahead.

Vetoes, shared by all methods and baselines: ``step``, one-step look-ahead in the true simulation (the paper's); ``simulation``,
look-ahead of several decisions in the true simulation; ``belief``, the same in worlds sampled from observations, see
:class:`Beliefs`. The risk of a decision is the share of worlds in which the decision or all its continuations crash (compare
PDM-Closed; Dauner et al., 2023).
"""

import itertools
import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.domains.driving.scenarios import Snapshot, advance, imagined, observe, restore, save, scenario
from ftl_lightning.domains.driving.traffic import BELIEF, SIMULATION, STEP


@dataclass(frozen=True)
class Foresight:
    """Depth of look-ahead in decisions, and number of sampled worlds (0 for the true simulation)."""

    depth: int
    beliefs: int = 0


VETOES = {BELIEF: Foresight(3, 8), SIMULATION: Foresight(3), STEP: Foresight(1)}
FRAMES, SIGHT = 5, 100.0
"""Sampled worlds: simulation frames per decision, and maximum distance in metres of the simulated vehicles."""
AFTERWARDS = ("IDLE", "SLOWER", "FASTER", "LANE_LEFT", "LANE_RIGHT")
"""Follow-up decisions, in the order in which they are tried."""
Meaning = tuple[float, tuple[str, str, int]]  # target speed and lane


class Beliefs:
    """Beliefs about the other vehicles of a scenario, from their present and past observations.

    Position, heading, speed and crash are observed. A belief samples the destination uniformly from those still reachable, and the
    IDM exponent from highway-env's range. The desired speed is the highest observed speed; vehicles keep their lane. Vehicles that
    appear later are unknown.
    """

    def __init__(self, env: AbstractEnv, name: str) -> None:
        self._env, self._scenario = env, scenario(name)
        self._fastest: dict[Any, float] = {}
        self._passed: dict[Any, list[str]] = {}

    def look(self) -> None:
        """Update from the present observation; call before each decision."""
        network = self._env.road.network
        fastest, passed = {}, {}
        for vehicle in self._others():
            lane = network.get_closest_lane_index(vehicle.position, vehicle.heading)
            fastest[vehicle] = max(self._fastest.get(vehicle, 0.0), vehicle.speed)
            before = self._passed.get(vehicle, [])
            passed[vehicle] = [*before, *(network.shortest_path(before[-1], lane[0])[1:] if before else [lane[0]])]
        self._fastest, self._passed = fastest, passed

    def _others(self) -> list[Any]:
        ego = self._env.vehicle
        return [v for v in self._env.road.vehicles if v is not ego and math.dist(v.position, ego.position) < SIGHT]

    def draw(self, rng: np.random.Generator) -> None:
        """Replace the simulation's state by a sampled world: other vehicles and random state."""
        env, road = self._env, self._env.road
        road.vehicles = [env.vehicle, *[self._believed(vehicle, rng) for vehicle in self._others()]]
        env.steps = road.steps = 0
        env.np_random.bit_generator.state = np.random.default_rng(rng.integers(2**32)).bit_generator.state

    def _believed(self, vehicle: Any, rng: np.random.Generator) -> Any:
        wanted, changes = max(self._fastest[vehicle], self._scenario.cruise), vehicle.enable_lane_change
        pose = vehicle.road, vehicle.position.copy(), vehicle.heading, vehicle.speed
        driver = type(vehicle)(*pose, target_speed=wanted, enable_lane_change=changes, timer=rng.uniform())
        driver.check_collisions, driver.crashed = vehicle.check_collisions, vehicle.crashed
        driver.DELTA = rng.uniform(*driver.DELTA_RANGE)
        network, passed = vehicle.road.network, self._passed[vehicle]
        ways = [network.shortest_path(driver.lane_index[1], end) for end in self._scenario.destinations]
        open_ways = [way for way in ways if way and not set(way) & set(passed)]
        driver.route = [driver.lane_index]
        if open_ways:
            way = open_ways[rng.integers(len(open_ways))]
            driver.route += [(start, end, None) for start, end in itertools.pairwise(way)]
        return driver


def meaning(env: AbstractEnv, decision: int) -> Meaning:
    """Effect of a decision, equal for equivalent decisions, such as idling and speeding up at the highest speed."""
    now = save(env)
    env.action_type.act(decision)
    effect = env.vehicle.target_speed, env.vehicle.target_lane_index
    restore(env, now)
    return effect


class Worlds:
    """Worlds of a veto at the present time; the simulation is left unchanged."""

    def __init__(self, env: AbstractEnv, foresight: Foresight, beliefs: Beliefs, rng: np.random.Generator) -> None:
        self._env, self._foresight = env, foresight
        self._after: dict[tuple[Meaning, int], Snapshot | None] = {}
        self._risks: dict[Meaning, float] = {}
        self._worlds: list[Snapshot] = []
        with self._imagined() as actual:
            for _ in range(foresight.beliefs):
                restore(env, actual)
                beliefs.draw(rng)
                self._worlds.append(save(env))
            if not foresight.beliefs:
                self._worlds.append(actual)

    def _imagined(self) -> AbstractContextManager[Snapshot]:
        """The simulation for a block, with :data:`FRAMES` in sampled worlds."""
        config = self._env.config
        sampled = FRAMES * config["policy_frequency"]
        return imagined(self._env, sampled if self._foresight.beliefs else config["simulation_frequency"], until_crash=True)

    def state(self, decision: int) -> NDArray[np.float64] | None:
        """State ``(7,)`` after a decision in the first world without a crash; ``None`` if all crash."""
        with self._imagined():
            key = self._key(decision)
            for world in range(len(self._worlds)):
                if (after := self._followed(key, decision, world)) is not None:
                    restore(self._env, after)
                    return observe(self._env)[0].astype(np.float64)
        return None

    def risk(self, decision: int) -> float:
        """Share of worlds in which a decision or all its continuations crash."""
        with self._imagined():
            key = self._key(decision)
            if key not in self._risks:
                after = [self._followed(key, decision, world) for world in range(len(self._worlds))]
                self._risks[key] = sum(not self._survives(end, self._foresight.depth - 1) for end in after) / len(after)
            return self._risks[key]

    def _key(self, decision: int) -> Meaning:
        restore(self._env, self._worlds[0])
        return meaning(self._env, decision)

    def _followed(self, key: Meaning, decision: int, world: int) -> Snapshot | None:
        """Snapshot of a world after a decision; ``None`` after a crash."""
        if (key, world) not in self._after:
            restore(self._env, self._worlds[world])
            advance(self._env, decision)
            self._after[key, world] = None if self._env.vehicle.crashed else save(self._env)
        return self._after[key, world]

    def _survives(self, after: Snapshot | None, left: int) -> bool:
        """Whether ``left`` further decisions are possible without a crash."""
        if after is None or not left:
            return after is not None
        env = self._env
        named = env.action_type.actions_indexes
        for name in filter(named.__contains__, AFTERWARDS):
            restore(env, after)
            if env._is_terminated() or env._is_truncated():
                return True
            advance(env, named[name])
            if not env.vehicle.crashed and self._survives(save(env) if left > 1 else after, left - 1):
                return True
        return False
