"""Meta-World's simulators behind one Gymnasium environment, which a scene sets to a task."""

import copy
import functools
import warnings
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ftl_metaworld.tasks import NAMES

if TYPE_CHECKING:
    import mujoco

MAX_STEPS = 500
"""Length of an episode in Meta-World."""
STEP = 0.01
"""Displacement of the commanded hand in metres by an action of 1."""
RANDOM = 6
"""Maximum size of the vector that Meta-World draws for an episode: places of objects and of the goal."""
SCENE = 1 + RANDOM
HAND, GRIPPER, FIRST, SECOND, GOAL = slice(0, 3), slice(3, 4), slice(4, 11), slice(11, 18), slice(18, 21)
"""Columns of the observed world: place of the hand, opening of the gripper (0 to 1), place and quaternion of the first and of the
second object (0 without an object), place of the goal."""
WORLD = 21
COLUMNS, UNITS = ("dx", "dy", "dz", "gripper"), ("cm", "cm", "cm", "")
"""Columns of an action."""
REST_ACTION = np.array([0, 0, 0, -1], dtype=np.float32)
"""The action before an episode: no movement, gripper open."""


@functools.cache
def _compiled(path: str) -> "mujoco.MjModel":
    import mujoco

    return mujoco.MjModel.from_xml_path(path)


@functools.cache
def simulator(name: str) -> type[Any]:
    """Meta-World's class of a task, in the variant that observes the goal, faster: its model is compiled once."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    base = ALL_V3_ENVIRONMENTS[f"{name}-v3"]

    class Simulator(base):  # type: ignore[misc, valid-type]
        def _initialize_simulation(self) -> tuple[Any, Any]:
            import mujoco

            model = copy.copy(_compiled(self.fullpath))
            return model, mujoco.MjData(model)

        def touching_object(self, object_geom_id: int) -> bool:
            """As Meta-World's, which makes an object of every contact: a quarter of the time of a step."""
            contact, forces = self.data.contact, self.data.efc_force
            ends = np.stack((contact.geom1, contact.geom2))
            touched = (ends == object_geom_id).any(axis=0)
            pads = (self.data.geom(f"{side}pad_geom").id for side in ("left", "right"))
            return all(sum(forces[contact.efc_address[touched & (ends == pad).any(axis=0)]]) > 0 for pad in pads)

    return Simulator


def make(name: str) -> Any:
    """A simulator of a task, with observed goal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = simulator(name)()
    made._partially_observable, made._set_task_called = False, True
    made.__dict__.pop("sawyer_observation_space", None)  # it was computed for a hidden goal
    return made


class MetaWorld(gymnasium.Env[Any, Any]):
    """An episode of any task.

    A scene ``(7,)`` holds the number of the task in :data:`.tasks.NAMES` and the vector that Meta-World draws for an episode. An
    action ``(4,)`` moves the commanded place of the hand, by at most 1 cm along each axis, and sets the effort of the gripper, -1
    (open) to 1 (closed). An episode ends with success as Meta-World defines it, ``info['success']``.
    """

    def __init__(self) -> None:
        self.name, self._simulator = "", cast("Any", None)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        scene = np.asarray((options or {})["scene"], dtype=np.float64)
        name = NAMES[int(scene[0])]
        if name != self.name:
            self.name, self._simulator = name, make(name)
        simulator = self._simulator
        simulator._freeze_rand_vec = True
        simulator._last_rand_vec = scene[1 : 1 + simulator._random_reset_space.low.size]
        seen, _ = simulator.reset()
        return {"world": self._world(seen)}, {"success": False}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action = np.clip(np.asarray(action, dtype=np.float32), -1, 1)
        seen, reward, _, truncated, info = self._simulator.step(action)
        success = bool(info["success"])
        return {"world": self._world(seen)}, float(reward), success, bool(truncated), {"success": success}

    def _world(self, seen: NDArray[np.float64]) -> NDArray[np.float32]:
        """The world ``(21,)`` of an observation ``(39,)``, whose previous frame is left out."""
        self.seen = seen
        return np.concatenate((seen[:18], seen[36:])).astype(np.float32)
