"""The domain object: what the rest of the package knows of driving."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.demonstrations.cache import cached
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import ClosedLoop, Domain
from ftl_lightning.domains.driving import policies
from ftl_lightning.domains.driving.environment import MAX_STEPS, STATE, DrivingEnvironment, initial_state
from ftl_lightning.domains.driving.expert import SEARCH
from ftl_lightning.domains.driving.generation import HORIZON, NAME, STATE_NAMES, STATE_UNITS, demonstrations, episode_seed
from ftl_lightning.domains.driving.published import PUBLISHED
from ftl_lightning.domains.driving.rendering import frames, render
from ftl_lightning.domains.driving.scenarios import SCENARIOS, VEHICLES, make, observe, scenario
from ftl_lightning.domains.driving.shipped import training_set
from ftl_lightning.domains.driving.tasks import SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.driving.views import VIEWS


def generate(task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
    """Episodes of the expert that succeeded."""
    settings = {
        "domain": NAME,
        "task": task,
        "count": count,
        "seed": seed,
        "config": scenario(task).config,
        "search": SEARCH[task],
        "beyond": HORIZON,
    }
    return cached(settings, count, lambda progress: demonstrations(task, count, seed, workers, progress))


def starts(task: str, count: int, seed: int) -> Tensor:
    """Initial states ``(count, 37)`` of new episodes."""
    env = make(task)
    found = []
    for number in range(count):
        start = episode_seed(seed, number)
        env.reset(seed=start)
        found.append(torch.from_numpy(initial_state(observe(env), task, start)))
    env.close()
    return torch.stack(found)


def judge(goal: str, observations: Tensor, infos: Sequence[Mapping[str, Any]]) -> dict[str, Tensor]:
    """What happened in episodes.

    Returns:
        ``(episode,)`` each: ``success``, the paper's count (in the roundabout: past it, crashed or not); ``strict success``, on
        the right road without a crash; ``crash``; ``return``; ``length`` in steps; all 0 for an
        episode that broke off.
    """
    columns = {"success": "passed", "strict success": "arrived", "crash": "crashed", "return": "return", "length": "length"}
    found = {name: torch.tensor([float(info.get(key, 0)) for info in infos]) for name, key in columns.items()}
    return found | {name: found[name] > 0 for name in ("success", "strict success", "crash")}


DOMAIN = Domain(
    name=NAME,
    horizon=HORIZON,
    state_names=STATE_NAMES,
    state_units=STATE_UNITS,
    training_concepts=TRAINING_CONCEPTS,
    suites=SUITES,
    descriptions=tuple(SCENARIOS),
    training_set=training_set,
    generate=generate,
    reads=lambda task: task in SCENARIOS,
    succeeded=None,
    render=render,
    initial_states=starts,
    views=VIEWS,
    entities=tuple(tuple(range(start, start + STATE)) for start in range(STATE, VEHICLES * STATE, STATE)),
    closed_loop=ClosedLoop(
        environment=DrivingEnvironment,
        act=lambda plans, step, observations: plans[:, min(step + 1, plans.shape[1] - 1)],
        steps=MAX_STEPS,
        judge=judge,
        frames=frames,
        headline="strict success",
        costs=("crash",),
        policies=policies.POLICIES,
    ),
    published=PUBLISHED,
    omega="learned",
    published_omega="learned",
)
