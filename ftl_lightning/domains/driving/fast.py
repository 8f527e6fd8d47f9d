"""Faster simulation: scalar arithmetic, a single lane lookup per frame, broad-phase collision detection.

highway-env spends most time on numpy calls for pairs of numbers and on all pairs of vehicles. These classes replace highway-env's
within an environment. Results are the same up to the order of additions, see the tests.
``scenarios.make(name, fast=False)`` does not use them.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.objects import Landmark, RoadObject

LaneIndex = tuple[str, str, int]


def _clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


class _FastLane:
    """Lane with scalar arithmetic; a subclass computes coordinates by ``_local(x, y)``."""

    _local: Callable[[float, float], tuple[float, float]]
    heading_at: Callable[[float], float]
    length: float

    def local_coordinates(self, position: Any) -> tuple[float, float]:
        return self._local(*position.tolist())

    def nearer(self, x: float, y: float, heading: float, bound: float) -> float | None:
        """Return ``distance_with_heading`` if it is below the bound, else ``None``."""
        s, r = self._local(x, y)
        distance = abs(r) + (s - self.length if s > self.length else -s if s < 0 else 0)
        if distance < bound and (distance := distance + abs(_wrap(heading - self.heading_at(s)))) < bound:
            return distance
        return None


class FastStraightLane(_FastLane, StraightLane):
    """Straight lane."""

    def _local(self, x: float, y: float) -> tuple[float, float]:
        x0, y0, dx, dy = self._line
        x, y = x - x0, y - y0
        return x * dx + y * dy, y * dx - x * dy


class FastSineLane(FastStraightLane, SineLane):
    """Sine-shaped lane."""

    def _local(self, x: float, y: float) -> tuple[float, float]:
        s, r = super()._local(x, y)
        return s, r - self.amplitude * math.sin(self.pulsation * s + self.phase)

    def heading_at(self, longitudinal: float) -> float:
        slope = self.amplitude * self.pulsation * math.cos(self.pulsation * longitudinal + self.phase)
        return self.heading + math.atan(slope)


class FastCircularLane(_FastLane, CircularLane):
    """Circular lane."""

    def _local(self, x: float, y: float) -> tuple[float, float]:
        x0, y0 = self._centre
        x, y = x - x0, y - y0
        turned = _wrap(math.atan2(y, x) - self.start_phase)
        return self.direction * turned * self.radius, self.direction * (self.radius - math.sqrt(x * x + y * y))


_LANES = {StraightLane: FastStraightLane, SineLane: FastSineLane, CircularLane: FastCircularLane}


class FastNetwork(RoadNetwork):
    """Road network with a lane lookup that builds no lists."""

    def get_closest_lane_index(self, position: Any, heading: float | None = None, likely: LaneIndex | None = None) -> LaneIndex:
        if heading is None:
            return super().get_closest_lane_index(position, heading)
        x, y = position.tolist()
        lanes = self._lanes
        best, nearest = math.inf, lanes[0][0]
        if likely is not None:
            # Most lanes are farther than the previous lane. Ties go to the first lane.
            best = math.nextafter(self.get_lane(likely).nearer(x, y, heading, math.inf), math.inf)
            circles = zip(lanes, self._circles, strict=True)
            lanes = [known for known, (at_x, at_y, radius) in circles if math.hypot(at_x - x, at_y - y) <= radius + best]
        for index, lane in lanes:
            if (distance := lane.nearer(x, y, heading, best)) is not None:
                best, nearest = distance, index
        return nearest


def _updated(vehicle: Any) -> bool:
    """Update a vehicle's lane, if the network is a fast one."""
    network = vehicle.road.network
    if fast := type(network) is FastNetwork:
        vehicle.lane_index = network.get_closest_lane_index(vehicle.position, vehicle.heading, vehicle.lane_index)
        vehicle.lane = network.get_lane(vehicle.lane_index)
    return fast


def _move(vehicle: Any, dt: float) -> None:
    """``Vehicle.step`` of highway-env."""
    vehicle.clip_actions()
    beta = math.atan(math.tan(vehicle.action["steering"]) / 2)
    x, y = vehicle.position.tolist()
    course = vehicle.heading + beta
    vehicle.position = np.array((x + vehicle.speed * math.cos(course) * dt, y + vehicle.speed * math.sin(course) * dt))
    if vehicle.impact is not None:
        vehicle.position += vehicle.impact
        vehicle.crashed = True
        vehicle.impact = None
    vehicle.heading += vehicle.speed * math.sin(beta) / (vehicle.LENGTH / 2) * dt
    vehicle.speed += vehicle.action["acceleration"] * dt
    vehicle.on_state_update()


class FastVehicle(IDMVehicle):
    """Other drivers."""

    position: Any
    impact: Any
    crashed: Any

    def act(self, action: Any = None) -> None:
        if self.crashed:
            return
        self.follow_road()
        if self.enable_lane_change:
            self.change_lane_policy()
        front, rear = self.road.neighbour_vehicles(self, self.lane_index)
        pull = self.acceleration(self, front, rear)
        if self.lane_index != self.target_lane_index:
            front, rear = self.road.neighbour_vehicles(self, self.target_lane_index)
            pull = min(pull, self.acceleration(self, front, rear))
        turn = self.steering_control(self.target_lane_index)
        self.action = {"steering": turn, "acceleration": _clip(pull, -self.ACC_MAX, self.ACC_MAX)}

    def steering_control(self, target_lane_index: LaneIndex) -> float:
        lane = self.road.network.get_lane(target_lane_index)
        s, r = lane.local_coordinates(self.position)
        ahead = lane.heading_at(s + self.speed * self.TAU_PURSUIT)
        speed = utils.not_zero(self.speed)
        command = math.asin(_clip(-self.KP_LATERAL * r / speed, -1, 1))
        heading = ahead + _clip(command, -math.pi / 4, math.pi / 4)
        rate = self.KP_HEADING * _wrap(heading - self.heading)
        slip = math.asin(_clip(self.LENGTH / 2 / speed * rate, -1, 1))
        return _clip(math.atan(2 * math.tan(slip)), -self.MAX_STEERING_ANGLE, self.MAX_STEERING_ANGLE)

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        if not hasattr(ego_vehicle, "action"):  # no vehicle, or an obstacle
            return 0
        wanted = getattr(ego_vehicle, "target_speed", 0)
        if ego_vehicle.lane and ego_vehicle.lane.speed_limit is not None:
            wanted = _clip(wanted, 0, ego_vehicle.lane.speed_limit)
        pull = self.COMFORT_ACC_MAX * (1 - math.pow(max(ego_vehicle.speed, 0) / abs(utils.not_zero(wanted)), self.DELTA))
        if front_vehicle:
            gap = self.desired_gap(ego_vehicle, front_vehicle) / utils.not_zero(ego_vehicle.lane_distance_to(front_vehicle))
            pull -= self.COMFORT_ACC_MAX * gap * gap
        return pull

    def desired_gap(self, ego_vehicle: Any, front_vehicle: Any = None, projected: bool = True) -> float:
        speed = ego_vehicle.speed
        turned = math.cos(front_vehicle.heading - ego_vehicle.heading) if projected else 1
        closing = speed - front_vehicle.speed * turned
        both = math.sqrt(-self.COMFORT_ACC_MAX * self.COMFORT_ACC_MIN)
        return self.DISTANCE_WANTED + speed * self.TIME_WANTED + speed * closing / (2 * both)

    def step(self, dt: float) -> None:
        self.timer += dt
        _move(self, dt)

    def on_state_update(self) -> None:
        if not _updated(self):
            super().on_state_update()


class FastController(MDPVehicle):
    """Controlled vehicle."""

    steering_control = FastVehicle.steering_control

    def step(self, dt: float) -> None:
        _move(self, dt)

    def on_state_update(self) -> None:
        if self.road.record_history or not _updated(self):
            super().on_state_update()


SLACK = 1e-6
"""Metres that distances of vehicles may be wrong by, through rounding."""


def _apart(one: Any, other: Any, dt: float) -> bool:
    """Whether two rectangles do not touch during a step, as a side of one separates them: the test of ``RoadObject._is_colliding``.

    False within :data:`SLACK` of touching.
    """
    x, y = (other.position - one.position).tolist()
    cos, sin, there_cos, there_sin = math.cos(one.heading), math.sin(one.heading), math.cos(other.heading), math.sin(other.heading)
    move_x = (one.speed * cos - other.speed * there_cos) * dt
    move_y = (one.speed * sin - other.speed * there_sin) * dt
    along, across = abs(cos * there_cos + sin * there_sin) / 2, abs(cos * there_sin - sin * there_cos) / 2
    length, width, there_length, there_width = one.LENGTH, one.WIDTH, other.LENGTH, other.WIDTH
    for axis_x, axis_y, reach in (
        (cos, sin, length / 2 + there_length * along + there_width * across),
        (-sin, cos, width / 2 + there_length * across + there_width * along),
        (there_cos, there_sin, there_length / 2 + length * along + width * across),
        (-there_sin, there_cos, there_width / 2 + length * across + width * along),
    ):
        gap, moved = x * axis_x + y * axis_y, move_x * axis_x + move_y * axis_y
        if gap - max(moved, 0.0) > reach + SLACK or gap - min(moved, 0.0) < -reach - SLACK:
            return True
    return False


class FastRoad(Road):
    """Road that caches the vehicles per lane and checks only near pairs for collisions.

    Attributes:
        until_crash: a vehicle after whose crash nothing moves, for look-ahead; ``None`` for no such vehicle.
    """

    until_crash: Any = None

    def act(self) -> None:
        if self.until_crash is not None and self.until_crash.crashed:
            return
        # Vehicles do not move while deciding.
        self._on_lane: dict[LaneIndex, list[tuple[float, RoadObject]]] | None = {}
        self._places = [(v, *v.position.tolist()) for v in self.vehicles + self.objects if not isinstance(v, Landmark)]
        super().act()
        self._on_lane = None

    def neighbour_vehicles(self, vehicle: Any, lane_index: LaneIndex | None = None) -> tuple[Any, Any]:
        lane_index = lane_index or vehicle.lane_index
        known: dict[LaneIndex, list[tuple[float, RoadObject]]] | None = getattr(self, "_on_lane", None)
        if known is None or self.neighbour_vehicles_connected_lanes or not lane_index:
            return super().neighbour_vehicles(vehicle, lane_index)
        lane = self.network.get_lane(lane_index)
        if lane_index not in known:
            known[lane_index] = self._along(lane)
        s = lane.local_coordinates(vehicle.position)[0]
        front, rear, v_front, v_rear = math.inf, -math.inf, None, None
        for s_v, v in known[lane_index]:
            if v is vehicle:
                continue
            if s_v >= s:
                if s_v <= front:
                    front, v_front = s_v, v
            elif s_v > rear:
                rear, v_rear = s_v, v
        return v_front, v_rear

    def _along(self, lane: Any) -> list[tuple[float, RoadObject]]:
        there, width, first, last = [], lane.width / 2 + 1, -lane.VEHICLE_LENGTH, lane.length + lane.VEHICLE_LENGTH
        for v, x, y in self._places:
            s, r = lane._local(x, y)
            if abs(r) <= width and first <= s < last:
                there.append((s, v))
        return there

    def step(self, dt: float) -> None:
        if self.until_crash is not None and self.until_crash.crashed:
            return
        for vehicle in self.vehicles:
            vehicle.step(dt)
        things = [(thing, thing.position.tolist(), float(thing.diagonal)) for thing in self.vehicles + self.objects]
        for i, (vehicle, (x, y), size) in enumerate(things[: len(self.vehicles)]):
            # As in RoadObject._is_colliding, with a margin for rounding: farther pairs cannot collide.
            reach = size / 2 + vehicle.speed * dt + SLACK
            for thing, (there_x, there_y), extent in things[i + 1 :]:
                if math.hypot(there_x - x, there_y - y) <= reach + extent / 2 and not _apart(vehicle, thing, dt):
                    vehicle.handle_collisions(thing, dt)


class FastRegulatedRoad(FastRoad, RegulatedRoad):
    """Regulated road that predicts each trajectory once and checks only pairs of vehicles that come near each other."""

    def step(self, dt: float) -> None:
        self.steps += 1
        if self.steps % int(1 / dt / self.REGULATION_FREQUENCY) == 0:
            self.enforce_road_rules()
        FastRoad.step(self, dt)

    def enforce_road_rules(self) -> None:
        times = np.arange(0.25, 3, 0.25)  # as in is_conflict_possible
        ways = [vehicle.predict_trajectory_constant_speed(times) for vehicle in self.vehicles]
        places = np.array([positions for positions, _ in ways])
        gaps = ((places[:, None] - places[None]) ** 2).sum(axis=-1)
        self._near = gaps <= np.array([vehicle.LENGTH**2 for vehicle in self.vehicles])[:, None, None]
        self._ever = self._near.any(axis=-1).tolist()
        self._ways = {id(vehicle): (row, *way) for row, (vehicle, way) in enumerate(zip(self.vehicles, ways, strict=True))}
        super().enforce_road_rules()

    def is_conflict_possible(self, v1: Any, v2: Any, horizon: int = 3, step: float = 0.25) -> bool | None:
        row_1, at_1, heading_1 = self._ways[id(v1)]
        row_2, at_2, heading_2 = self._ways[id(v2)]
        if self._ever[row_1][row_2]:
            for k in self._near[row_1, row_2].nonzero()[0].tolist():
                if utils.rotated_rectangles_intersect(
                    (at_1[k], 1.5 * v1.LENGTH, 0.9 * v1.WIDTH, heading_1[k]),
                    (at_2[k], 1.5 * v2.LENGTH, 0.9 * v2.WIDTH, heading_2[k]),
                ):
                    return True
        return None


_ROADS = {Road: FastRoad, RegulatedRoad: FastRegulatedRoad}


def accelerate(road: Road) -> None:
    """Convert a road and its network, lanes and controlled vehicle."""
    network = road.network
    for lane in network.lanes_list():
        if type(lane) in (StraightLane, SineLane):
            lane._line = (*map(float, lane.start), *map(float, lane.direction))
        elif type(lane) is CircularLane:
            lane._centre = tuple(map(float, lane.center))
        lane.__class__ = _LANES.get(type(lane), type(lane))
    network._lanes = list(network.lanes_dict().items())
    network._circles = [_circle(lane) for _, lane in network._lanes]
    network.__class__ = FastNetwork
    road.__class__ = _ROADS.get(type(road), type(road))
    for vehicle in road.vehicles:
        if type(vehicle) is MDPVehicle:
            vehicle.__class__ = FastController


MARGIN = 8.0
"""Metres around lanes for gaps between sampled points, and inexact distances beyond the ends of sine lanes."""


def _circle(lane: Any) -> tuple[float, float, float]:
    """Centre and radius of a circle around a lane's centre line."""
    line = np.array([lane.position(s, 0) for s in np.linspace(0, lane.length, 50)])
    middle = (line.min(axis=0) + line.max(axis=0)) / 2
    return float(middle[0]), float(middle[1]), float(np.linalg.norm(line - middle, axis=1).max()) + MARGIN
