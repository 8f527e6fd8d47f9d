"""Scenarios in which going is wrong: a red light, a priority stream, a ramp into dense traffic, a leader on a two-way road.

Straight roads along x (metres, m/s). A sign is observed as a standing vehicle; it does not collide. The class of the other vehicles
is ``config['other_vehicles_type']``; with ``config['fast']`` the faster simulation is used.
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Obstacle

from ftl_lightning.domains.driving.fast import accelerate

WIDTH = StraightLane.DEFAULT_WIDTH
"""Width of a lane in metres."""


class Sign(IDMVehicle):
    """Standing sign at a line; other vehicles stop in front of it."""

    LENGTH, WIDTH = 1.0, 1.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.collidable = False

    def act(self, action: Any = None) -> None:
        """Stay."""

    def step(self, dt: float) -> None:
        """Stay."""


class Street(AbstractEnv, ABC):
    """Scenario on straight roads; ``vehicle.offence`` is set when the controlled vehicle breaks the scenario's rule.

    The reward is .3, and up to .3 more for speed. An offence or a crash ends the episode, and so does arriving.
    """

    vehicle: Any
    road: Any

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """Add the limit of time in seconds, and the controlled vehicle's desired speeds in m/s."""
        action = {"type": "DiscreteMetaAction", "target_speeds": [0, 8, 16]}
        return super().default_config() | {"duration": 16, "action": action}

    def _reset(self) -> None:
        self.road = Road(RoadNetwork(), np_random=self.np_random)
        self._build()
        self.vehicle.offence = False
        if self.config["fast"]:
            accelerate(self.road)

    @abstractmethod
    def _build(self) -> None:
        """Add lanes, the controlled vehicle and the others."""

    @abstractmethod
    def arrived(self) -> bool:
        """Whether the controlled vehicle is at its destination, crashed or not."""

    def _offends(self, before: Any) -> bool:
        """Whether a frame that began at position ``before`` broke the rule."""
        return False

    def _simulate(self, action: Any = None) -> None:
        step = self.road.step

        def watched(dt: float) -> None:
            before = self.vehicle.position.copy()
            step(dt)
            self.vehicle.offence |= self._offends(before)

        self.road.step = watched
        try:
            super()._simulate(action)
        finally:
            del self.road.step

    def _reward(self, action: Any) -> float:
        speeds = self.vehicle.target_speeds
        fast = float(np.clip(self.vehicle.speed / speeds[-1], 0, 1))
        return 0.0 if self.vehicle.offence or self.vehicle.crashed else 0.3 + 0.3 * fast

    def _rewards(self, action: Any) -> dict[str, float]:
        return {"speed": self._reward(action)}

    def _is_terminated(self) -> bool:
        return bool(self.vehicle.crashed or self.vehicle.offence or self.arrived())

    def _is_truncated(self) -> bool:
        return bool(self.time >= self.config["duration"])

    def _lane(self, road: tuple[str, str], start: tuple[float, float], end: tuple[float, float]) -> None:
        lines = LineType.CONTINUOUS_LINE, LineType.CONTINUOUS_LINE
        self.road.network.add_lane(*road, StraightLane(start, end, line_types=lines))

    def _ego(self, lane: tuple[str, str, int], place: float, speed: float) -> None:
        line = self.road.network.get_lane(lane)
        self.vehicle = self.action_type.vehicle_class(self.road, line.position(place, 0), line.heading_at(place), speed)
        self.road.vehicles.append(self.vehicle)

    def _other(self, lane: tuple[str, str, int], place: float, speed: float) -> None:
        vehicle = utils.class_from_path(self.config["other_vehicles_type"]).make_on_lane(self.road, lane, place, speed)
        vehicle.target_speed, vehicle.enable_lane_change = speed, False
        self.road.vehicles.append(vehicle)

    def _others_at(self, y: float) -> list[Any]:
        """Other vehicles on the lane at ``y``, which is parallel to x."""
        return [vehicle for vehicle in self.road.vehicles if abs(vehicle.position[1] - y) < 1 and vehicle is not self.vehicle]

    def _uniform(self, low: float, high: float) -> float:
        return float(self.np_random.uniform(low, high))


class Gate(Street):
    """Street with signs at x = ``line`` that are removed when it is open; to pass them is an offence."""

    line: float

    @abstractmethod
    def _open(self) -> bool:
        """Whether it is open from now on."""

    def _simulate(self, action: Any = None) -> None:
        super()._simulate(action)
        if self._open():
            self.road.vehicles = [vehicle for vehicle in self.road.vehicles if not isinstance(vehicle, Sign)]

    def _offends(self, before: Any) -> bool:
        closed = any(isinstance(vehicle, Sign) for vehicle in self.road.vehicles)
        return bool(closed and before[0] < self.line - 1 <= self.vehicle.position[0])


class RedLight(Gate):
    """Stop at a red light until it is green; in three of ten scenes it is green from the beginning."""

    def _build(self) -> None:
        for number in range(2):
            self._lane(("a", "b"), (0, number * WIDTH), (400, number * WIDTH))
        self.line = self._uniform(40, 60)
        self.green = 0.0 if self._uniform(0, 1) < 0.3 else float(self.np_random.integers(8, 12))
        lane = int(self.np_random.integers(2))
        self._ego(("a", "b", lane), 0, 8)
        other = self._uniform(5, 30)
        while other < self.line - 5:
            self._other(("a", "b", 1 - lane), other, self._uniform(7, 10))
            other += self._uniform(14, 30)
        if self.green > 0:
            self.road.vehicles += [Sign.make_on_lane(self.road, ("a", "b", number), self.line, 0) for number in range(2)]

    def _open(self) -> bool:
        return bool(self.time >= self.green)

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.line + 30)


class GiveWay(Street):
    """Cross a road with a stream of vehicles that have priority: less than 1.5 s before one of them is an offence."""

    MARGIN = 1.5

    def _build(self) -> None:
        self._lane(("a", "b"), (0, 0), (200, 0))
        self.place = self._uniform(40, 55)
        self._lane(("c", "d"), (self.place, -150), (self.place, 150))
        self._ego(("a", "b", 0), 0, 8)
        at, speed = 150 - self._uniform(15, 40), self._uniform(9, 12)
        gaps = 2 * speed, 3.6 * speed
        number = int(self.np_random.integers(4, 8))
        for _ in range(number):
            self._other(("c", "d", 0), at, speed)
            at -= self._uniform(*gaps)
        self.road.vehicles.append(Sign.make_on_lane(self.road, ("a", "b", 0), self.place - 7, 0))

    def _offends(self, before: Any) -> bool:
        if abs(self.vehicle.position[0] - self.place) > 4:
            return False
        others = [vehicle for vehicle in self.road.vehicles if abs(vehicle.position[0] - self.place) < 1 and vehicle.speed > 1]
        others = [vehicle for vehicle in others if vehicle is not self.vehicle]
        return any(-6 < -vehicle.position[1] < 3 + self.MARGIN * vehicle.speed for vehicle in others)

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.place + 20)


class Ramp(Street):
    """Enter a lane of dense traffic before the ramp ends; with less than 10 m to a vehicle of the lane it is an offence."""

    END, GAP = 150.0, 10.0  # as far as vehicles behind are observed

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        return super().default_config() | {"duration": 24}

    def _build(self) -> None:
        self._lane(("a", "b"), (0, 0), (self.END, 0))
        self._lane(("a", "b"), (0, WIDTH), (self.END, WIDTH))
        self._lane(("b", "c"), (self.END, 0), (400, 0))
        self.road.objects.append(Obstacle(self.road, (self.END, WIDTH)))
        self.road.vehicles.append(Sign(self.road, (self.END, WIDTH)))  # the obstacle is not observed
        self._ego(("a", "b", 1), 10, 12)
        at, speed = self._uniform(-5, 5) + 80, self._uniform(9, 13)
        for _ in range(5):
            self._other(("a", "b", 0), at, speed)
            self.road.vehicles[-1].DISTANCE_WANTED, self.road.vehicles[-1].TIME_WANTED = 7.0, 0.6  # a tight column
            at -= self._uniform(13, 26)
            if at < 0:
                break

    def _offends(self, before: Any) -> bool:
        if not self.vehicle.position[1] < WIDTH / 2 <= before[1]:
            return False
        return any(abs(vehicle.position[0] - self.vehicle.position[0]) < self.GAP for vehicle in self._others_at(0))

    def _reward(self, action: Any) -> float:
        earned = super()._reward(action)
        return earned + 0.3 * (earned > 0 and self.vehicle.lane_index[2] == 0)

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.END + 20)


class Overtake(Street):
    """Overtake a slow leader on a two-way road with oncoming vehicles, and return to the right lane."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        action = {"type": "DiscreteMetaAction", "target_speeds": [8, 16, 24]}
        return super().default_config() | {"duration": 20, "action": action}

    def _build(self) -> None:
        for number in range(2):
            self._lane(("a", "b"), (0, number * WIDTH), (800, number * WIDTH))
        self._lane(("b", "a"), (800, 0), (0, 0))
        self._ego(("a", "b", 1), 30, 16)
        self._other(("a", "b", 1), 30 + self._uniform(30, 50), self._uniform(7, 9))
        self.leader = self.road.vehicles[-1]
        at = 800 - self._uniform(60, 160)
        for _ in range(int(self.np_random.integers(1, 4))):
            self._other(("b", "a", 0), at, self._uniform(12, 16))
            at -= self._uniform(30, 60)

    def arrived(self) -> bool:
        ego = self.vehicle
        return bool(ego.lane_index[2] == 1 and abs(ego.position[1] - WIDTH) < 1 and ego.position[0] > self.leader.position[0] + 10)
