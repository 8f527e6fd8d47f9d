"""Scenarios with rules that the wide model is pretrained on, and one for validation; none is a scenario of :mod:`.rules`."""

from typing import Any

from highway_env.vehicle.objects import Obstacle

from ftl_lightning.domains.driving.rules import WIDTH, Gate, Sign, Street


class Parked(Sign):
    """Parked car."""

    LENGTH, WIDTH = 5.0, 2.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.collidable = True


class StopAndGo(Street):
    """Follow a leader that halts for some seconds."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        return super().default_config() | {"duration": 24}

    def _build(self) -> None:
        self._lane(("a", "b"), (0, 0), (400, 0))
        self._ego(("a", "b", 0), 0, 8)
        self.cruise = self._uniform(6, 11)
        self._other(("a", "b", 0), self._uniform(25, 45), self.cruise)
        self.leader = self.road.vehicles[-1]
        self.halts = self._uniform(1, 5)
        self.goes = self.halts + self._uniform(3, 7)

    def _simulate(self, action: Any = None) -> None:
        self.leader.target_speed = 0.0 if self.halts <= self.time < self.goes else self.cruise
        super()._simulate(action)

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > 110)


class NarrowBridge(Street):
    """Cross a bridge of one lane, at which oncoming vehicles have priority."""

    LENGTH, MARGIN = 20.0, 2.0  # metres of the bridge, and seconds before an oncoming vehicle

    def _build(self) -> None:
        self._lane(("a", "b"), (0, WIDTH), (300, WIDTH))
        self._lane(("b", "a"), (300, 0), (0, 0))
        self.place = self._uniform(40, 55)
        self._ego(("a", "b", 0), 0, 8)
        at = 300 - self.place - self.LENGTH - self._uniform(10, 60)
        for _ in range(int(self.np_random.integers(0, 4))):
            self._other(("b", "a", 0), at, self._uniform(8, 12))
            at -= self._uniform(15, 45)
        self.road.vehicles.append(Sign.make_on_lane(self.road, ("a", "b", 0), self.place - 3, 0))

    def _offends(self, before: Any) -> bool:
        end = self.place + self.LENGTH
        if not self.place <= self.vehicle.position[0] <= end:
            return False
        return any(self.place < vehicle.position[0] < end + self.MARGIN * vehicle.speed for vehicle in self._others_at(0))

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.place + self.LENGTH + 15)


class ParkedCar(Street):
    """Pass a parked car on a two-way road with oncoming vehicles, and return to the right lane."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        return super().default_config() | {"duration": 20}

    def _build(self) -> None:
        for number in range(2):
            self._lane(("a", "b"), (0, number * WIDTH), (400, number * WIDTH))
        self._lane(("b", "a"), (400, 0), (0, 0))
        self._ego(("a", "b", 1), 20, 8)
        self.place = self._uniform(60, 80)
        self.road.vehicles.append(Parked.make_on_lane(self.road, ("a", "b", 1), self.place, 0))
        at = 400 - self.place - self._uniform(0, 60)
        for _ in range(int(self.np_random.integers(0, 4))):
            self._other(("b", "a", 0), at, self._uniform(8, 12))
            at -= self._uniform(25, 60)

    def arrived(self) -> bool:
        ego = self.vehicle
        return bool(ego.lane_index[2] == 1 and abs(ego.position[1] - WIDTH) < 1 and ego.position[0] > self.place + 10)


class LaneEnds(Street):
    """Change to the lane on the right before one's own lane ends; with less than 7 m to a vehicle of it, it is an offence."""

    END, GAP = 140.0, 7.0

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        return super().default_config() | {"duration": 24}

    def _build(self) -> None:
        self._lane(("a", "b"), (0, 0), (self.END, 0))
        self._lane(("a", "b"), (0, WIDTH), (self.END, WIDTH))
        self._lane(("b", "c"), (self.END, WIDTH), (400, WIDTH))
        self.road.objects.append(Obstacle(self.road, (self.END, 0)))
        self.road.vehicles.append(Sign(self.road, (self.END, 0)))  # the obstacle is not observed
        self._ego(("a", "b", 0), 10, 8)
        at, speed = self._uniform(30, 60), self._uniform(7, 11)
        for _ in range(4):
            self._other(("a", "b", 1), at, speed)
            at -= self._uniform(18, 40)
            if at < 0:
                break

    def _offends(self, before: Any) -> bool:
        if not self.vehicle.position[1] > WIDTH / 2 >= before[1]:
            return False
        return any(abs(vehicle.position[0] - self.vehicle.position[0]) < self.GAP for vehicle in self._others_at(WIDTH))

    def _reward(self, action: Any) -> float:
        earned = super()._reward(action)
        return earned + 0.3 * (earned > 0 and self.vehicle.position[1] > WIDTH / 2)

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.END + 10)


class StopSign(Street):
    """Halt in front of a sign, and go on."""

    ZONE = 15.0  # metres before the line in which to halt

    def _build(self) -> None:
        self._lane(("a", "b"), (0, 0), (200, 0))
        self.line = self._uniform(35, 60)
        self._ego(("a", "b", 0), 0, 8)
        self.vehicle.halted = False
        self.road.vehicles.append(Sign.make_on_lane(self.road, ("a", "b", 0), self.line, 0))
        if self._uniform(0, 1) < 0.5:
            self._other(("a", "b", 0), self.line + self._uniform(5, 30), self._uniform(6, 10))

    def _offends(self, before: Any) -> bool:
        ego = self.vehicle
        ego.halted |= bool(ego.speed < 1 and 0 < self.line - ego.position[0] < self.ZONE)
        return bool(not ego.halted and before[0] < self.line - 1 <= ego.position[0])

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.line + 20)


class Barrier(Gate):
    """Wait at a barrier until a train has passed; in three of ten scenes it is open. For validation."""

    def _build(self) -> None:
        self._lane(("a", "b"), (0, 0), (200, 0))
        self.place = self._uniform(45, 60)
        self.line = self.place - 8
        self._lane(("c", "d"), (self.place, -300), (self.place, 300))
        self._ego(("a", "b", 0), 0, 8)
        at, speed = 300 - self._uniform(20, 90), self._uniform(12, 16)
        self.train: list[Any] = []
        for _ in range(0 if self._uniform(0, 1) < 0.3 else int(self.np_random.integers(2, 6))):
            self._other(("c", "d", 0), at, speed)
            self.train.append(self.road.vehicles[-1])
            at -= 9
        if self.train:
            self.road.vehicles.append(Sign.make_on_lane(self.road, ("a", "b", 0), self.line, 0))

    def _open(self) -> bool:
        return all(vehicle.position[1] > 5 for vehicle in self.train)

    def arrived(self) -> bool:
        return bool(self.vehicle.position[0] > self.place + 15)
