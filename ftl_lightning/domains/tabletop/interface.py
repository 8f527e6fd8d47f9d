"""Observations and actions of the table-top, without the simulator."""

from ftl_lightning.data.features import Feature
from ftl_lightning.domains.tabletop.world import OVERHEAD
from ftl_lightning.services.shipped import check_extra

NAME, WIDE_NAME = "tabletop", "tabletop_wide"
STATE_NAMES = ("hand.x", "hand.y", "hand.z", "gripper.opening")
STATE_UNITS = ("m",) * 4
IMAGE, POSE, PLACES = "image", "pose", "places"
FEATURES = {IMAGE: Feature((3, *OVERHEAD.size), "image"), POSE: Feature((8,), state=(0, 1, 2, 7))}
"""Image of the overhead camera, without the arm; measured position (m), quaternion (real part last) and opening (m) of the hand.

Position and opening are the initial state of a plan, up to the arm's lag of millimetres behind the command.
"""
SEEN = Feature((5, 4))
"""Privileged feature: visibility and centre (m) of each object, only for images of a training set."""
ACTION = 4
"""Size of an action: position of the hand (m) and opening of the gripper (m)."""
HERTZ = 10
"""Actions per second."""
MAX_STEPS = 160
"""Maximum steps per episode, as in the paper: 16 seconds."""
OPEN, THRESHOLD = 0.08, 0.06
"""Opening of an open gripper in metres, and threshold above which an action opens the gripper instead of closing it."""


def check_simulator() -> None:
    """Require pybullet.

    Raises:
        UserError: with the command that installs it.
    """
    check_extra("tabletop", f"domain {NAME}: its simulator")
