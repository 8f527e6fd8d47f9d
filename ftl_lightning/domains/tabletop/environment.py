"""Gymnasium environment of a Panda arm at a table, simulated by pybullet."""

from collections.abc import Collection, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.execution import Simulator, pybullet
from ftl_lightning.domains.tabletop.interface import (
    ACTION,
    BESIDE,
    FEATURES,
    FRONT,
    HERTZ,
    IMAGE,
    LIFT,
    MAX_STEPS,
    OPEN,
    OVERHEAD,
    POSE,
    PUSH,
    PUSH_ON_BOOK,
    PUSHES,
    THRESHOLD,
    check_task,
)
from ftl_lightning.domains.tabletop.scenes import (
    BESIDE_AT,
    BOOK,
    BOWL,
    CIRCLE,
    COLUMNS,
    HAND,
    HEIGHT,
    OBJECTS,
    SCENE,
    TARGET,
    TRIANGLE,
    check,
    draw_scene,
    gap,
    outline,
    support,
    within,
)
from ftl_lightning.domains.tabletop.world import ARM, FASTEST, FINGERS, REST, TIP, Bodies, build, downward, turned
from ftl_lightning.services.errors import UserError, require

TARGETS, SUBSTEPS = 3, 8  # Arm targets per step, and simulation steps per target
ITERATIONS = 20  # Maximum iterations of inverse kinematics per target
GAIN = 0.1
FORCE = 20.0  # Force of a finger in newtons
REACH = ((0.25, 0.78), (-0.36, 0.36), (0.008, 0.4))  # Ranges of the hand position in metres
TOUCH = 0.003  # Maximum gap in metres between circle and triangle that counts as contact
LIFTED, AWAY, STILL = 0.02, 0.05, 0.001
"""Thresholds in metres: rise of a lifted circle; height of the open hand above a released circle, and the circle's maximum movement
per step."""
RECYCLE = 200  # Scenes after which the simulator is restarted, since it leaks memory

Seen = dict[str, NDArray[Any]]  # Observed features by name


class TableTopEnvironment(gymnasium.Env[Seen, NDArray[np.float32]]):
    """An arm, a table and objects.

    Observations are :data:`FEATURES`. An action is the target position of the hand in 0.1 s and the gripper opening; the hand
    points down with constant yaw. An episode is a function of scene and actions alone. It ends when the circle touches the
    triangle or is released, and after :data:`MAX_STEPS` steps; the simulation can continue. Every instance has a separate
    simulator, without display; a ``UserError`` if it does not start.

    Keys of the info: positions of ``circle``, ``triangle`` and book (``book place``), ``None`` for absent objects; displacement of
    the ``book`` in metres; whether the circle ``touched`` the triangle, and names of all touched objects (``touches``); whether
    the circle was ``lifted`` and is ``released``; the ``trace``, joint angles and object poses at each step, for films.

    Args:
        arm_drawn: whether images show the arm, which hides much of the table from above.
        ends_at: objects whose contact with the circle ends an episode.
        coupled: whether both fingers of the gripper always have the same opening, as on the real arm.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": HERTZ}  # noqa: RUF012 (gymnasium's)
    render_mode = "rgb_array"
    _image = gymnasium.spaces.Box(0, 255, FEATURES[IMAGE].shape, np.uint8)
    _pose = gymnasium.spaces.Box(-np.inf, np.inf, FEATURES[POSE].shape, np.float32)
    observation_space: gymnasium.spaces.Space[Any] = gymnasium.spaces.Dict({IMAGE: _image, POSE: _pose})
    action_space = gymnasium.spaces.Box(*np.array([*REACH, (0.0, OPEN)], dtype=np.float32).T)

    def __init__(self, arm_drawn: bool = False, ends_at: Collection[str] = (TRIANGLE,), coupled: bool = False) -> None:
        self.arm_drawn, self.ends_at, self.coupled = arm_drawn, frozenset(ends_at), coupled
        self.client = self._connected()
        self.scene = np.zeros(SCENE, dtype=np.float32)
        self.bodies = Bodies(-1, {})
        self.command = np.zeros(ACTION)
        self._built = 0
        self._trace: list[NDArray[np.float64]] = []

    @staticmethod
    def _connected() -> Simulator:
        try:
            return Simulator()
        except pybullet().error as error:
            raise UserError(f"table-top: the physics simulator does not start ({error}); close some of its instances") from error

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Build a scene; raise a ``UserError`` for an invalid scene, see :func:`~ftl_lightning.domains.tabletop.scenes.check`.

        Args:
            seed: seed of a drawn scene.
            options: ``scene``, 24 numbers; or ``task``, whose scene is drawn (default 'push green circle to orange triangle').
        """
        super().reset(seed=seed)
        if (scene := (options or {}).get("scene")) is None:
            scene = draw_scene(check_task((options or {}).get("task", PUSH)), self.np_random)
        self.scene = check(scene).copy()
        if self._built == RECYCLE:
            self.client.disconnect()
            self.client, self._built = self._connected(), 0
        self._built += 1
        self.bodies = build(self.client, self.scene, self.arm_drawn, self.coupled)
        self._place(self.scene[HAND][:3].astype(np.float64), OPEN)
        return self.begun(), self._info()

    def _place(self, hand: NDArray[np.float64], opening: float) -> None:
        """Set the hand position without simulation."""
        robot = self.bodies.robot
        for joint, angle in zip((*ARM, *FINGERS), (*REST, opening / 2, opening / 2), strict=True):
            self.client.resetJointState(robot, joint, angle)
        self.command = np.array([*map(float, hand), opening])
        for _ in range(10):  # each search starts from the previous solution
            for joint, angle in zip(ARM, self._angles(self.command[:3]), strict=True):
                self.client.resetJointState(robot, joint, angle)

    def _angles(self, place: NDArray[np.float64]) -> list[float]:
        """Joint angles of a hand position, by inverse kinematics."""
        turn, limits = downward(float(self.scene[HAND][3])), {"maxNumIterations": ITERATIONS, "residualThreshold": 1e-5}
        return list(self.client.calculateInverseKinematics(self.bodies.robot, TIP, place.tolist(), turn, **limits)[: len(ARM)])

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Move for 0.1 s. The reward is 0: success depends on the task, which the environment does not know."""
        values = np.asarray(action, dtype=np.float64)
        valid = values.shape == (ACTION,) and np.isfinite(values).all()
        require(valid, "table-top action", f"{ACTION} finite numbers", values.tolist())
        before = self.command[:3]
        move = np.clip(values[:3], *np.transpose(REACH)) - before
        move *= min(1.0, FASTEST / max(float(np.linalg.norm(move)), 1e-9))
        opening = OPEN if values[3] > THRESHOLD else 0.0
        self.command = np.array([*(before + move), opening])
        robot, mode, drive = self.bodies.robot, pybullet().POSITION_CONTROL, self.client.setJointMotorControlArray
        drive(robot, FINGERS, mode, targetPositions=[opening / 2] * 2, forces=[FORCE] * 2)
        strength = {"forces": [87.0] * 4 + [12.0] * 3, "positionGains": [GAIN] * len(ARM)}
        for part in range(1, TARGETS + 1):
            drive(robot, ARM, mode, targetPositions=self._angles(before + move * part / TARGETS), **strength)
            for _ in range(SUBSTEPS):
                self.client.stepSimulation()
        self._steps += 1
        places = self.places()
        self._touched |= {name for name in places if name != CIRCLE and self._touches(name, places)}
        self._lifted |= bool(places[CIRCLE][2] > self._first[CIRCLE][2] + LIFTED)
        self._trace.append(self._now())
        info = self._info()
        self._before = places[CIRCLE]
        ended = bool(self.ends_at & self._touched) or (self._lifted and info["released"])
        return self._observation(), 0.0, ended, self._steps >= MAX_STEPS, info

    def places(self) -> dict[str, NDArray[np.float64]]:
        """Centres ``(3,)`` of the objects, by name."""
        positions = {name: self.client.getBasePositionAndOrientation(body)[0] for name, body in self.bodies.objects.items()}
        return {name: np.array(place) for name, place in positions.items()}

    def seen(self) -> NDArray[np.float32]:
        """Visibility and centre of each of the five objects: ``(5, 4)``."""
        rows = np.zeros((len(OBJECTS), 4), dtype=np.float32)
        for name, place in self.places().items():
            if all(low <= value <= high for value, (low, high) in zip(place, REACH, strict=False)):
                rows[OBJECTS.index(name)] = (1.0, *place)
        return rows

    def put(self, hand: NDArray[np.float64], circle: NDArray[np.float64], opening: float = 0.0) -> Seen:
        """Start an episode with given hand position ``(3,)``, opening, and circle centre ``(2,)``; return the observation."""
        place = [*map(float, circle), self._first[CIRCLE][2]]
        self.client.resetBasePositionAndOrientation(self.bodies.objects[CIRCLE], place, turned(0.0))
        self._place(hand, opening)
        return self.begun()

    def begun(self) -> Seen:
        """Start an episode in the current state and return the observation."""
        self._steps, self._lifted = 0, False
        self._touched: set[str] = set()
        self._first = self.places()
        self._before = self._first[CIRCLE]
        self._trace = [self._now()]
        return self._observation()

    def _touches(self, name: str, places: dict[str, NDArray[np.float64]]) -> bool:
        """Whether the circle touches the side of an object from above, at the object's height; not in it or on it."""
        circle, place, shape = places[CIRCLE], places[name], self.outline(name)
        level = abs(circle[2] - place[2]) < LIFTED if name == TRIANGLE else circle[2] < place[2] + HEIGHT[name] / 2
        return level and touching(shape, circle) and not within(circle[None, :2], shape)

    def outline(self, name: str) -> NDArray[np.float64]:
        """Current outline of an object, see :func:`~ftl_lightning.domains.tabletop.scenes.outline`."""
        place, turn = self.client.getBasePositionAndOrientation(self.bodies.objects[name])
        return outline(name, place[0], place[1], pybullet().getEulerFromQuaternion(turn)[2])

    def hand(self) -> NDArray[np.float64]:
        """Measured position, quaternion and opening ``(8,)``."""
        link = self.client.getLinkState(self.bodies.robot, TIP, computeForwardKinematics=1)
        opening = sum(state[0] for state in self.client.getJointStates(self.bodies.robot, FINGERS))
        return np.array([*link[4], *link[5], opening])

    def _observation(self) -> Seen:
        picture = OVERHEAD.picture(self.client)
        return {IMAGE: np.ascontiguousarray(picture.transpose(2, 0, 1)), POSE: self.hand().astype(np.float32)}

    def _info(self) -> dict[str, Any]:
        places, hand = self.places(), self.hand()
        circle = places[CIRCLE]
        released = hand[7] > THRESHOLD and hand[2] > circle[2] + AWAY
        moved = float(np.linalg.norm(places[BOOK] - self._first[BOOK])) if BOOK in places else 0.0
        return {
            "circle": circle,
            "triangle": places.get(TRIANGLE),
            "book": moved,
            "book place": places.get(BOOK),
            "touched": TRIANGLE in self._touched,
            "touches": frozenset(self._touched),
            "lifted": self._lifted,
            "released": bool(released and np.linalg.norm(circle - self._before) < STILL and self._steps),
            "trace": self._trace,
        }

    def _now(self) -> NDArray[np.float64]:
        joints = [state[0] for state in self.client.getJointStates(self.bodies.robot, (*ARM, *FINGERS))]
        poses = [self.client.getBasePositionAndOrientation(body) for body in self.bodies.objects.values()]
        return np.array([*joints, *(value for place, turn in poses for value in (*place, *turn))])

    def show(self, moment: NDArray[np.float64]) -> None:
        """Set arm and objects to a state of a trace of this scene, for rendering."""
        joints, poses = np.split(moment, [len(ARM) + len(FINGERS)])
        for joint, angle in zip((*ARM, *FINGERS), joints, strict=True):
            self.client.resetJointState(self.bodies.robot, joint, angle)
        for body, pose in zip(self.bodies.objects.values(), poses.reshape(-1, 7), strict=True):
            self.client.resetBasePositionAndOrientation(body, pose[:3].tolist(), pose[3:].tolist())

    def render(self) -> NDArray[np.uint8]:
        """Front view ``(240, 320, 3)``, with the arm if ``arm_drawn``."""
        return FRONT.picture(self.client, shadow=True)

    def close(self) -> None:
        """Stop the simulator."""
        if self.client.isConnected():
            self.client.disconnect()


def touching(shape: NDArray[np.float64], circle: NDArray[np.float64]) -> bool:
    """Whether a circle with this centre touches an outline, seen from above."""
    return gap(outline(CIRCLE, float(circle[0]), float(circle[1]), 0.0), shape) <= TOUCH


LEVEL = 0.008  # Tolerance in metres of the circle's height on a surface
BY = 0.03  # Maximum centre distance in metres between the circle and the object beside it, above that of the expert
HELD = 0.1  # Minimum height in metres of the centre of a lifted circle at the end
CENTRED = 0.02  # Maximum offset in metres of the circle from the centre of the triangle under it, or of the bowl around it


def judged(task: str, scene: NDArray[np.float32], info: Mapping[str, Any]) -> bool:
    """Whether a task is done.

    - Pushes to the triangle: circle and triangle touch (:data:`TOUCH`); both are still on their initial surface.
    - Pushes to another object: the circle has touched only this object, and lies on the table.
    - Picks to the book and to the white surface: the circle was lifted and released; it lies on the surface, its centre over it.
    - Picks to the triangle and to the bowl: the same; it lies on or in it, at most :data:`CENTRED` off its centre.
    - Picks beside an object: the circle was lifted and released; it lies on the table, its centre near the object.
    - Lift: at the end the circle is in the hand, at least :data:`HELD` above the table.

    ``scene (24,)`` is the initial scene, ``info`` that of the last step, empty without a step.
    """
    check_task(task)
    if not info:
        return False
    circle = info["circle"]
    if task in PUSHES and TARGET[task] != TRIANGLE:
        return set(info["touches"]) == {TARGET[task]} and _lies(circle, 0.0)
    if task in PUSHES:
        surface = HEIGHT[BOOK] if task == PUSH_ON_BOOK else support(scene, CIRCLE)
        both = (circle, info["triangle"])
        return bool(info["touched"]) and all(place is not None and _lies(place, surface) for place in both)
    if task == LIFT:
        return bool(info["lifted"]) and not info["released"] and float(circle[2]) >= HELD
    if not (info["lifted"] and info["released"]):
        return False
    name = TARGET[task]
    x, y, yaw = map(float, scene[COLUMNS[name]][1:])
    moved = info["triangle"] if name == TRIANGLE else info["book place"] if name == BOOK else None
    if moved is not None:
        x, y = map(float, moved[:2])
    distance = float(np.linalg.norm(circle[:2] - (x, y)))
    if task in BESIDE:
        return _lies(circle, 0.0) and distance <= BESIDE_AT[name] + BY
    if name == BOWL:
        return float(circle[2]) < HEIGHT[BOWL] and distance <= CENTRED
    if name == TRIANGLE:
        return _lies(circle, HEIGHT[name]) and distance <= CENTRED
    return _lies(circle, HEIGHT[name]) and within(circle[None, :2], outline(name, x, y, yaw))


def _lies(place: NDArray[np.float64], surface: float) -> bool:
    """Whether the centre of circle or triangle has the height of flat contact with a surface."""
    return abs(float(place[2]) - surface - HEIGHT[CIRCLE] / 2) <= LEVEL
