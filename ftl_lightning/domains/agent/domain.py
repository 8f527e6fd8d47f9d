"""Domain object of navigation."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ftl_lightning.data.cache import cached
from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import InitialStates, Observed, check_starts
from ftl_lightning.domains.agent import dynamics, expert
from ftl_lightning.domains.agent import scenes as scene_settings
from ftl_lightning.domains.agent.dynamics import LOOKAHEAD, MAX_STEPS, check_simulator
from ftl_lightning.domains.agent.metrics import progressed, reached
from ftl_lightning.domains.agent.published import PUBLISHED
from ftl_lightning.domains.agent.scenes import FEATURE, OBSERVED, PLANE, STATE, object_positions, parse, scenes, target
from ftl_lightning.domains.agent.tasks import SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.agent.views import VIEWS
from ftl_lightning.domains.deferred import deferred
from ftl_lightning.domains.distances import path_distance
from ftl_lightning.domains.domain import ACCURACY, ClosedLoop, Concepts, Domain, Metric, Plans, Show, Split
from ftl_lightning.domains.paper import Paper
from ftl_lightning.domains.recorder import Recorder
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import VALIDATION_SEED

if TYPE_CHECKING:
    from ftl_lightning.domains.agent.environment import AgentEnvironment

NAME = "agent"
HORIZON = 128
RENDERING, STEERING = "ftl_lightning.domains.agent.rendering", "ftl_lightning.domains.agent.steering"
STATE_NAMES = tuple(
    f"agent.{column}"
    for column in ("x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "angular vx", "angular vy", "angular vz")
)
STATE_UNITS = ("m",) * 3 + ("1",) * 4 + ("m/s",) * 3 + ("rad/s",) * 3
_SETTINGS = {
    name: getattr(module, name)
    for module, names in (
        (dynamics, ("STEP", "SUBSTEPS", "DRAG", "MASS", "MAX_FORCE", "RADIUS", "LOOKAHEAD", "MARGIN")),
        (scene_settings, ("AGENT_START", "OBJECT_X", "OBJECT_Z", "AGENT_CLEARANCE", "OBJECT_CLEARANCE", "COLOURS", "SHAPES")),
        (expert, ("LENGTH", "SPEED", "KEEP_CLEAR", "STOP", "AT_REST")),
    )
    for name in names
}
"""Settings that determine demonstrations besides task, count and seed (cache key)."""


def demonstrations(tasks: tuple[str, ...], count: int, seed: int) -> Demonstrations:
    """``count`` expert drives of each task, from the cache if present."""
    return cached(
        {"domain": NAME, "tasks": tasks, "count": count, "seed": seed, **_SETTINGS},
        len(tasks) * count,
        lambda progress: _drive(tasks, count, seed, progress),
    )


def _drive(tasks: tuple[str, ...], count: int, seed: int, progress: Callable[[], None]) -> Demonstrations:
    parts = [expert.demonstrations(task, count, seed, progress) for task in tasks]
    return drives(
        torch.cat([seen for seen, _ in parts]),
        torch.cat([lengths for _, lengths in parts]),
        tuple(task for task in tasks for _ in range(count)),
        {"generator": NAME, "seed": seed, "count_per_task": count},
    )


def drives(observations: Tensor, lengths: Tensor, concepts: tuple[str, ...], provenance: Mapping[str, Any]) -> Demonstrations:
    """Convert drives ``(demo, time, 52)`` to demonstrations."""
    return Demonstrations(
        states=observations[..., :STATE].contiguous(),
        lengths=lengths,
        domain=NAME,
        state_names=STATE_NAMES,
        state_units=STATE_UNITS,
        concepts=concepts,
        observed={OBSERVED: observations},
        per_step=(OBSERVED,),
        scenes=observations[:, 0].contiguous(),
        provenance=provenance,
    )


def reads(task: str) -> bool:
    """Whether a text is a goal."""
    try:
        return bool(parse(task))
    except UserError:
        return False


class Expert:
    """Source of expert drives, cached."""

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        return demonstrations(TRAINING_CONCEPTS, count, seed if name == "train" else VALIDATION_SEED + seed)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        return demonstrations((task,), count, seed)

    def starts(self, task: str, count: int, seed: int) -> InitialStates:
        return initial_states(scenes(task, count, seed))


def initial_states(drawn: Tensor) -> InitialStates:
    """Initial states of scenes ``(scene, 52)``, which are fully observed."""
    return InitialStates({OBSERVED: drawn}, drawn)


def environment() -> "AgentEnvironment":
    """Environment of the domain.

    Raises:
        UserError: without the simulator, or if it does not start.
    """
    check_simulator()
    from ftl_lightning.domains.agent.environment import AgentEnvironment

    return AgentEnvironment()


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Forces ``(episode, 2)``: displacement to the plan's state :data:`LOOKAHEAD` steps ahead (paper, closed loop).

    Args:
        plans: ``(episode, horizon, 13)``.
        step: steps since the plan was made.
        observed: ``world (episode, 52)``.
    """
    ahead = plans[:, min(step + LOOKAHEAD, plans.shape[1] - 1)]
    return (ahead - observed[OBSERVED][:, :STATE])[:, list(PLANE)]


def _straight(world: Tensor, chosen: Tensor) -> Tensor:
    """Plans ``(scene, horizon, 13)`` straight to the chosen object, at the expert's speed."""
    objects = object_positions(world)
    goal = objects[torch.arange(len(objects)), chosen]
    start = world[:, None, :3]
    way = (goal - world[:, :3])[:, None]
    length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    driven = torch.minimum(torch.arange(HORIZON)[None, :, None] * dynamics.STEP * expert.SPEED, length)
    plans = world[:, None, :STATE].repeat(1, HORIZON, 1)
    plans[..., :3] = start + way * driven / length
    return plans


def _nearest(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    world = check_starts(starts).observed[OBSERVED]
    away = torch.linalg.vector_norm(object_positions(world) - world[:, None, :3], dim=-1)
    return _straight(world, away.argmin(dim=1))


def _random(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    world = check_starts(starts).observed[OBSERVED]
    draw = torch.Generator().manual_seed(seed)
    return _straight(world, torch.randint(2, (len(world),), generator=draw))


def _oracle(goal: str, count: int, starts: InitialStates | None, seed: int) -> Tensor:
    env, world = environment(), check_starts(starts).observed[OBSERVED]
    drives = [
        torch.from_numpy(expert.demonstrate(env, state, chosen))
        for state, chosen in zip(world.numpy(), target(goal, world).tolist(), strict=True)
    ]
    env.close()
    rows = torch.arange(HORIZON)
    return torch.stack([drive[rows.clamp(max=len(drive) - 1), :STATE] for drive in drives])


def _from_start(states: Tensor) -> Tensor:
    """Paths ``(plan, horizon, 2)`` in the plane, relative to their start."""
    paths = states[..., list(PLANE)]
    return paths - paths[:, :1]


def distance(states: Tensor, others: Tensor) -> Tensor:
    """Root mean square distance ``(a, b)`` in metres between the agent's paths in the plane, relative to their starts.

    The start is given, not generated. The end depends on the scene: correct plans in new scenes are novel.
    """
    return path_distance(_from_start(states), _from_start(others))


DOMAIN = Domain(
    name=NAME,
    plans=Plans(HORIZON, STATE_NAMES, STATE_UNITS, start_exponent=3.0, resolution=1e-3),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES,
        reads=reads,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=lambda root: Expert(),
    observed={OBSERVED: FEATURE},
    metrics={ACCURACY: Metric(progressed)},
    headline="closed loop success",
    show=Show(deferred(f"{RENDERING}:render"), vector_film=deferred(f"{RENDERING}:plan_film")),
    references={"nearest object": _nearest, "random object": _random, "expert (oracle)": _oracle},
    views=VIEWS,
    closed_loop=ClosedLoop(
        environment=environment,
        act=act,
        steps=MAX_STEPS,
        judge=reached,
        film=deferred(f"{RENDERING}:film"),
        vector_film=deferred(f"{RENDERING}:vector_film"),
        expect=check_simulator,
    ),
    distance=distance,
    paper=Paper(PUBLISHED, omega="1.6", ours="0.6"),
    recorder=Recorder(
        "steer",
        "Lead the agent, the brown dot, to where it should go; each time other objects stand elsewhere.",
        deferred(f"{STEERING}:scene"),
        deferred(f"{STEERING}:record"),
        tuple(dict.fromkeys((*TRAINING_CONCEPTS, *(goal for name in ("paper", "validation") for goal in SUITES[name].goals)))),
    ),
)
