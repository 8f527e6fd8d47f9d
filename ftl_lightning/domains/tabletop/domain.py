"""Domain object of the table-top."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.domains.comparison import Comparison, Paper, Published
from ftl_lightning.domains.domain import EXECUTED, Concepts, Domain, Plans, Privileged, deferred
from ftl_lightning.domains.execution import ClosedLoop
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.tabletop.interface import (
    FEATURES,
    MAX_STEPS,
    NAME,
    PLACES,
    POSE,
    SEEN,
    STATE_NAMES,
    STATE_UNITS,
    WIDE_NAME,
    check_simulator,
)
from ftl_lightning.domains.tabletop.policies import POLICIES
from ftl_lightning.domains.tabletop.scenes import OBJECTS
from ftl_lightning.domains.tabletop.success import judge
from ftl_lightning.domains.tabletop.tasks import PUSH, SUITES, TRAINING_CONCEPTS, WIDE_CONCEPTS, WIDE_SUITES
from ftl_lightning.domains.tabletop.views import VIEWS, misplaced, told

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
    from ftl_lightning.domains.tabletop.source import Expert

HORIZON = 32
"""States per plan, as in the paper."""
RENDERING = "ftl_lightning.domains.tabletop.rendering"


def source(root: Path | None) -> "Expert":
    """Scripted experts.

    Raises:
        UserError: without the simulator.
    """
    check_simulator()
    from ftl_lightning.domains.tabletop.source import Expert

    return Expert()


def wide_source(root: Path | None) -> "Expert":
    """Scripted experts of the wide domain, with recoveries for all concepts.

    Raises:
        UserError: without the simulator.
    """
    check_simulator()
    from ftl_lightning.domains.tabletop.source import Expert

    return Expert(WIDE_CONCEPTS, WIDE_NAME, begun_anew=WIDE_CONCEPTS)


def environment() -> "TableTopEnvironment":
    """Environment of the domain.

    Raises:
        UserError: without the simulator, or if it does not start.
    """
    check_simulator()
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

    return TableTopEnvironment()


def wide_environment() -> "TableTopEnvironment":
    """Environment in which an episode ends when the circle touches any object.

    Raises:
        UserError: as :func:`environment`.
    """
    check_simulator()
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

    return TableTopEnvironment(ends_at=OBJECTS)


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Next command ``(episode, 4)``: the next state of the plan, whose first state is the last command.

    Args:
        plans: ``(episode, horizon, 4)``.
        step: steps since the plan was made.
        observed: ignored: the environment moves the hand from the last command.
    """
    return plans[:, min(step + 1, plans.shape[1] - 1)]


_ON_ROBOT = ("new concept", 0.55, ""), ("training representation", 0.15, ""), ("training concept", 0.90, PUSH)
PUBLISHED = tuple(Published(setting, value, task=task, metric=EXECUTED) for setting, value, task in _ON_ROBOT)
"""Results of the paper on a real robot, 20 episodes each (section 4.5)."""

_LOOP = ClosedLoop(
    environment=environment,
    act=act,
    steps=MAX_STEPS,
    judge=judge,
    film=deferred(f"{RENDERING}:film"),
    vector_film=deferred(f"{RENDERING}:vector_film"),
    keeps=(POSE,),
    less_is_better=("book moved",),
    policies=POLICIES,
    expect=check_simulator,
)
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
    privileged={PLACES: Privileged(SEEN, misplaced, told)},
    views=VIEWS,
    show=Show(deferred(f"{RENDERING}:render"), vector_film=deferred(f"{RENDERING}:plan_film")),
    closed_loop=_LOOP,
    comparison=Comparison(
        headline=EXECUTED,
        fresh=False,  # an episode of an expert takes about half a second
        paper=Paper(PUBLISHED, omega="learned", ours="learned", comparable=False),
    ),
)
WIDE = replace(
    DOMAIN,
    name=WIDE_NAME,
    concepts=Concepts(training=WIDE_CONCEPTS, suites=WIDE_SUITES, table=Path(__file__).parent / "wide_embeddings.safetensors"),
    source=wide_source,
    closed_loop=replace(_LOOP, environment=wide_environment),
    comparison=replace(DOMAIN.comparison, paper=None),
)
"""Table-top with more pushes and picks than the paper."""
