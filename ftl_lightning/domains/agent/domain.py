"""Domain object of navigation, with its metrics, view and reference policies."""

import itertools
from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.data.distances import path_distance
from ftl_lightning.data.features import InitialStates, Observed, check_starts
from ftl_lightning.domains.agent import scenes
from ftl_lightning.domains.agent.expert import NAME, SPEED, STATE_NAMES, STATE_UNITS, Expert, demonstrate, environment
from ftl_lightning.domains.comparison import Comparison, Paper, published
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Metric, Plans, Recordings, View, deferred
from ftl_lightning.domains.execution import ClosedLoop, Rollout
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.recorder import Recorder
from ftl_lightning.domains.tasks import read_suites, training_suite
from ftl_lightning.services.errors import UserError

HERE = Path(__file__).parent
SUITES = {"training": training_suite(scenes.TRAINING_CONCEPTS)} | read_suites(HERE / "suites.csv")
"""``paper``, and ``components`` (each of two learned components alone), are the paper's settings. For tuning: ``validation``, three
new combinations of colour and shape and three from pretraining, each with a known and two new distractors, by the paper's rule; and
``compositions``, the same targets as compositions of colour and shape, either or both learned."""
HORIZON = 128
RENDERING = "ftl_lightning.domains.agent.rendering"


def reads(task: str) -> bool:
    """Whether a text is a goal."""
    try:
        return bool(scenes.parse(task))
    except UserError:
        return False


def _to_each(goal: str, positions: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
    """Distances in metres ``(scene, time)`` of positions ``(scene, time, 3)`` to the target and to the distractor."""
    both = torch.linalg.vector_norm(positions[:, :, None] - scenes.object_positions(world)[:, None], dim=-1)
    chosen = scenes.target(goal, world)[:, None, None].expand(-1, both.shape[1], 1)
    return both.gather(-1, chosen)[..., 0], both.gather(-1, 1 - chosen)[..., 0]


def progressed(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether a plan ``(scene, horizon, 13)`` ends nearer to the target than it starts ``(scene,)`` (paper, open loop)."""
    world = check_starts(starts).observed[scenes.OBSERVED]
    to_target, _ = _to_each(goal, torch.cat((world[:, None, :3], states[:, -1:, :3]), dim=1), world)
    return to_target[:, -1] < to_target[:, 0]


def reached(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Outcomes of episodes ``(episode,)`` of bool (paper, closed loop).

    ``distractor``: the agent comes within :data:`~ftl_lightning.domains.agent.scenes.REACH` of the distractor. ``success``: it ends
    within that distance of the target without ``distractor``. ``progress``: it ends nearer to the target than it starts.
    """
    world = rollout.observed[scenes.OBSERVED]
    to_target, to_distractor = _to_each(goal, world[..., :3], world[:, 0])
    end, touched = to_target[:, -1], (to_distractor < scenes.REACH).any(dim=1)
    return {"success": (end < scenes.REACH) & ~touched, "distractor": touched, "progress": end < to_target[:, 0]}


def _encode_steps(states: Tensor, observed: Observed) -> Tensor:
    """Difference of each state ``(sample, horizon, 13)`` from the preceding state; the first from the present."""
    return torch.diff(states, dim=1, prepend=observed[scenes.OBSERVED][:, None, : scenes.STATE])


def _decode_steps(steps: Tensor, observed: Observed) -> Tensor:
    """Inverse of :func:`_encode_steps`."""
    # Not cumsum, which has no deterministic form on GPUs.
    present = observed[scenes.OBSERVED][:, : scenes.STATE]
    return torch.stack(list(itertools.accumulate(steps.unbind(dim=1), initial=present))[1:], dim=1)


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Forces ``(episode, 2)``: displacement to the plan's state ``LOOKAHEAD`` steps ahead (paper, closed loop)."""
    ahead = plans[:, min(step + scenes.LOOKAHEAD, plans.shape[1] - 1)]
    return (ahead - observed[scenes.OBSERVED][:, : scenes.STATE])[:, list(scenes.PLANE)]


def _straight(world: Tensor, chosen: Tensor) -> Tensor:
    """Plans ``(scene, horizon, 13)`` straight to the chosen object, at the expert's speed."""
    goal = scenes.object_positions(world)[torch.arange(len(world)), chosen]
    direction = (goal - world[:, :3])[:, None]
    length = torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    driven = torch.minimum(torch.arange(HORIZON)[None, :, None] * scenes.STEP * SPEED, length)
    plans = world[:, None, : scenes.STATE].repeat(1, HORIZON, 1)
    plans[..., :3] = world[:, None, :3] + direction * driven / length
    return plans


def _nearest(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    world = check_starts(starts).observed[scenes.OBSERVED]
    distances = torch.linalg.vector_norm(scenes.object_positions(world) - world[:, None, :3], dim=-1)
    return _straight(world, distances.argmin(dim=1))


def _random(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    world = check_starts(starts).observed[scenes.OBSERVED]
    return _straight(world, torch.randint(2, (len(world),), generator=torch.Generator().manual_seed(seed)))


def _oracle(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    env, world = environment(), check_starts(starts).observed[scenes.OBSERVED]
    targets = scenes.target(goal, world).tolist()
    drives = [torch.from_numpy(demonstrate(env, *pair)) for pair in zip(world.numpy(), targets, strict=True)]
    env.close()
    rows = torch.arange(HORIZON)
    return torch.stack([drive[rows.clamp(max=len(drive) - 1), : scenes.STATE] for drive in drives])


def distance(states: Tensor, others: Tensor) -> Tensor:
    """Root mean square distance ``(a, b)`` in metres between the agent's paths in the plane, relative to their starts."""
    paths, other_paths = states[..., list(scenes.PLANE)], others[..., list(scenes.PLANE)]
    return path_distance(paths - paths[:, :1], other_paths - other_paths[:, :1])


_STEPS = View({scenes.OBSERVED: scenes.FEATURE}, observe=lambda observed: observed, encode=_encode_steps, decode=_decode_steps)
"""View for autoregressive methods, which need not copy the state: it changes by about 1 % a step."""

DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, STATE_NAMES, STATE_UNITS, start_exponent=3.0, resolution=1e-3, views={"steps": _STEPS}),
    concepts=Concepts(training=scenes.TRAINING_CONCEPTS, suites=SUITES, reads=reads, table=HERE / "embeddings.safetensors"),
    source=lambda root: Expert(),
    observed={scenes.OBSERVED: scenes.FEATURE},
    metrics={ACCURACY: Metric(progressed)},
    show=Show(deferred(f"{RENDERING}:render"), vector_film=deferred(f"{RENDERING}:plan_film")),
    closed_loop=ClosedLoop(
        environment=environment,
        act=act,
        steps=scenes.MAX_STEPS,
        judge=reached,
        film=deferred(f"{RENDERING}:film"),
        vector_film=deferred(f"{RENDERING}:vector_film"),
        expect=scenes.check_simulator,
    ),
    comparison=Comparison(
        headline="closed loop success",
        references={"nearest object": _nearest, "random object": _random, "expert (oracle)": _oracle},
        distance=distance,
        paper=Paper(published(HERE / "published.csv"), omega="1.6", ours="0.6"),
    ),
    recordings=Recordings(
        recorder=Recorder(
            "steer",
            "Lead the agent, the brown dot, to where it should go; each time other objects stand elsewhere.",
            deferred(f"{RENDERING}:scene"),
            deferred(f"{RENDERING}:record"),
            tuple(dict.fromkeys(goal for name in ("training", "paper", "validation") for goal in SUITES[name].goals)),
        )
    ),
)
