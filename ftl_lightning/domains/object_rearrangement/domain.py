"""The domain object: what the rest of the package knows of object rearrangement."""

import functools

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.object_rearrangement.generation import generate, random_scenes
from ftl_lightning.domains.object_rearrangement.published import PUBLISHED
from ftl_lightning.domains.object_rearrangement.relations import SHAPES, holds, parse, sentence
from ftl_lightning.domains.object_rearrangement.rendering import render
from ftl_lightning.domains.object_rearrangement.tasks import SUITES, TRAINING_CONCEPTS
from ftl_lightning.errors import UserError

NAME = "object_rearrangement"
STATE_NAMES = tuple(
    f"{shape}.{column}" for shape in SHAPES for column in ("x", "y", "radius", "angle", *(f"is_{other}" for other in SHAPES))
)
STATE_UNITS = ("length", "length", "length", "rad", "1", "1", "1") * len(SHAPES)


def _demonstrations(tasks: tuple[str, ...], count: int, seed: int) -> Demonstrations:
    """``count`` scenes of each task, as demonstrations of one state."""
    states = torch.cat([generate(task, count, seed) for task in tasks])
    return Demonstrations(
        states=states[:, None],
        lengths=torch.ones(len(states), dtype=torch.int64),
        domain=NAME,
        state_names=STATE_NAMES,
        state_units=STATE_UNITS,
        concepts=tuple(task for task in tasks for _ in range(count)),
        provenance={"generator": NAME, "seed": seed, "count_per_task": count},
    )


def reads(task: str) -> bool:
    """Whether a text is a conjunction of relations."""
    try:
        return bool(parse(task))
    except UserError:
        return False


def succeeded(goal: str, states: Tensor, initial_states: Tensor | None = None) -> Tensor:
    """Whether every relation of a goal holds in its relaxed form (paper, 'Evaluation data and metrics').

    Args:
        goal: relations in words.
        states: ``(sample, 1, 21)`` in the domain's units.
        initial_states: there are none.

    Returns:
        ``(sample,)`` of bool.
    """
    return torch.stack([holds(relation, states[:, 0], relaxed=True) for relation in parse(goal)]).all(dim=0)


DOMAIN = Domain(
    name=NAME,
    horizon=1,
    state_names=STATE_NAMES,
    state_units=STATE_UNITS,
    training_concepts=TRAINING_CONCEPTS,
    suites=SUITES,
    descriptions=tuple(
        dict.fromkeys((*TRAINING_CONCEPTS, *(text for suite in SUITES.values() for task in suite.tasks for text in (task.goal,))))
    ),
    training_set=functools.partial(_demonstrations, TRAINING_CONCEPTS),
    generate=lambda task, count, seed, workers=1: _demonstrations((task,), count, seed),
    reads=reads,
    succeeded=succeeded,
    render=render,
    references={
        "random scenes": lambda goal, count, initial_states, seed: random_scenes(count, seed)[:, None],
        "generator (oracle)": lambda goal, count, initial_states, seed: generate(goal, count, seed)[:, None],
    },
    sentence=sentence,
    published=PUBLISHED,
)
