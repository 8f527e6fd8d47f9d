"""What is seen of the table-top and what is commanded, which need no simulator."""

from ftl_lightning.demonstrations.features import Feature
from ftl_lightning.domains.tabletop.world import OVERHEAD
from ftl_lightning.extras import expect_extra

NAME, WIDE_NAME = "tabletop", "tabletop_wide"
STATE_NAMES = ("hand.x", "hand.y", "hand.z", "gripper.opening")
STATE_UNITS = ("m",) * 4
IMAGE, POSE, PLACES = "image", "pose", "places"
FEATURES = {IMAGE: Feature((3, *OVERHEAD.size), "image"), POSE: Feature((8,), state=(0, 1, 2, 7))}
"""The overhead camera's picture, without the arm; measured place (m), quaternion (real part last) and opening (m) of the hand.

Place and opening are what a plan starts from, but for the millimetres by which the arm lags behind what it is told.
"""
SEEN = Feature((5, 4))
"""Privileged: of each object whether the camera sees it, and its centre (m). Only the pictures of a training set come with it."""
ACTION = 4
"""Place of the hand (m) and opening of the gripper (m): what plans consist of."""
HERTZ = 10
"""Actions a second."""
MAX_STEPS = 160
"""The paper's number: 16 seconds."""
OPEN, THRESHOLD = 0.08, 0.06
"""Metres between the fingers of an open gripper; an action with a larger opening than the threshold opens it, others close it."""


def expect_simulator() -> None:
    """Refuse to go on without pybullet.

    Raises:
        UserError: with the command that installs it.
    """
    expect_extra("tabletop", f"domain {NAME}: its simulator")
