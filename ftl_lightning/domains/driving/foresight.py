"""The planner's veto: which decisions may crash, as far as it looks ahead and as much as it knows.

Three kinds, the same for every method and every reference line:

- ``step``: a decision is tried in the true simulation until the next one (the paper's);
- ``simulation``: it is followed for some decisions in the true simulation;
- ``belief``: likewise, in worlds that are imagined from what can be seen, see :class:`Beliefs`.

A decision is as risky as the share of worlds in which it crashes, or in which everything that may be decided after it does
(proposals are simulated and scored likewise in PDM-Closed; Dauner et al., 2023).
"""

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.domains.driving.scenarios import observe, scenario
from ftl_lightning.domains.driving.simulation import Snapshot, advance, restore, save
from ftl_lightning.domains.driving.traffic import BELIEF, SIMULATION, STEP


@dataclass(frozen=True)
class Foresight:
    """How far a veto looks, and into what.

    Attributes:
        depth: decisions that are followed, the first one included.
        beliefs: imagined worlds; 0 looks into the true simulation.
    """

    depth: int
    beliefs: int = 0


VETOES = {BELIEF: Foresight(3, 8), SIMULATION: Foresight(3), STEP: Foresight(1)}
FRAMES = 5
"""Of an imagined world between two decisions."""
SIGHT = 100.0
"""Metres from the controlled vehicle, within which others are imagined."""
AFTERWARDS = ("IDLE", "SLOWER", "FASTER", "LANE_LEFT", "LANE_RIGHT")
"""What may be decided after the decision in question, in the order in which it is tried."""
Meaning = tuple[float, tuple[str, str, int]]
"""Target speed and lane."""


class Beliefs:
    """What can be known of the other vehicles, from where they are and were.

    Seen are each one's place, heading, speed, and whether it has crashed. Hidden are where it is going, how it follows (the
    exponent of the IDM), at what speed it would drive alone, and which lane it changes to. A belief draws these: the destination
    uniformly from those of the scenario that its way so far leaves open, the exponent from highway-env's range; it would drive at
    the highest speed at which it was seen, and stays in its lane. Who will come next is unknown too.

    Args:
        env: the simulation.
        name: of the scenario.
    """

    def __init__(self, env: AbstractEnv, name: str) -> None:
        self._env, self._scenario = env, scenario(name)
        self._fastest: dict[Any, float] = {}
        self._passed: dict[Any, list[str]] = {}

    def look(self) -> None:
        """Take in where everybody is now; before each decision."""
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
        near = [one for one in self._env.road.vehicles if one is not ego]
        return [one for one in near if math.dist(one.position, ego.position) < SIGHT]

    def draw(self, rng: np.random.Generator) -> None:
        """Put an imagined world in the simulation's place: other vehicles as one may believe them to be, and another future."""
        env, road = self._env, self._env.road
        others = [self._believed(vehicle, rng) for vehicle in self._others()]
        road.vehicles = [env.vehicle, *others]
        env.steps = road.steps = 0
        env.np_random.bit_generator.state = np.random.default_rng(rng.integers(2**32)).bit_generator.state

    def _believed(self, vehicle: Any, rng: np.random.Generator) -> Any:
        found = type(vehicle)(
            vehicle.road,
            vehicle.position.copy(),
            vehicle.heading,
            vehicle.speed,
            target_speed=max(self._fastest[vehicle], self._scenario.cruise),
            enable_lane_change=vehicle.enable_lane_change,
            timer=rng.uniform(),
        )
        found.check_collisions, found.crashed = vehicle.check_collisions, vehicle.crashed
        found.DELTA = rng.uniform(*found.DELTA_RANGE)
        network, passed = vehicle.road.network, self._passed[vehicle]
        ways = [network.shortest_path(found.lane_index[1], end) for end in self._scenario.destinations]
        open_ways = [way for way in ways if way and not set(way) & set(passed)]
        found.route = [found.lane_index]
        if open_ways:
            way = open_ways[rng.integers(len(open_ways))]
            found.route += [(start, end, None) for start, end in itertools.pairwise(way)]
        return found


def meaning(env: AbstractEnv, decision: int) -> Meaning:
    """What a decision makes of the vehicle: two that make the same of it are one, such as speeding up at the highest speed."""
    now = save(env)
    env.action_type.act(decision)
    found = env.vehicle.target_speed, env.vehicle.target_lane_index
    restore(env, now)
    return found


class Worlds:
    """The worlds that a veto looks into at one moment.

    Args:
        env: the simulation, which is left as it is.
        foresight: the veto.
        beliefs: what is known.
        rng: draws from them.
    """

    def __init__(self, env: AbstractEnv, foresight: Foresight, beliefs: Beliefs, rng: np.random.Generator) -> None:
        self._env, self._foresight = env, foresight
        self._after: dict[tuple[Meaning, int], Snapshot | None] = {}
        self._risks: dict[Meaning, float] = {}
        self._worlds: list[Snapshot] = []
        with self._imagining():
            actual = save(env)
            for _ in range(foresight.beliefs):
                restore(env, actual)
                beliefs.draw(rng)
                self._worlds.append(save(env))
            restore(env, actual)
            if not foresight.beliefs:
                self._worlds.append(actual)

    @contextmanager
    def _imagining(self) -> Iterator[None]:
        """With fewer frames, where the world is not the true one; the simulation is left as it was."""
        env, actual = self._env, save(self._env)
        frequency = env.config["simulation_frequency"]
        if self._foresight.beliefs:
            env.config["simulation_frequency"] = FRAMES * env.config["policy_frequency"]
        try:
            yield
        finally:
            env.config["simulation_frequency"] = frequency
            restore(env, actual)

    def state(self, decision: int) -> NDArray[np.float64] | None:
        """The state ``(7,)`` that a decision leads to in the first world in which it does not crash; ``None`` if there is none."""
        with self._imagining():
            key = self._key(decision)
            for world in range(len(self._worlds)):
                if (after := self._followed(key, decision, world)) is not None:
                    restore(self._env, after)
                    return observe(self._env)[0].astype(np.float64)
        return None

    def risk(self, decision: int) -> float:
        """The share of worlds in which a decision crashes, or all that may be decided after it."""
        with self._imagining():
            key = self._key(decision)
            if key not in self._risks:
                after = [self._followed(key, decision, world) for world in range(len(self._worlds))]
                self._risks[key] = sum(not self._survives(one, self._foresight.depth - 1) for one in after) / len(after)
            return self._risks[key]

    def _key(self, decision: int) -> Meaning:
        restore(self._env, self._worlds[0])
        return meaning(self._env, decision)

    def _followed(self, key: Meaning, decision: int, world: int) -> Snapshot | None:
        """A world after a decision; ``None`` if it crashes there."""
        if (key, world) not in self._after:
            restore(self._env, self._worlds[world])
            advance(self._env, decision)
            self._after[key, world] = None if self._env.vehicle.crashed else save(self._env)
        return self._after[key, world]

    def _survives(self, after: Snapshot | None, left: int) -> bool:
        """Whether some decisions can follow, as many as are left, without a crash."""
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
