"""Gymnasium environment in pybullet: a cone is pushed over a plane with two fixed objects."""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ftl_lightning.domains.agent import scenes
from ftl_lightning.domains.execution import Simulator, pybullet
from ftl_lightning.services.errors import UserError, require

BOWL_THICKNESS = 0.025
FLOOR = [2.2, 0.01, 1.1]
"""Half extents of the drawn floor."""
IMAGE = (200, 320)  # height and width of a rendered picture
Seen = dict[str, NDArray[np.float32]]
"""Observed features by name."""
Mesh = tuple[list[list[float]], list[int]]
"""Vertices ``[x, y, z]``, y up, and triangles as a flat list of vertex indices, counter-clockwise from outside."""
RINGS = 6  # of each surface of a bowl
SEGMENTS = 24  # of a full turn of a mesh


def revolve(profile: Sequence[tuple[float, float]]) -> Mesh:
    """Rotate a profile ``(radius, y)`` around the y axis, from the lower pole to the upper along the outside; both ends on the
    axis.
    """
    angles = [2 * math.pi * step / SEGMENTS for step in range(SEGMENTS)]
    vertices = [[radius * math.sin(angle), y, radius * math.cos(angle)] for radius, y in profile for angle in angles]
    triangles: list[int] = []
    for ring in range(len(profile) - 1):
        for step in range(SEGMENTS):
            here, right = ring * SEGMENTS + step, ring * SEGMENTS + (step + 1) % SEGMENTS
            above, above_right = here + SEGMENTS, right + SEGMENTS
            triangles += [here, right, above_right, here, above_right, above]
    return vertices, triangles


def cone(radius: float, half_height: float) -> Mesh:
    """Cone standing on its base, centred at half its height."""
    return revolve([(0.0, -half_height), (radius, -half_height), (0.0, half_height)])


def bowl(radius: float, half_height: float, thickness: float) -> Mesh:
    """Concave open shell between two half ellipsoids, centred at half its height, with its rim's outer radius."""
    height = 2 * half_height
    angles = [math.pi / 2 * ring / RINGS for ring in range(RINGS + 1)]
    outside = [(radius * math.sin(a), half_height - height * math.cos(a)) for a in angles]
    inside = [((radius - thickness) * math.sin(a), half_height - (height - thickness) * math.cos(a)) for a in reversed(angles)]
    return revolve([*outside, *inside])


MESHES = {"cone": cone(scenes.RADIUS["cone"], scenes.HEIGHT), "bowl": bowl(scenes.RADIUS["bowl"], scenes.HEIGHT, BOWL_THICKNESS)}


class AgentEnvironment(gymnasium.Env[Seen, NDArray[np.float32]]):
    """Environment with an agent and two objects.

    An observation is an initial state (52 numbers, :mod:`ftl_lightning.domains.agent.scenes`). An action is a force in newtons
    along x and z, applied for ``STEP`` seconds. The agent slides without friction, is slowed by drag, and neither tips nor turns.
    Reaching an object terminates an episode, ``MAX_STEPS`` steps truncate it; further steps are possible. Every instance has a
    separate simulator without a display.

    Raises:
        UserError: if the simulator does not start.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / scenes.STEP)}  # noqa: RUF012 (gymnasium's)
    render_mode = "rgb_array"
    observation_space: gymnasium.spaces.Space[Any] = gymnasium.spaces.Dict(
        {scenes.OBSERVED: gymnasium.spaces.Box(-np.inf, np.inf, (scenes.INITIAL,), np.float32)}
    )
    action_space = gymnasium.spaces.Box(-scenes.MAX_FORCE, scenes.MAX_FORCE, (len(scenes.PLANE),), np.float32)

    def __init__(self) -> None:
        try:
            self.client = Simulator()
        except pybullet().error as error:
            raise UserError(f"agent: the physics simulator does not start ({error}); close some of its instances") from error
        self._initial = np.zeros(scenes.INITIAL, dtype=np.float32)
        self._agent = -1
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Build a scene: ``options['scene']``, 52 numbers, else a scene drawn for ``options['task']`` (default 'go to red object').

        Raises:
            UserError: for a scene of the wrong size, with overlapping bodies, or with numbers that are not finite.
        """
        super().reset(seed=seed)
        options = options or {}
        if (scene := options.get("scene")) is None:
            draw = int(self.np_random.integers(2**31))
            scene = scenes.scenes(options.get("task", "go to red object"), 1, draw)[0]
        self._initial = scenes.check(np.asarray(scene)).copy()
        self._steps = 0
        self._build()
        return self._observation(), {}

    def _build(self) -> None:
        # Rebuild everything, so that earlier episodes have no effect.
        client = self.client
        client.resetSimulation()
        client.setGravity(0, -9.81, 0)
        client.setPhysicsEngineParameter(fixedTimeStep=scenes.STEP / scenes.SUBSTEPS, deterministicOverlappingPairs=1)
        plane = client.createCollisionShape(pybullet().GEOM_PLANE, planeNormal=[0, 1, 0])
        ground = client.createMultiBody(0, plane, basePosition=[0, -scenes.MARGIN, 0])
        client.changeDynamics(ground, -1, lateralFriction=0)
        floor = client.createVisualShape(pybullet().GEOM_BOX, halfExtents=FLOOR, rgbaColor=[0.93, 0.93, 0.93, 1])
        client.createMultiBody(0, -1, floor, [scenes.AGENT_START[0], -FLOOR[1], scenes.AGENT_START[2]])  # planes are not drawn
        self._agent = self._body(("yellow", "cone"), self._initial[:3], scenes.MASS)
        client.changeDynamics(
            self._agent,
            -1,
            lateralFriction=0,
            linearDamping=0,  # drag is a force in `step`: linearDamping cannot be as strong
            localInertiaDiagonal=[0, 0, 0],  # a force through the centre of a body without inertia cannot turn it
            activationState=pybullet().ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        client.resetBasePositionAndOrientation(self._agent, self._initial[:3].tolist(), self._initial[3:7].tolist())
        client.resetBaseVelocity(self._agent, self._initial[7:10].tolist(), self._initial[10:13].tolist())
        for look, columns in zip(scenes.looks(self._initial), scenes.OBJECT_COLUMNS, strict=True):
            self._body(look, self._initial[columns][:3], 0)

    def _body(self, look: scenes.Look, position: NDArray[np.float32], mass: float) -> int:
        """Create a body; it is fixed if the mass is 0."""
        client, (colour, shape) = self.client, look
        rgba = [*(value / 255 for value in scenes.COLOURS[colour]), 1.0]
        if shape == "sphere":
            form: dict[str, Any] = {"shapeType": pybullet().GEOM_SPHERE, "radius": scenes.RADIUS[shape]}
            visual = form
        elif shape == "cube":
            visual = form = {"shapeType": pybullet().GEOM_BOX, "halfExtents": [scenes.RADIUS[shape]] * 3}
        else:
            vertices, triangles = MESHES[shape]
            form = {"shapeType": pybullet().GEOM_MESH, "vertices": vertices}
            visual = form | {"indices": triangles}
            if shape == "bowl":  # with its triangles it stays concave; without, pybullet takes the convex hull
                form = visual | {"flags": pybullet().GEOM_FORCE_CONCAVE_TRIMESH}
        body: int = client.createMultiBody(
            baseMass=mass,
            baseCollisionShapeIndex=client.createCollisionShape(**form),
            baseVisualShapeIndex=client.createVisualShape(**visual, rgbaColor=rgba),
            basePosition=position.tolist(),
        )
        client.changeDynamics(body, -1, lateralFriction=0)
        return body

    def _observation(self) -> Seen:
        place, turn = self.client.getBasePositionAndOrientation(self._agent)
        velocity, spin = self.client.getBaseVelocity(self._agent)
        observation = self._initial.copy()
        observation[: scenes.STATE] = (*place, *turn, *velocity, *spin)
        return {scenes.OBSERVED: observation}

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Apply a force for ``STEP`` seconds; the reward is 0.

        Raises:
            UserError: for an action of the wrong size or with numbers that are not finite.
        """
        force = np.asarray(action, dtype=np.float64)
        valid = force.shape == (len(scenes.PLANE),) and np.isfinite(force).all()
        require(valid, "agent action", f"{len(scenes.PLANE)} finite numbers", str(force.tolist()))
        force = force * min(1.0, scenes.MAX_FORCE / max(float(np.linalg.norm(force)), 1e-12))
        for _ in range(scenes.SUBSTEPS):  # pybullet forgets a force after each of its steps
            here = self.client.getBasePositionAndOrientation(self._agent)[0]
            velocity = self.client.getBaseVelocity(self._agent)[0]
            drag = scenes.MASS * scenes.DRAG
            net = [force[0] - drag * velocity[0], 0, force[1] - drag * velocity[2]]
            self.client.applyExternalForce(self._agent, -1, net, here, pybullet().WORLD_FRAME)
            self.client.stepSimulation()
        self._steps += 1
        observation = self._observation()
        world = observation[scenes.OBSERVED]
        objects = np.stack([world[columns][:3] for columns in scenes.OBJECT_COLUMNS])
        reached = bool((np.linalg.norm(objects - world[:3], axis=-1) < scenes.REACH).any())
        return observation, 0.0, reached, self._steps >= scenes.MAX_STEPS, {}

    def render(self) -> NDArray[np.uint8]:
        """Picture ``(height, width, 3)`` of pybullet's software renderer."""
        height, width = IMAGE
        view = self.client.computeViewMatrix([0, 2.6, -6.2], [scenes.AGENT_START[0], 0, scenes.AGENT_START[2]], [0, 1, 0])
        lens = self.client.computeProjectionMatrixFOV(38, width / height, 0.1, 20)
        _, _, rgba, *_ = self.client.getCameraImage(
            width, height, view, lens, lightDirection=[1, 4, -2], shadow=1, renderer=pybullet().ER_TINY_RENDERER
        )
        picture: NDArray[np.uint8] = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3]
        return picture[:, ::-1]  # with x right, y up and z forward our axes are left-handed, the simulator's are right-handed

    def close(self) -> None:
        """Stop the simulator."""
        if self.client.isConnected():
            self.client.disconnect()
