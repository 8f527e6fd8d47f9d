"""Pybullet bodies of the table-top."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.agent.environment import bowl
from ftl_lightning.domains.execution import Simulator, pybullet
from ftl_lightning.domains.tabletop.scenes import (
    BOOK,
    BOWL,
    CIRCLE,
    COLUMNS,
    HEIGHT,
    OBJECTS,
    RADIUS,
    SIZE,
    TRIANGLE,
    WHITE,
    support,
)

STEP = 1 / 240  # Duration of a simulation step in seconds
FASTEST = 0.02  # Maximum hand movement in metres per step of an episode; longer moves are shortened
MASS = {CIRCLE: 0.06, TRIANGLE: 0.15, BOOK: 0.35, WHITE: 0.0, BOWL: 0.0}  # Masses in kg; objects of zero mass are fixed
FRICTION = {CIRCLE: 0.5, TRIANGLE: 0.6, BOOK: 0.5, WHITE: 0.6, BOWL: 0.6}
TABLE_FRICTION, FINGER_FRICTION = 0.5, 0.9
COUPLING = 50.0
"""Maximum force in newtons of the gear between the fingers. Without it, a held object drifts by up to 14 mm to either side."""
COLOUR = {
    CIRCLE: (0.10, 0.60, 0.20),
    TRIANGLE: (0.95, 0.50, 0.05),
    BOOK: (0.20, 0.30, 0.65),
    WHITE: (0.97, 0.97, 0.97),
    BOWL: (0.50, 0.15, 0.60),
}
TABLE_COLOUR = (0.62, 0.55, 0.47)
MARGIN = 0.001  # Collision margin in metres around the triangle's hull
MOVING = (CIRCLE, TRIANGLE, BOOK)
WALLS = 12  # Boxes that approximate the bowl's wall for collisions; the visual shape is round

ARM = tuple(range(7))
FINGERS = (9, 10)
TIP = 11  # Link between the fingertips, 7 mm above their ends
REST = (0.0, 0.1, 0.0, -2.4, 0.0, 2.5, 0.785)  # Initial joint angles of inverse kinematics


@dataclass(frozen=True)
class Bodies:
    """Body identifiers in the simulator: the arm, and present objects by name."""

    robot: int
    objects: dict[str, int]


def build(client: Simulator, scene: NDArray[np.float32], arm_drawn: bool, coupled: bool) -> Bodies:
    """Build a valid scene after a full reset of the simulator.

    Args:
        arm_drawn: whether images show the arm; without it, images take a twentieth of the time.
        coupled: whether the fingers are coupled, see :data:`COUPLING`.
    """
    import pybullet_data

    client.resetSimulation()
    client.setGravity(0, 0, -9.81)
    client.setPhysicsEngineParameter(fixedTimeStep=STEP, deterministicOverlappingPairs=1)
    _box(client, (0.9, 1.0, 0.04), (0.5, 0.0, -0.02), TABLE_COLOUR, 0.0, TABLE_FRICTION)
    # Collision shapes load faster than visual shapes; they are made invisible.
    flags = 0 if arm_drawn else pybullet().URDF_IGNORE_VISUAL_SHAPES
    panda = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    robot: int = client.loadURDF(str(panda), [0, 0, 0], useFixedBase=True, flags=flags)
    for link in () if arm_drawn else range(-1, client.getNumJoints(robot)):
        client.changeVisualShape(robot, link, rgbaColor=[1, 1, 1, 0])
    for finger in FINGERS:
        client.changeDynamics(robot, finger, lateralFriction=FINGER_FRICTION)
    if coupled:
        _couple(client, robot)
    objects = {name: _object(client, scene, name, arm_drawn) for name in OBJECTS if scene[COLUMNS[name]][0] > 0.5}
    return Bodies(robot, objects)


def _couple(client: Simulator, robot: int) -> None:
    """Couple the fingers, as the gear of the real gripper does."""
    gear = {"jointType": pybullet().JOINT_GEAR, "jointAxis": [1, 0, 0]}
    frames = {"parentFramePosition": [0, 0, 0], "childFramePosition": [0, 0, 0]}
    coupling = client.createConstraint(robot, FINGERS[0], robot, FINGERS[1], **gear, **frames)
    client.changeConstraint(coupling, gearRatio=-1, erp=0.1, maxForce=COUPLING)


def turned(yaw: float) -> tuple[float, float, float, float]:
    """Quaternion of an object with a yaw."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def downward(yaw: float) -> tuple[float, float, float, float]:
    """Quaternion of the downward hand with a yaw."""
    return math.cos(yaw / 2), math.sin(yaw / 2), 0.0, 0.0


def _box(
    client: Simulator,
    size: tuple[float, float, float],
    place: tuple[float, float, float],
    colour: tuple[float, ...],
    mass: float,
    friction: float,
    yaw: float = 0.0,
) -> int:
    half = [edge / 2 for edge in size]
    shape = client.createCollisionShape(pybullet().GEOM_BOX, halfExtents=half)
    visual = client.createVisualShape(pybullet().GEOM_BOX, halfExtents=half, rgbaColor=[*colour, 1])
    body: int = client.createMultiBody(mass, shape, visual, place, turned(yaw))
    client.changeDynamics(body, -1, lateralFriction=friction)
    return body


def _object(client: Simulator, scene: NDArray[np.float32], name: str, edged: bool) -> int:
    """Build an object; ``edged`` draws circle and triangle with sharp edges for films, instead of smooth shading."""
    x, y, yaw = map(float, scene[COLUMNS[name]][1:])
    height, colour = HEIGHT[name], [*COLOUR[name], 1]
    place = (x, y, support(scene, name) + height / 2)
    if name in SIZE:
        return _box(client, (*SIZE[name], height), place, COLOUR[name], MASS[name], FRICTION[name], yaw)
    if name == CIRCLE:
        shape = client.createCollisionShape(pybullet().GEOM_CYLINDER, radius=RADIUS[name], height=height)
        visual = client.createVisualShape(pybullet().GEOM_CYLINDER, radius=RADIUS[name], length=height, rgbaColor=colour)
        if edged:
            drawn = _edged(_corners(RADIUS[name], height / 2, ROUND))
            visual = client.createVisualShape(pybullet().GEOM_MESH, **drawn, rgbaColor=colour)
    elif name == TRIANGLE:
        vertices = _corners(RADIUS[name] - 2 * MARGIN, height / 2 - MARGIN, 3).tolist()  # corners move twice as far as sides
        shape = client.createCollisionShape(pybullet().GEOM_MESH, vertices=vertices)
        smooth: dict[str, list[Any]] = {"vertices": _corners(RADIUS[name], height / 2, 3).tolist(), "indices": _PRISM_SIDES}
        drawn = _edged(_corners(RADIUS[name], height / 2, 3)) if edged else smooth
        visual = client.createVisualShape(pybullet().GEOM_MESH, **drawn, rgbaColor=colour)
    else:
        shape = _bowl_shape(client)
        vertices, triangles = bowl(RADIUS[name], height / 2, 0.006)
        upright = [[a, -c, b] for a, b, c in vertices]  # from y up to z up
        visual = client.createVisualShape(pybullet().GEOM_MESH, vertices=upright, indices=triangles, rgbaColor=colour)
    body: int = client.createMultiBody(MASS[name], shape, visual, place, turned(yaw))
    client.changeDynamics(body, -1, lateralFriction=FRICTION[name])
    if name == TRIANGLE:
        client.changeDynamics(body, -1, collisionMargin=MARGIN)
    return body


ROUND = 48  # Corners of a circle drawn with edges


def _corners(radius: float, half: float, count: int) -> NDArray[np.float64]:
    """Corners of an upright prism ``(2 * count, 3)``, lower face first."""
    angles = 2 * np.pi * np.arange(count) / count
    flat = radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    return np.concatenate([np.pad(flat, ((0, 0), (0, 1)), constant_values=z) for z in (-half, half)])


def _edged(corners: NDArray[np.float64]) -> dict[str, list[Any]]:
    """Arguments of a visual shape of an upright prism without shared vertices, so that no shading crosses an edge."""
    count = len(corners) // 2
    below, above = corners[:count], corners[count:]
    faces = [(above[0], above[i], above[i + 1]) for i in range(1, count - 1)]
    faces += [(below[0], below[i + 1], below[i]) for i in range(1, count - 1)]
    for i in range(count):
        j = (i + 1) % count
        faces += [(below[i], below[j], above[j]), (below[i], above[j], above[i])]
    normals = np.array([np.cross(b - a, c - a) for a, b, c in faces])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return {
        "vertices": np.array(faces).reshape(-1, 3).tolist(),
        "indices": list(range(3 * len(faces))),
        "normals": normals.repeat(3, axis=0).tolist(),
    }


_PRISM_SIDES = [0, 2, 1, 3, 4, 5, 0, 1, 4, 0, 4, 3, 1, 2, 5, 1, 5, 4, 2, 0, 3, 2, 3, 5]


def _bowl_shape(client: Simulator) -> int:
    half, thickness, radius = HEIGHT[BOWL] / 2, 0.006, RADIUS[BOWL]
    angles = [2 * math.pi * number / WALLS for number in range(WALLS)]
    walls = [[thickness / 2, radius * math.tan(math.pi / WALLS), half]] * WALLS
    places = [[(radius - thickness / 2) * math.cos(angle), (radius - thickness / 2) * math.sin(angle), 0.0] for angle in angles]
    shape: int = client.createCollisionShapeArray(
        shapeTypes=[pybullet().GEOM_BOX] * (WALLS + 1),
        halfExtents=[*walls, [radius / 2, radius / 2, thickness / 2]],
        collisionFramePositions=[*places, [0.0, 0.0, thickness / 2 - half]],
        collisionFrameOrientations=[*(turned(angle) for angle in angles), turned(0.0)],
    )
    return shape
