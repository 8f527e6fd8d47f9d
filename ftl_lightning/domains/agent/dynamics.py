"""Numbers of the physics, which need no simulator."""

from ftl_lightning.domains.agent.scenes import HEIGHT
from ftl_lightning.extras import expect_extra

STEP = 0.05
"""Seconds between two states."""
SUBSTEPS = 6
MAX_STEPS = 128
LOOKAHEAD = 5
"""An action is the displacement to the plan's state this many steps ahead (paper: a_t = tau_{t+5} - s_t)."""
DRAG = 16.0
"""The rate per second at which the agent's speed decays: so fast that pulling towards a point does not overshoot it."""
MASS = LOOKAHEAD * STEP / DRAG
"""kg. A plan that moves steadily at speed v is LOOKAHEAD * STEP * v ahead, and drag takes MASS * DRAG * v: with this mass, that
way in metres, applied as a force in newtons, keeps the agent's speed at the plan's."""
MAX_FORCE = 0.2
"""Newtons; a longer force is shortened."""
RADIUS = {"cone": 0.11, "sphere": HEIGHT, "bowl": 0.13, "cube": HEIGHT}
"""Of the bodies' footprints, metres; half the edge of a cube."""
MARGIN = 0.001
"""Metres. The simulator keeps a cone this far above the ground, so the ground is this much lower; otherwise the agent would hop."""


def expect_simulator() -> None:
    """Refuse to go on without pybullet.

    Raises:
        UserError: with the command that installs it.
    """
    expect_extra("navigation", "domain agent: its simulator")
