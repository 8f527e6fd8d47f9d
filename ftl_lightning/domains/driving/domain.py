"""Domain object of driving."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import path_distance
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.formats.files import cached
from ftl_lightning.domains.comparison import Comparison, Paper
from ftl_lightning.domains.domain import Concepts, Domain, Plans, Split, deferred
from ftl_lightning.domains.driving import policies
from ftl_lightning.domains.driving.motion import turned
from ftl_lightning.domains.driving.published import PUBLISHED
from ftl_lightning.domains.driving.shipped import training_set
from ftl_lightning.domains.driving.tasks import SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.driving.traffic import (
    BELIEF,
    FEATURES_SEEN,
    HORIZON,
    MAX_STEPS,
    NAME,
    NAMES,
    SIMULATION,
    STATE_NAMES,
    STATE_UNITS,
    STEP,
    check_scenario,
    check_simulator,
    episode_seed,
    initial_states,
    scene,
)
from ftl_lightning.domains.driving.views import VIEWS
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.domains.pictures import Show

if TYPE_CHECKING:
    from ftl_lightning.domains.driving.environment import DrivingEnvironment

RENDERING = "ftl_lightning.domains.driving.rendering"


class Expert:
    """Source of successful episodes of the expert, shipped and new.

    Args:
        root: folder of user episodes of the training scenarios, instead of the shipped episodes.
        blind: whether new episodes are of the expert that knows only observations.
    """

    def __init__(self, root: Path | None = None, blind: bool = False) -> None:
        self.root, self.blind = root, blind

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """The same for every seed, as generation takes half an hour."""
        return training_set(name, count, self.root)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        check_scenario(task)
        check_simulator()
        from ftl_lightning.domains.driving.expert import BLIND, SEARCH
        from ftl_lightning.domains.driving.generation import demonstrations
        from ftl_lightning.domains.driving.scenarios import scenario

        settings = {
            "domain": NAME,
            "task": task,
            "count": count,
            "seed": seed,
            "config": scenario(task).config,
            "search": SEARCH[task],
            "beyond": HORIZON,
            **({"blind": asdict(BLIND)} if self.blind else {}),
        }
        return cached(settings, count, lambda progress: demonstrations(task, count, seed, workers, progress, self.blind))

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """Initial states of new episodes, scenes ``(count, 37)``."""
        check_scenario(task)
        check_simulator()
        from ftl_lightning.domains.driving.scenarios import make, observe

        env = make(task)
        scenes = []
        for number in range(count):
            start = episode_seed(seed, number)
            env.reset(seed=start)
            scenes.append(torch.from_numpy(scene(observe(env), task, start)))
        env.close()
        return initial_states(torch.stack(scenes))


def environment(veto: str = BELIEF) -> "DrivingEnvironment":
    """Environment of the domain with a veto of the planner.

    Raises:
        UserError: without the simulator, or for an unknown veto.
    """
    check_simulator()
    from ftl_lightning.domains.driving.environment import DrivingEnvironment

    return DrivingEnvironment(veto)


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Outcomes of episodes.

    Returns:
        ``(episode,)`` each: ``success``, the paper's criterion (roundabout: past it, crashed or not); ``strict success``, on the
        right road without a crash; ``crash``; ``return``; ``length`` in steps. All are 0 for an aborted episode.
    """
    columns = {"success": "passed", "strict success": "arrived", "crash": "crashed", "return": "return", "length": "length"}
    outcomes = {name: torch.tensor([float(info.get(key, 0)) for info in rollout.infos]) for name, key in columns.items()}
    return outcomes | {name: outcomes[name] > 0 for name in ("success", "strict success", "crash")}


def _from_start(states: Tensor) -> Tensor:
    """Paths ``(plan, horizon, 2)`` in metres, along and across the initial heading from the initial position."""
    first = states[:, :1]
    return turned(states[..., 1:3] - first[..., 1:3], first[..., 5], -first[..., 6])


def distance(states: Tensor, others: Tensor) -> Tensor:
    """Root mean square distance ``(a, b)`` in metres between paths of the controlled vehicle, relative to their initial pose.

    The initial pose is given, not generated; the path depends on the traffic.
    """
    return path_distance(_from_start(states), _from_start(others))


DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, STATE_NAMES, STATE_UNITS, resolution=1e-3),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES,
        descriptions=(*TRAINING_CONCEPTS, "roundabout", "roundabout third exit"),  # other scenarios use these concepts
        reads=NAMES.__contains__,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=Expert,
    observed=FEATURES_SEEN,
    show=Show(deferred(f"{RENDERING}:render"), vector_film=deferred(f"{RENDERING}:plan_film")),
    views=VIEWS,
    closed_loop=ClosedLoop(
        environment=environment,
        identity=f"{BELIEF} veto",
        others={f"{veto} veto": partial(environment, veto) for veto in (SIMULATION, STEP)},
        act=lambda plans, step, observed: plans[:, min(step + 1, plans.shape[1] - 1)],
        steps=MAX_STEPS,
        judge=judge,
        film=deferred(f"{RENDERING}:film"),
        vector_film=deferred(f"{RENDERING}:vector_film"),
        less_is_better=("crash",),
        policies=policies.POLICIES,
        expect=check_simulator,
    ),
    comparison=Comparison(
        headline="closed loop strict success",
        distance=distance,
        fresh=False,  # the expert takes about four seconds per episode
        paper=Paper(PUBLISHED, omega="learned", ours="learned"),
    ),
)
