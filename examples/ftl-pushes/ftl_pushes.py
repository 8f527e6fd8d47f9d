"""A point is pushed over a plane to one of two targets, or to the middle between them."""

from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import Feature, InitialStates, Observed, check_starts
from ftl_lightning.domains import pictures
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.domain import Concepts, Domain, Metric, Plans, Split
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.domains.films import Frames
from ftl_lightning.domains.tasks import few_shot_suites
from ftl_lightning.services.randomness import VALIDATION_SEED, generator, task_key

PLANS = Plans(horizon=16, columns=("x", "y"), units=("m", "m"))
WORLD = Feature(shape=(6,), state=(0, 1))  # x and y of the point, the red target and the blue target
TRAINING, NEW = ("go to red", "go to blue"), ("go between",)
PACE, NEAR = 0.4, 0.3  # metres a step, metres


def goal_of(task: str, world: Tensor) -> Tensor:
    """Where a task ends ``(sample, 2)`` in worlds ``(sample, 6)``."""
    red = {"go to red": 1.0, "go to blue": 0.0, "go between": 0.5}[task]
    return red * world[:, 2:4] + (1 - red) * world[:, 4:]


def straight(task: str, world: Tensor) -> Tensor:
    """The expert's ways ``(sample, 16, 2)``: at an even pace, then a rest at the goal."""
    way = (goal_of(task, world) - world[:, :2])[:, None]
    length = way.norm(dim=-1, keepdim=True)
    driven = (PACE * torch.arange(PLANS.horizon)[:, None]).minimum(length)
    return world[:, None, :2] + driven / length * way


class Expert:
    """The source: demonstrations, and where new episodes start."""

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        own = seed if name == "train" else VALIDATION_SEED + seed
        return concatenate([self.draw(task, count, own) for task in TRAINING])

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        scenes = self.starts(task, count, seed).require_scenes()
        states = straight(task, scenes)
        targets = scenes[:, None, 2:].expand(-1, PLANS.horizon, -1)
        return Demonstrations(
            states=states,
            lengths=torch.full((count,), PLANS.horizon),
            domain="pushes",
            state_names=PLANS.columns,
            state_units=PLANS.units,
            concepts=(task,) * count,
            observed={"world": torch.cat((states, targets), dim=-1)},
            per_step=("world",),  # observed at every time, so that a plan can start at any
            scenes=scenes,
            provenance={"seed": seed},
        )

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        world = 4 * torch.rand(count, 6, generator=generator("cpu", seed, task_key(task))) - 2
        return InitialStates({"world": world}, scenes=world)


def arrives(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether plans ``(sample, 16, 2)`` end near the goal."""
    return (states[:, -1] - goal_of(goal, check_starts(starts).require_scenes())).norm(dim=-1) < NEAR


class PushEnvironment(gymnasium.Env[Any, Any]):
    """An action ``(2,)`` moves the point by as much, at most 0.5 m each way."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.world = np.array((options or {})["scene"], dtype=np.float32)
        return {"world": self.world.copy()}, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.world[:2] += np.clip(action, -0.5, 0.5)
        return {"world": self.world.copy()}, 0.0, False, False, {}


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """The planner: from where the point is to where the plan is a step later."""
    return plans[:, min(step + 1, PLANS.horizon - 1)] - observed["world"][:, :2]


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Whether episodes end near the goal."""
    end = rollout.observed["world"][:, -1]
    return {"success": ((end[:, :2] - goal_of(goal, end)).norm(dim=-1) < NEAR) & ~rollout.failed}


def film(rollout: Rollout, plans: Tensor) -> Frames:
    """The way of one episode."""
    return pictures.film(rollout.observed["world"][0, :, :2])


def random_target(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    """A trivial policy: straight to a target at random."""
    world = check_starts(starts).require_scenes()
    red = torch.rand(count, generator=generator("cpu", seed)) < 0.5
    return torch.where(red[:, None, None], straight("go to red", world), straight("go to blue", world))


DOMAIN = Domain(
    name="pushes",
    plans=PLANS,
    concepts=Concepts(training=TRAINING, suites=few_shot_suites(TRAINING, NEW)),
    source=lambda root: Expert(),
    observed={"world": WORLD},
    metrics={"accuracy": Metric(arrives)},
    comparison=Comparison(headline="closed loop success", references={"random target": random_target}),
    closed_loop=ClosedLoop(environment=PushEnvironment, act=act, steps=20, judge=judge, film=film),
)
