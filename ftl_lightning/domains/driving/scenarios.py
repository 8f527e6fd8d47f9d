"""The paper's driving scenarios as subclasses of highway-env (x right, y down, metres, m/s), with their success criteria.

Importing this module registers each scenario with gymnasium as ``ftl/driving-NAME-v0``.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.highway_env import HighwayEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.merge_env import MergeEnv
from highway_env.envs.roundabout_env import RoundaboutEnv, RoundaboutGenericEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import RoadObject
from numpy.typing import NDArray

from ftl_lightning.domains.driving import practice, rules
from ftl_lightning.domains.driving.fast import FastVehicle, accelerate
from ftl_lightning.domains.driving.traffic import FEATURES, VEHICLES, check_scenario

OBSERVATION = {
    "type": "Kinematics",
    "vehicles_count": VEHICLES,
    "features": list(FEATURES),
    "absolute": True,
    "normalize": False,
    "clip": False,
    "see_behind": False,
    "order": "sorted",
    "include_obstacles": False,
}


class _Accelerated(AbstractEnv):
    """Scenario in the faster classes, unless ``config['fast']`` is false."""

    def _reset(self) -> None:
        super()._reset()
        if self.config["fast"]:
            accelerate(self.road)


class Highway(_Accelerated, HighwayEnv):
    """Drive fast and on the right among fifty vehicles; there is no destination."""


class Exit(_Accelerated, ExitEnv):
    """Leave a highway of four lanes at 200 m, from any lane."""

    vehicle: Any

    def _create_road(self, road_length: int = 1000, exit_position: int = 200, exit_length: int = 100) -> None:
        super()._create_road(road_length, exit_position, exit_length)

    def _create_vehicles(self) -> None:
        super()._create_vehicles()
        # The published scene starts in the leftmost lane. Other vehicles start ahead, so every lane is free here.
        ego = self.vehicle
        lane = self.road.network.get_lane(("0", "1", int(self.np_random.integers(self.config["lanes_count"]))))
        place = lane.position(ego.position[0], 0)
        moved = self.action_type.vehicle_class(self.road, place, ego.heading, ego.speed)
        self.road.vehicles[self.road.vehicles.index(ego)] = moved
        self.vehicle = moved


class Merge(_Accelerated, MergeEnv):
    """Pass an access ramp: two lanes, three vehicles and a merging vehicle (the paper's text says three lanes)."""

    END = 320.0

    def _rewards(self, action: int) -> dict[str, float]:
        rewards: dict[str, float] = super()._rewards(action)
        # Not clipped in highway-env 1.12.1: beyond 30 m/s the reward leaves [0, 1], which optimistic planning relies on.
        return rewards | {"high_speed_reward": float(np.clip(rewards["high_speed_reward"], 0, 1))}

    def _is_terminated(self) -> bool:
        return bool(self.vehicle.crashed or self.vehicle.position[0] > self.END)


class IntersectionVehicle(IDMVehicle):
    """Separate class, as the intersection sets class constants, which would affect later environments."""


class FastIntersectionVehicle(FastVehicle):
    """Faster counterpart of :class:`IntersectionVehicle`."""


class Intersection(_Accelerated, IntersectionEnv):
    """Turn left at an intersection of two-way roads, with ten vehicles."""


class Roundabout(_Accelerated, RoundaboutEnv):
    """Take the second of four exits of a roundabout, with four vehicles."""


class OtherRoundabout(_Accelerated, RoundaboutGenericEnv):
    """Take the second exit of a roundabout of another size, with vehicles on all its roads."""


class FirstExit(Roundabout):
    """Take the first exit of the same roundabout."""

    def _make_vehicles(self) -> None:
        super()._make_vehicles()
        self.vehicle.plan_route_to("exs")


class ThirdExit(Roundabout):
    """Take the third exit of the same roundabout; for validation."""

    def _make_vehicles(self) -> None:
        super()._make_vehicles()
        self.vehicle.plan_route_to("wxs")


@dataclass(frozen=True)
class Scenario:
    """Driving scenario.

    Attributes:
        environment: class of the environment.
        config: settings that differ from highway-env's.
        arrived: whether the vehicle is at its destination, crashed or not; on the highway, whether time is up.
        passed: weaker criterion of the paper's code, crashed or not; ``None`` for ``arrived`` without a crash.
        drivers: classes of the other vehicles, of highway-env and fast.
        destinations: possible destinations of the other vehicles.
        cruise: minimum desired speed of the other vehicles, in m/s.
    """

    environment: type[AbstractEnv]
    config: dict[str, Any]
    arrived: Callable[[AbstractEnv], bool]
    passed: Callable[[AbstractEnv], bool] | None = None
    drivers: tuple[type[IDMVehicle], type[IDMVehicle]] = (IDMVehicle, FastVehicle)
    destinations: tuple[str, ...] = ()
    cruise: float = 0.0


def _on(*roads: tuple[str, str]) -> Callable[[AbstractEnv], bool]:
    return lambda env: tuple(env.vehicle.lane_index[:2]) in roads


EXITS = ("exr", "sxr", "nxr")  # of other vehicles in the roundabout


def _other_roundabout(radius: int, lanes: int, vehicles: int) -> Scenario:
    config = {"duration": 12, "roundabout_radius": radius, "roundabout_lanes": lanes, "vehicles_count": vehicles}
    return Scenario(OtherRoundabout, config, _SECOND_EXIT, destinations=(*EXITS, "wxr"))


def _ruled(environment: type[rules.Street]) -> Scenario:
    return Scenario(environment, {}, lambda env: env.arrived() and not env.vehicle.offence)


_SECOND_EXIT = _on(("nx", "nxs"), ("nxs", "nxr"))
SCENARIOS = {
    "highway": Scenario(Highway, {"duration": 10}, lambda env: bool(env.time >= env.config["duration"])),
    "exit": Scenario(
        Exit,
        {
            "lanes_count": 4,
            "ego_spacing": 1,  # starts at 90 m; at the published 2, at 180 m, four lanes are often too many to cross
            "duration": 9,
            "collision_reward": -5,
            "high_speed_reward": 0.1,
            "right_lane_reward": 1,
            "goal_reward": 10,
        },
        lambda env: bool(env._is_success()),
    ),
    "merge": Scenario(Merge, {}, lambda env: bool(env.vehicle.position[0] > Merge.END)),
    "intersection": Scenario(
        Intersection,
        {"policy_frequency": 2, "normalize_reward": True},
        lambda env: bool(env.has_arrived(env.vehicle)),
        drivers=(IntersectionVehicle, FastIntersectionVehicle),
        destinations=("o0", "o1", "o2", "o3"),
        cruise=8.0,
    ),
    "roundabout": Scenario(
        Roundabout, {"duration": 8}, _SECOND_EXIT, passed=lambda env: bool(env.vehicle.position[1] < -20), destinations=EXITS
    ),
    "roundabout third exit": Scenario(ThirdExit, {"duration": 10}, _on(("wx", "wxs"), ("wxs", "wxr")), destinations=EXITS),
    "roundabout of three lanes": _other_roundabout(radius=28, lanes=3, vehicles=7),
    "roundabout of one lane": _other_roundabout(radius=16, lanes=1, vehicles=4),
    "red light": _ruled(rules.RedLight),
    "give way": _ruled(rules.GiveWay),
    "ramp": _ruled(rules.Ramp),
    "overtake": _ruled(rules.Overtake),
    "stop and go": _ruled(practice.StopAndGo),
    "narrow bridge": _ruled(practice.NarrowBridge),
    "parked car": _ruled(practice.ParkedCar),
    "lane ends": _ruled(practice.LaneEnds),
    "stop sign": _ruled(practice.StopSign),
    "barrier": _ruled(practice.Barrier),
    "first exit": Scenario(FirstExit, {"duration": 8}, _on(("ex", "exs"), ("exs", "exr")), destinations=EXITS),
}


def scenario(name: str) -> Scenario:
    """Scenario by name; an unknown name raises a ``UserError``."""
    return SCENARIOS[check_scenario(name)]


def make(name: str, fast: bool = True) -> AbstractEnv:
    """Environment of a scenario, in the classes of :mod:`ftl_lightning.domains.driving.fast` unless ``fast`` is false."""
    chosen = scenario(name)
    drivers = chosen.drivers[fast]
    config = {"observation": OBSERVATION, "other_vehicles_type": f"{drivers.__module__}.{drivers.__name__}", "fast": fast}
    return chosen.environment(config | chosen.config, render_mode="rgb_array")


def arrived(env: AbstractEnv, name: str) -> bool:
    """Whether the controlled vehicle is at its destination, crashed or not."""
    return SCENARIOS[name].arrived(env)


def observe(env: AbstractEnv) -> NDArray[np.float32]:
    """Observation of highway-env with :data:`OBSERVATION`, ``(5, 7)``, without data frames."""
    ego = env.vehicle
    others = env.road.close_objects_to(ego, env.PERCEPTION_DISTANCE, VEHICLES - 1, see_behind=False, vehicles_only=True)
    rows = np.zeros((VEHICLES, len(FEATURES)), dtype=np.float32)
    for row, vehicle in enumerate((ego, *others)):
        cos, sin = np.cos(vehicle.heading), np.sin(vehicle.heading)
        rows[row] = (1, *vehicle.position, vehicle.speed * cos, vehicle.speed * sin, cos, sin)
    return rows


for _name in SCENARIOS:
    _id = f"ftl/driving-{_name.replace(' ', '-')}-v0"
    gymnasium.register(_id, entry_point=f"{__name__}:{make.__name__}", kwargs={"name": _name})


@dataclass(frozen=True)
class Snapshot:
    """State that stepping changes: counters, objects with copies of their attributes, and state of the random generator."""

    time: float
    steps: int
    road_steps: int
    vehicles: list[tuple[RoadObject, dict[str, Any]]]
    objects: list[tuple[RoadObject, dict[str, Any]]]
    random: dict[str, Any]


_MUTABLE: dict[type, Callable[[Any], Any]] = {np.ndarray: np.copy, list: list, dict: dict}


def _copied(attributes: dict[str, Any]) -> dict[str, Any]:
    return {name: _MUTABLE[type(value)](value) if type(value) in _MUTABLE else value for name, value in attributes.items()}


def save(env: AbstractEnv) -> Snapshot:
    """Copy the state that stepping changes."""
    road = env.road
    vehicles, objects = ([(thing, _copied(vars(thing))) for thing in things] for things in (road.vehicles, road.objects))
    return Snapshot(env.time, env.steps, getattr(road, "steps", 0), vehicles, objects, env.np_random.bit_generator.state)


def restore(env: AbstractEnv, snapshot: Snapshot) -> None:
    """Restore a snapshot of this environment, taken since its last reset."""
    env.time, env.steps = snapshot.time, snapshot.steps
    env.road.steps = snapshot.road_steps
    env.road.vehicles = [vehicle for vehicle, _ in snapshot.vehicles]
    for thing, attributes in (*snapshot.vehicles, *snapshot.objects):
        thing.__dict__.clear()
        thing.__dict__.update(_copied(attributes))
    env.np_random.bit_generator.state = snapshot.random


@contextmanager
def imagined(env: AbstractEnv, frequency: int, until_crash: bool = False) -> Iterator[Snapshot]:
    """Simulate at a frequency in Hz within the block, from the yielded state, which is restored afterwards.

    With ``until_crash`` the simulation may stop when the controlled vehicle crashes.
    """
    actual, usual = save(env), env.config["simulation_frequency"]
    env.config["simulation_frequency"] = frequency
    env.road.until_crash = env.vehicle if until_crash else None
    try:
        yield actual
    finally:
        env.road.until_crash = None
        env.config["simulation_frequency"] = usual
        restore(env, actual)


def advance(env: AbstractEnv, action: int) -> tuple[float, bool]:
    """Step without the observation, which costs more than the physics; return the reward and whether the episode ended."""
    observe = env.observation_type.observe
    env.observation_type.observe = lambda: None
    try:
        _, reward, terminated, truncated, _ = env.step(action)
    finally:
        env.observation_type.observe = observe
    return float(reward), bool(terminated or truncated)
