"""Domain objects of the table-top, and reference policies."""

import logging
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, Observed
from ftl_lightning.domains.comparison import Comparison, Paper, Published
from ftl_lightning.domains.domain import EXECUTED, Concepts, Domain, Plans, Privileged, Recordings, deferred
from ftl_lightning.domains.execution import ClosedLoop, Policy, Rollout
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.tabletop import interface
from ftl_lightning.domains.tabletop.experts import PUSH_HEIGHT
from ftl_lightning.domains.tabletop.interface import PLACES, PUSH, PUSH_ON_BOOK, WIDE_CONCEPTS, WIDE_NAME, check_simulator
from ftl_lightning.domains.tabletop.scenes import OBJECTS, TRIANGLE
from ftl_lightning.services.errors import UserError

if TYPE_CHECKING:
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
    from ftl_lightning.domains.tabletop.source import Expert

_LOG = logging.getLogger(__name__)
BOOK_MOVED = 0.02  # Displacement in metres above which the book counts as moved
HORIZON = 32  # States per plan, as in the paper
_FOLDER, RENDERING = Path(__file__).parent, "ftl_lightning.domains.tabletop.rendering"


def source(root: Path | None, wide: bool = False) -> "Expert":
    """Scripted experts; those of the wide domain have recoveries for all concepts. Without the simulator, a ``UserError``."""
    check_simulator()
    from ftl_lightning.domains.tabletop.source import Expert

    return Expert(WIDE_CONCEPTS, WIDE_NAME, begun_anew=WIDE_CONCEPTS, coupled=True) if wide else Expert()


def environment(ends_at: Collection[str] = (TRIANGLE,), coupled: bool = False) -> "TableTopEnvironment":
    """See :class:`.TableTopEnvironment`; a ``UserError`` without the simulator."""
    check_simulator()
    from ftl_lightning.domains.tabletop.environment import TableTopEnvironment

    return TableTopEnvironment(ends_at=ends_at, coupled=coupled)


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Judge episodes: ``success`` and ``book moved``, by more than :data:`BOOK_MOVED`, ``(episode,)`` each."""
    from ftl_lightning.domains.tabletop.environment import judged

    scenes = rollout.starts.require_scenes().numpy()
    success = [judged(goal, scene, info) for scene, info in zip(scenes, rollout.infos, strict=True)]
    moved = [info.get("book", 0.0) > BOOK_MOVED for info in rollout.infos]
    return {"success": torch.tensor(success) & ~rollout.failed, "book moved": torch.tensor(moved)}


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Next command ``(episode, 4)``: the next state of plans ``(episode, horizon, 4)``, whose first state is the last command."""
    return plans[:, min(step + 1, plans.shape[1] - 1)]


Make = Callable[[str, InitialStates, Demonstrations | None, int], Policy | None]


def _replayed(tasks: tuple[str, ...], height: float | None = None, feedback: bool = True, coupled: bool = False) -> Make:
    """Policy for ``tasks`` that replays actions of an expert, recorded in a separate simulation; bitwise equal to the expert.

    See :func:`ftl_lightning.domains.tabletop.experts.moves` for ``height`` and ``feedback``, :class:`.TableTopEnvironment` for
    ``coupled``.
    """

    def make(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy | None:
        if interface.check_task(goal) not in tasks:
            return None
        check_simulator()
        from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
        from ftl_lightning.domains.tabletop.source import perform

        actions: list[Tensor] = []
        env = TableTopEnvironment(coupled=coupled)
        try:
            for row, scene in enumerate(starts.require_scenes().numpy()):
                try:
                    done = perform(env, goal, scene, np.random.default_rng([seed, row]), height, feedback)
                    actions.append(torch.from_numpy(done.actions))
                except (UserError, MemoryError, OSError):
                    raise
                except Exception as error:  # any error of the simulator: other episodes continue
                    _LOG.warning("table-top %r, episode %d: %r; the reference policy has no action there", goal, row, error)
                    actions.append(torch.full((1, interface.ACTION), torch.nan))
                    env.close()
                    env = TableTopEnvironment(coupled=coupled)
        finally:
            env.close()
        return lambda observed, rows, step: torch.stack([actions[row][min(step, len(actions[row]) - 1)] for row in rows])

    return make


def _policies(coupled: bool) -> dict[str, Make]:
    """``table-height push`` pushes on the book at table height; ``straight push`` has no feedback."""
    return {
        "expert (oracle)": _replayed(interface.TASKS, coupled=coupled),
        "table-height push": _replayed((PUSH_ON_BOOK,), height=PUSH_HEIGHT, coupled=coupled),
        "straight push": _replayed((PUSH, PUSH_ON_BOOK), feedback=False, coupled=coupled),
    }


POLICIES = _policies(coupled=False)

_ON_ROBOT = ("new concept", 0.55, ""), ("training representation", 0.15, ""), ("training concept", 0.90, PUSH)
PUBLISHED = tuple(Published(setting, value, task=task, metric=EXECUTED) for setting, value, task in _ON_ROBOT)
"""Results of the paper on a real robot, 20 episodes each (section 5.1)."""

_LOOP = ClosedLoop(
    environment=environment,
    act=act,
    steps=interface.MAX_STEPS,
    judge=judge,
    film=deferred(f"{RENDERING}:film"),
    vector_film=deferred(f"{RENDERING}:vector_film"),
    keeps=(interface.POSE,),
    less_is_better=("book moved",),
    policies=POLICIES,
    expect=check_simulator,
)
DOMAIN = Domain(
    name=interface.NAME,
    plans=Plans(HORIZON, interface.STATE_NAMES, interface.STATE_UNITS, resolution=1e-4, views=interface.VIEWS),
    concepts=Concepts(interface.TRAINING_CONCEPTS, interface.SUITES, table=_FOLDER / "embeddings.safetensors"),
    source=source,
    observed=interface.FEATURES,
    recordings=Recordings(privileged={PLACES: Privileged(interface.SEEN, interface.keypoint_loss, interface.noisy_keypoints)}),
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
    plans=replace(DOMAIN.plans, views=interface.WIDE_VIEWS),
    concepts=Concepts(WIDE_CONCEPTS, interface.WIDE_SUITES, table=_FOLDER / "wide_embeddings.safetensors"),
    source=partial(source, wide=True),
    closed_loop=replace(_LOOP, environment=partial(environment, ends_at=OBJECTS, coupled=True), policies=_policies(coupled=True)),
    comparison=replace(DOMAIN.comparison, paper=None),
)
"""Table-top with more pushes and picks than the paper, and a gripper with coupled fingers."""
