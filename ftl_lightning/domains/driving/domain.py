"""Domain object of driving, and its baseline policies."""

import itertools
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.distances import path_distance
from ftl_lightning.data.features import InitialStates, Observed
from ftl_lightning.data.formats.files import cached
from ftl_lightning.domains.comparison import Comparison, Paper
from ftl_lightning.domains.domain import Concepts, Domain, Plans, Split, deferred
from ftl_lightning.domains.driving import traffic
from ftl_lightning.domains.driving.views import VIEWS, drive, turned
from ftl_lightning.domains.execution import ClosedLoop, Policy, Rollout
from ftl_lightning.domains.pictures import Show
from ftl_lightning.services.randomness import generator

if TYPE_CHECKING:
    from highway_env.envs.common.abstract import AbstractEnv

    from ftl_lightning.domains.driving.environment import DrivingEnvironment

Make = Callable[[str, InitialStates, Demonstrations | None, int], Policy | None]
SHOWN, SHOWN_WITH_RULES = 100, 60
"""Demonstrations per training scenario, and per training scenario with rules, for the look-up and the regressions."""


def _simulation(goal: str) -> "AbstractEnv":
    """highway-env's environment of a scenario."""
    traffic.check_simulator()
    from ftl_lightning.domains.driving.scenarios import make

    return make(goal)


def _always(name: str) -> Make:
    """Constant decision, subject to the planner's veto."""

    def policy(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
        number = float(_simulation(goal).action_type.actions_indexes[name])
        return lambda observed, rows, step: torch.full((len(rows), 1), number)

    return policy


def _random(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """Uniformly random decisions."""
    count = int(_simulation(goal).action_space.n)
    draws = [generator("cpu", seed, row) for row in range(len(starts))]
    return lambda observed, rows, step: torch.stack([torch.randint(count, (1,), generator=draws[row]).float() for row in rows])


def _transitions(goal: str, demonstrations: Demonstrations | None) -> tuple[Observed, Tensor]:
    """Observations ``(n, *shape)`` by name and next states ``(n, 7)`` of all steps of the demonstrations."""
    examples = demonstrations
    if examples is None:
        examples = traffic.training_set("train", SHOWN_WITH_RULES if goal in traffic.PRACTICE else SHOWN, scenarios=(goal,))
    pairs = [(row, time) for row, length in enumerate(examples.lengths.tolist()) for time in range(length - 1)]
    rows, times = torch.tensor(pairs).T
    return {name: values[rows, times] for name, values in examples.observed.items()}, examples.states[rows, times + 1]


def _nearest(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """Successor of the nearest demonstrated state."""
    seen, following = _transitions(goal, demonstrations)
    places = seen[traffic.TRAFFIC][:, : traffic.STATE]
    return lambda observed, rows, step: following[torch.cdist(observed[traffic.TRAFFIC][:, : traffic.STATE], places).argmin(dim=1)]


def _regression(fit: Callable[[Tensor, Tensor, torch.Generator], Callable[[Tensor], Tensor]], view: str) -> Make:
    """Predict drives ``(n, 4)`` from the models' view ``(n, m)``; ``fit`` receives both standardised, and a generator."""

    def policy(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
        seen, following = _transitions(goal, demonstrations)
        observe = VIEWS[view].observe
        inputs, drives = observe(seen)[traffic.TRAFFIC], drive(seen[traffic.TRAFFIC][:, : traffic.STATE], following)
        middle, spread = inputs.mean(dim=0), inputs.std(dim=0).clamp(min=1e-3)
        mean, scale = drives.mean(dim=0), drives.std(dim=0).clamp(min=1e-3)
        predict = fit((inputs - middle) / spread, (drives - mean) / scale, generator("cpu", seed))
        return lambda observed, rows, step: predict((observe(observed)[traffic.TRAFFIC] - middle) / spread) * scale + mean

    return policy


def _ridge(inputs: Tensor, drives: Tensor, draw: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Least squares with a penalty of 1 on standardised inputs."""
    terms = torch.cat((inputs, torch.ones(len(inputs), 1)), dim=1).double()
    weights = torch.linalg.solve(terms.T @ terms + torch.eye(terms.shape[1], dtype=torch.double), terms.T @ drives.double()).float()
    return lambda seen: seen @ weights[:-1] + weights[-1]


def _mlp(inputs: Tensor, drives: Tensor, draw: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Two hidden layers of 64, 400 full-batch steps."""
    layers: list[Tensor] = []

    def predict(seen: Tensor) -> Tensor:
        for number in range(0, len(layers), 2):
            seen = seen @ layers[number] + layers[number + 1]
            seen = torch.nn.functional.silu(seen) if number < len(layers) - 2 else seen
        return seen

    with torch.inference_mode(False), torch.enable_grad():  # also within evaluation
        for before, after in itertools.pairwise((inputs.shape[1], 64, 64, drives.shape[1])):
            weight = torch.randn(before, after, generator=draw) / before**0.5
            layers += [weight.requires_grad_(), torch.zeros(after, requires_grad=True)]
        inputs, drives = inputs.clone(), drives.clone()
        optimizer = torch.optim.AdamW(layers, lr=3e-3, weight_decay=0.1)
        for _ in range(400):
            optimizer.zero_grad()
            (predict(inputs) - drives).square().mean().backward()
            optimizer.step()
    return lambda seen: predict(seen).detach()


def _expert(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy | None:
    """Next state of the expert; not in training scenarios, where it takes minutes (see the data card for its rates)."""
    if goal in traffic.TRAINING_CONCEPTS:
        return None
    traffic.check_simulator()
    from ftl_lightning.domains.driving.expert import episode

    drives = [torch.from_numpy(episode(*traffic.origin(start))[0][:, 0]) for start in starts.require_scenes().numpy()]
    return lambda observed, rows, step: torch.stack([drives[row][min(step + 1, len(drives[row]) - 1)] for row in rows])


def policies(view: str) -> dict[str, Make]:
    """Baseline policies by name; all are subject to the planner's veto. The regressions observe a ``view``."""
    return {
        "IDLE": _always("IDLE"),
        "random": _random,
        "FASTER": _always("FASTER"),
        "nearest demonstration": _nearest,
        "ridge regression": _regression(_ridge, view),
        "MLP regression": _regression(_mlp, view),
        "expert (oracle)": _expert,
    }


POLICIES = policies("steps")
RENDERING = "ftl_lightning.domains.driving.rendering"


TRAINING = traffic.TRAINING_CONCEPTS, traffic.WIDE_CONCEPTS


class Expert:
    """Source of successful episodes of the expert: shipped ones, those in ``root``, or new ones.

    Args:
        root: folder of episodes of the training scenarios; ``None`` for the shipped ones.
        blind: whether the expert knows only observations.
        wide: whether it is that of :data:`WIDE`.
    """

    def __init__(self, root: Path | None = None, blind: bool = False, wide: bool = False) -> None:
        self.root, self.blind, self.wide = root, blind, wide

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        """The same for every seed, as generation takes half an hour."""
        return self._own(traffic.training_set(name, count, self.root, TRAINING[self.wide]))

    def _own(self, episodes: Demonstrations) -> Demonstrations:
        return replace(episodes, domain=traffic.WIDE_NAME) if self.wide else episodes

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        traffic.check_scenario(task)
        traffic.check_simulator()
        from ftl_lightning.domains.driving.expert import BLIND, SEARCH, demonstrations
        from ftl_lightning.domains.driving.scenarios import scenario

        settings = {"domain": traffic.NAME, "task": task, "count": count, "seed": seed, "config": scenario(task).config}
        settings |= {"search": SEARCH[task], "beyond": traffic.HORIZON, **({"blind": asdict(BLIND)} if self.blind else {})}
        return self._own(cached(settings, count, lambda progress: demonstrations(task, count, seed, workers, progress, self.blind)))

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        """Initial states of new episodes, scenes ``(count, 37)``."""
        env = _simulation(traffic.check_scenario(task))
        from ftl_lightning.domains.driving.scenarios import observe

        scenes = []
        for number in range(count):
            start = traffic.episode_seed(seed, number)
            env.reset(seed=start)
            scenes.append(torch.from_numpy(traffic.scene(observe(env), task, start)))
        env.close()
        return traffic.initial_states(torch.stack(scenes))


def environment(veto: str = traffic.BELIEF) -> "DrivingEnvironment":
    """Environment of the domain with a veto of the planner; raises a ``UserError`` without the simulator."""
    traffic.check_simulator()
    from ftl_lightning.domains.driving.environment import DrivingEnvironment

    return DrivingEnvironment(veto)


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Outcomes of episodes ``(episode,)``, 0 for an aborted episode.

    ``success`` is the paper's criterion (roundabout: past it, crashed or not), ``strict success`` on the right road without a
    crash;
    ``crash``, ``return``, and ``length`` in steps.
    """
    columns = {"success": "passed", "strict success": "arrived", "crash": "crashed", "return": "return", "length": "length"}
    outcomes = {name: torch.tensor([float(info.get(key, 0)) for info in rollout.infos]) for name, key in columns.items()}
    return outcomes | {name: outcomes[name] > 0 for name in ("success", "strict success", "crash")}


def distance(states: Tensor, others: Tensor) -> Tensor:
    """Root mean square distance ``(a, b)`` in metres between paths relative to their initial poses."""

    def path(plans: Tensor) -> Tensor:
        first = plans[:, :1]
        return turned(plans[..., 1:3] - first[..., 1:3], first[..., 5], -first[..., 6])

    return path_distance(path(states), path(others))


LOOP = ClosedLoop(
    environment=environment,
    identity=f"{traffic.BELIEF} veto",
    others={f"{veto} veto": partial(environment, veto) for veto in (traffic.SIMULATION, traffic.STEP)},
    act=lambda plans, step, observed: plans[:, min(step + 1, plans.shape[1] - 1)],
    steps=traffic.MAX_STEPS,
    judge=judge,
    film=deferred(f"{RENDERING}:film"),
    vector_film=deferred(f"{RENDERING}:vector_film"),
    less_is_better=("crash",),
    policies=POLICIES,
    expect=traffic.check_simulator,
)
DOMAIN = Domain(
    name=traffic.NAME,
    plans=Plans(traffic.HORIZON, traffic.STATE_NAMES, traffic.STATE_UNITS, resolution=1e-3, views=VIEWS),
    concepts=Concepts(
        training=traffic.TRAINING_CONCEPTS,
        suites=traffic.SUITES,
        descriptions=tuple(name for name in traffic.NAMES if name not in (*traffic.OTHER_ROUNDABOUTS, traffic.FIRST_EXIT)),
        reads=traffic.NAMES.__contains__,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=Expert,
    observed=traffic.FEATURES_SEEN,
    show=Show(deferred(f"{RENDERING}:render"), vector_film=deferred(f"{RENDERING}:plan_film")),
    closed_loop=LOOP,
    comparison=Comparison(
        headline="closed loop strict success",
        distance=distance,
        fresh=False,  # the expert takes about four seconds per episode
        paper=Paper(traffic.PUBLISHED, omega="learned", ours="learned"),
    ),
)
WIDE = replace(
    DOMAIN,
    name=traffic.WIDE_NAME,
    concepts=replace(
        DOMAIN.concepts,
        training=TRAINING[True],
        suites=traffic.WIDE_SUITES,
        table=Path(__file__).parent / "wide_embeddings.safetensors",
    ),
    source=partial(Expert, wide=True),
    closed_loop=replace(LOOP, policies=policies("standing")),
    comparison=replace(DOMAIN.comparison, paper=None),
)
"""Driving with scenarios with rules in pretraining."""
