"""The domain object: what the rest of the package knows of object rearrangement."""

from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Metric, Plans, Show, Split, deferred
from ftl_lightning.domains.object_rearrangement.generation import generate, random_scenes
from ftl_lightning.domains.object_rearrangement.published import PUBLISHED
from ftl_lightning.domains.object_rearrangement.relations import SHAPES, holds, parse, sentence
from ftl_lightning.domains.object_rearrangement.tasks import SUITES, TRAINING_CONCEPTS
from ftl_lightning.domains.paper import Paper
from ftl_lightning.errors import UserError
from ftl_lightning.seeding import VALIDATION_SEED

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


class Generator:
    """Scenes drawn anew from a seed."""

    def split(self, name: Split, count: int, seed: int) -> Demonstrations:
        return _demonstrations(TRAINING_CONCEPTS, count, seed if name == "train" else VALIDATION_SEED + seed)

    def draw(self, task: str, count: int, seed: int, workers: int = 1) -> Demonstrations:
        return _demonstrations((task,), count, seed)

    def starts(self, task: str, count: int, seed: int) -> None:
        """A scene starts nowhere."""


def succeeded(goal: str, states: Tensor, starts: InitialStates | None = None) -> Tensor:
    """Whether every relation of a goal holds in its relaxed form (paper, 'Evaluation data and metrics').

    Args:
        goal: relations in words.
        states: ``(sample, 1, 21)`` in the domain's units.
        starts: there are none.

    Returns:
        ``(sample,)`` of bool.
    """
    return torch.stack([holds(relation, states[:, 0], relaxed=True) for relation in parse(goal)]).all(dim=0)


DOMAIN = Domain(
    name=NAME,
    plans=Plans(1, STATE_NAMES, STATE_UNITS, resolution=1e-3),
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES,
        descriptions=tuple(dict.fromkeys((*TRAINING_CONCEPTS, *(goal for suite in SUITES.values() for goal in suite.goals)))),
        reads=reads,
        sentence=sentence,
        table=Path(__file__).parent / "embeddings.safetensors",
    ),
    source=lambda root: Generator(),
    metrics={ACCURACY: Metric(succeeded)},
    show=Show(deferred("ftl_lightning.domains.object_rearrangement.rendering:render")),
    references={
        "random scenes": lambda goal, count, starts, seed: random_scenes(count, seed)[:, None],
        "generator (oracle)": lambda goal, count, starts, seed: generate(goal, count, seed)[:, None],
    },
    paper=Paper(PUBLISHED, omega="1.2", ours="1.2"),
)
