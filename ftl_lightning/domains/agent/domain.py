"""The domain object: what the rest of the package knows of navigation."""

from collections.abc import Callable

import torch
from torch import Tensor

from ftl_lightning.demonstrations.cache import cached
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.agent import environment, expert
from ftl_lightning.domains.agent import scenes as scene_settings
from ftl_lightning.domains.agent.environment import LOOKAHEAD, MAX_STEPS, AgentEnvironment
from ftl_lightning.domains.agent.metrics import progressed, reached
from ftl_lightning.domains.agent.published import PUBLISHED
from ftl_lightning.domains.agent.rendering import frames, render
from ftl_lightning.domains.agent.scenes import (
    OBJECT_COLUMNS,
    PLANE,
    STATE,
    object_positions,
    parse,
    scenes,
    target,
)
from ftl_lightning.domains.agent.tasks import SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.agent.views import VIEWS
from ftl_lightning.domains.domain import ClosedLoop, Domain
from ftl_lightning.errors import UserError

NAME = "agent"
HORIZON = 128
STATE_NAMES = tuple(
    f"agent.{column}"
    for column in ("x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "angular vx", "angular vy", "angular vz")
)
STATE_UNITS = ("m",) * 3 + ("1",) * 4 + ("m/s",) * 3 + ("rad/s",) * 3
_SETTINGS = {
    name: getattr(module, name)
    for module, names in (
        (environment, ("STEP", "SUBSTEPS", "DRAG", "MASS", "MAX_FORCE", "RADIUS", "LOOKAHEAD", "MARGIN")),
        (scene_settings, ("AGENT_START", "OBJECT_X", "OBJECT_Z", "AGENT_CLEARANCE", "OBJECT_CLEARANCE", "COLOURS", "SHAPES")),
        (expert, ("LENGTH", "SPEED", "KEEP_CLEAR", "STOP", "AT_REST")),
    )
    for name in names
}
"""What decides a demonstration besides task, count and seed."""


def demonstrations(tasks: tuple[str, ...], count: int, seed: int) -> Demonstrations:
    """``count`` drives of each task by the expert, from the cache if they are there."""
    return cached(
        {"domain": NAME, "tasks": tasks, "count": count, "seed": seed, **_SETTINGS},
        len(tasks) * count,
        lambda progress: _drive(tasks, count, seed, progress),
    )


def _drive(tasks: tuple[str, ...], count: int, seed: int, progress: Callable[[], None]) -> Demonstrations:
    drives = [expert.demonstrations(task, count, seed, progress) for task in tasks]
    observations = torch.cat([seen for seen, _ in drives])
    return Demonstrations(
        states=observations[..., :STATE].contiguous(),
        lengths=torch.cat([lengths for _, lengths in drives]),
        domain=NAME,
        state_names=STATE_NAMES,
        state_units=STATE_UNITS,
        concepts=tuple(task for task in tasks for _ in range(count)),
        initial_states=observations,
        provenance={"generator": NAME, "seed": seed, "count_per_task": count},
    )


def reads(task: str) -> bool:
    """Whether a text is a goal."""
    try:
        return bool(parse(task))
    except UserError:
        return False


def act(plans: Tensor, step: int, observations: Tensor) -> Tensor:
    """Forces ``(episode, 2)``: the way to where the plan is :data:`LOOKAHEAD` steps ahead (paper, closed loop).

    Args:
        plans: ``(episode, horizon, 13)``.
        step: steps since the plan was made.
        observations: ``(episode, 52)``.
    """
    ahead = plans[:, min(step + LOOKAHEAD, plans.shape[1] - 1)]
    return (ahead - observations[:, :STATE])[:, list(PLANE)]


def _straight(initial_states: Tensor, chosen: Tensor) -> Tensor:
    """Plans ``(scene, horizon, 13)`` straight to the chosen object, at the expert's speed."""
    objects = object_positions(initial_states)
    goal = objects[torch.arange(len(objects)), chosen]
    start = initial_states[:, None, :3]
    way = (goal - initial_states[:, :3])[:, None]
    length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    driven = torch.minimum(torch.arange(HORIZON)[None, :, None] * environment.STEP * expert.SPEED, length)
    plans = initial_states[:, None, :STATE].repeat(1, HORIZON, 1)
    plans[..., :3] = start + way * driven / length
    return plans


def _nearest(goal: str, count: int, initial_states: Tensor | None, seed: int) -> Tensor:
    assert initial_states is not None
    away = torch.linalg.vector_norm(object_positions(initial_states) - initial_states[:, None, :3], dim=-1)
    return _straight(initial_states, away.argmin(dim=1))


def _random(goal: str, count: int, initial_states: Tensor | None, seed: int) -> Tensor:
    assert initial_states is not None
    draw = torch.Generator().manual_seed(seed)
    return _straight(initial_states, torch.randint(2, (len(initial_states),), generator=draw))


def _oracle(goal: str, count: int, initial_states: Tensor | None, seed: int) -> Tensor:
    assert initial_states is not None
    env = AgentEnvironment()
    drives = [
        torch.from_numpy(expert.demonstrate(env, state, chosen))
        for state, chosen in zip(initial_states.numpy(), target(goal, initial_states).tolist(), strict=True)
    ]
    env.close()
    rows = torch.arange(HORIZON)
    return torch.stack([drive[rows.clamp(max=len(drive) - 1), :STATE] for drive in drives])


# Position, and as its looks colour and shape, of each object; its type (object 1 or 2) is what tells apart what should be alike.
_ENTITIES = tuple((*range(columns.start, columns.start + 3), *range(columns.start + 6, columns.stop)) for columns in OBJECT_COLUMNS)

DOMAIN = Domain(
    name=NAME,
    horizon=HORIZON,
    state_names=STATE_NAMES,
    state_units=STATE_UNITS,
    training_concepts=TRAINING_CONCEPTS,
    suites=SUITES,
    descriptions=tuple(dict.fromkeys((*TRAINING_CONCEPTS, *(task.goal for suite in SUITES.values() for task in suite.tasks)))),
    training_set=lambda count, seed: demonstrations(TRAINING_CONCEPTS, count, seed),
    generate=lambda task, count, seed, workers=1: demonstrations((task,), count, seed),
    reads=reads,
    succeeded=progressed,
    render=render,
    initial_states=scenes,
    views=VIEWS,
    entities=_ENTITIES,
    looks=tuple(range(3, len(_ENTITIES[0]))),
    state_columns=tuple(range(STATE)),
    early=3.0,
    closed_loop=ClosedLoop(environment=AgentEnvironment, act=act, steps=MAX_STEPS, judge=reached, frames=frames),
    references={"nearest object": _nearest, "random object": _random, "expert (oracle)": _oracle},
    published=PUBLISHED,
    omega="0.6",
    published_omega="1.6",
)
