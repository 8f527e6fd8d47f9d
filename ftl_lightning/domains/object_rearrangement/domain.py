"""Domain object of object rearrangement."""

from pathlib import Path

import torch
from torch import Tensor

from ftl_lightning.data.distances import path_distance
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.comparison import Comparison, Paper, published
from ftl_lightning.domains.domain import ACCURACY, Concepts, Domain, Generated, Metric, Plans, Recordings, deferred
from ftl_lightning.domains.object_rearrangement.scenes import (
    PER_SHAPE,
    SHAPES,
    TRAINING_RELATIONS,
    generate,
    holds,
    parse,
    random_scenes,
    sentence,
)
from ftl_lightning.domains.pictures import Show
from ftl_lightning.domains.recorder import Recorder
from ftl_lightning.domains.tasks import read_suites, training_suite
from ftl_lightning.services.errors import UserError

NAME = "object_rearrangement"
HERE = Path(__file__).parent
TRAINING_CONCEPTS = tuple(map(str, TRAINING_RELATIONS))
SUITES = {"training": training_suite(TRAINING_CONCEPTS)} | read_suites(HERE / "suites.csv")
"""``paper``, and ``components`` (each of two learned components alone), are the paper's settings. For tuning: ``validation``, and
``compositions``: two of its learned concepts, a ring and a training concept, three training concepts (no two form a task of the
paper), and a training concept without another that would often hold by chance."""
DESCRIBED = ("training", "paper", "components", "validation")  # parts of compositions are in these suites
STATE_NAMES = tuple(
    f"{shape}.{column}" for shape in SHAPES for column in ("x", "y", "radius", "angle", *(f"is_{kind}" for kind in SHAPES))
)
STATE_UNITS = ("length", "length", "length", "rad", "1", "1", "1") * len(SHAPES)
CENTRES = tuple(shape * PER_SHAPE + axis for shape in range(len(SHAPES)) for axis in range(2))
"""Columns of the shapes' centres."""
PLANS = Plans(1, STATE_NAMES, STATE_UNITS, resolution=1e-3)


def reads(task: str) -> bool:
    """Whether a text is a conjunction of relations."""
    try:
        return bool(parse(task))
    except UserError:
        return False


def succeeded(goal: str, states: Tensor, starts: InitialStates | None = None) -> Tensor:
    """Whether every relation of a goal holds in its relaxed form in states ``(sample, 1, 21)`` (paper, 'Evaluation data and
    metrics').
    """
    return torch.stack([holds(relation, states[:, 0], relaxed=True) for relation in parse(goal)]).all(dim=0)


def distance(states: Tensor, others: Tensor) -> Tensor:
    """Euclidean distance ``(a, b)`` between the shapes' centres in length units; tasks do not concern sizes or angles."""
    return path_distance(states[..., CENTRES], others[..., CENTRES])


RENDERING = "ftl_lightning.domains.object_rearrangement.rendering"
DOMAIN = Domain(
    name=NAME,
    plans=PLANS,
    concepts=Concepts(
        training=TRAINING_CONCEPTS,
        suites=SUITES,
        descriptions=tuple(dict.fromkeys(goal for name in DESCRIBED for goal in SUITES[name].goals)),
        reads=reads,
        sentence=sentence,
        table=HERE / "embeddings.safetensors",
    ),
    source=lambda root: Generated(NAME, PLANS, TRAINING_CONCEPTS, lambda task, count, seed: generate(task, count, seed)[:, None]),
    metrics={ACCURACY: Metric(succeeded)},
    show=Show(deferred(f"{RENDERING}:render"), vector_film=deferred(f"{RENDERING}:vector_film")),
    comparison=Comparison(
        references={
            "random scenes": lambda goal, count, starts, seed: random_scenes(count, seed)[:, None],
            "generator (oracle)": lambda goal, count, starts, seed: generate(goal, count, seed)[:, None],
        },
        distance=distance,
        paper=Paper(published(HERE / "published.csv"), omega="1.2", ours="1.2"),
    ),
    recordings=Recordings(
        recorder=Recorder(
            "arrange",
            "Put the three shapes where they show what you mean; their sizes are new each time.",
            deferred(f"{RENDERING}:scene"),
            deferred(f"{RENDERING}:record"),
        )
    ),
)
