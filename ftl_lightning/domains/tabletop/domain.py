"""The domain object: what the rest of the package knows of the table-top."""

from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from ftl_lightning.demonstrations.features import Observed
from ftl_lightning.domains.deferred import deferred
from ftl_lightning.domains.domain import EXECUTED, ClosedLoop, Concepts, Domain, Plans, Privileged, Show
from ftl_lightning.domains.paper import Paper, Published
from ftl_lightning.domains.tabletop.interface import (
    FEATURES,
    MAX_STEPS,
    NAME,
    PLACES,
    POSE,
    SEEN,
    STATE_NAMES,
    STATE_UNITS,
    expect_simulator,
)
from ftl_lightning.domains.tabletop.policies import POLICIES
from ftl_lightning.domains.tabletop.success import judge
from ftl_lightning.domains.tabletop.tasks import PUSH, SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.tabletop.views import VIEWS, misplaced

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
    from ftl_lightning.domains.tabletop.source import Expert

HORIZON = 32
"""States in a plan; the paper's number."""
RENDERING = "ftl_lightning.domains.tabletop.rendering"


def source(root: Path | None) -> "Expert":
    """The scripted experts.

    Raises:
        UserError: without the simulator.
    """
    expect_simulator()
    from ftl_lightning.domains.tabletop.source import Expert

    return Expert()


def environment() -> "TableTopEnvironment":
    """The domain's environment.

    Raises:
        UserError: without the simulator, or if it does not start.
    """
    expect_simulator()
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

    return TableTopEnvironment()


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Where the hand should be next ``(episode, 4)``: the plan's next state. Its first is where the hand was told to be last.

    Args:
        plans: ``(episode, horizon, 4)``.
        step: steps since the plan was made.
        observed: not needed: the environment moves the hand from where it was told to be last.
    """
    return plans[:, min(step + 1, plans.shape[1] - 1)]


_ON_ROBOT = ("new concept", 0.55, ""), ("training representation", 0.15, ""), ("training concept", 0.90, PUSH)
PUBLISHED = tuple(Published(setting, value, task=task, metric=EXECUTED) for setting, value, task in _ON_ROBOT)
"""The paper's numbers, on a real robot, 20 episodes each (section 4.5)."""

DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, STATE_NAMES, STATE_UNITS, resolution=1e-4),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=source,
    observed=FEATURES,
    privileged={PLACES: Privileged(SEEN, misplaced)},
    views=VIEWS,
    headline=EXECUTED,
    show=Show(deferred(f"{RENDERING}:render")),
    closed_loop=ClosedLoop(
        environment=environment,
        act=act,
        steps=MAX_STEPS,
        judge=judge,
        film=deferred(f"{RENDERING}:film"),
        keeps=(POSE,),
        less_is_better=("book moved",),
        policies=POLICIES,
        expect=expect_simulator,
    ),
    paper=Paper(PUBLISHED, omega="learned", ours="1.2"),
    fresh=False,  # an expert takes about half a second for an episode
)
