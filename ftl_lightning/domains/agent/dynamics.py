"""Constants of the physics."""

from ftl_lightning.domains.agent.scenes import HEIGHT
from ftl_lightning.services.shipped import check_extra

STEP = 0.05
"""Seconds between states."""
SUBSTEPS = 6
MAX_STEPS = 128
LOOKAHEAD = 5
"""An action is the displacement to the plan's state this many steps ahead (paper: a_t = tau_{t+5} - s_t)."""
DRAG = 16.0
"""Decay rate of the agent's speed per second, high enough to avoid overshooting."""
MASS = LOOKAHEAD * STEP / DRAG
"""Mass in kg. A plan at constant speed v is LOOKAHEAD * STEP * v ahead, and drag is MASS * DRAG * v: with this mass, the
displacement in metres, applied as a force in newtons, keeps the agent at the plan's speed."""
MAX_FORCE = 0.2
"""Maximum force in newtons; larger forces are scaled down."""
RADIUS = {"cone": 0.11, "sphere": HEIGHT, "bowl": 0.13, "cube": HEIGHT}
"""Radius of the bodies' footprints in metres; half the edge of a cube."""
MARGIN = 0.001
"""Gap in metres that the simulator keeps between cone and ground; the ground is lowered by it to avoid hopping."""


def check_simulator() -> None:
    """Check that pybullet is installed.

    Raises:
        UserError: with the command that installs it.
    """
    check_extra("navigation", "domain agent: its simulator")
