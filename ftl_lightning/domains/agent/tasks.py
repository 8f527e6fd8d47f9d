"""Tasks of navigation: the paper's settings and numbers, and the validation suite for tuning."""

from collections.abc import Sequence
from pathlib import Path

from ftl_lightning.domains.agent.scenes import parse
from ftl_lightning.domains.comparison import published
from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite

TRAINING_CONCEPTS = ("go to red object", "go to yellow object", "go to bowl", "go to cube")
COMPOSITIONS = ("go to red bowl", "go to yellow bowl", "go to red cube", "go to yellow cube", "go to purple cone")

TRAINING = training_suite(TRAINING_CONCEPTS)


def _suite(learned: Sequence[str]) -> Suite:
    return Suite(
        tuple(EvaluationTask("training composition", task, learned=(task,), initial="demonstrated") for task in learned)
        + tuple(EvaluationTask("new initial state", task, learned=(task,)) for task in learned)
    )


PAPER = _suite(COMPOSITIONS)

VALIDATION = _suite(
    ("go to green cone", "go to purple sphere", "go to green sphere", "go to red cone", "go to yellow sphere", "go to purple bowl")
)
"""Targets for tuning: three new combinations of colour and shape and three from pretraining, each with a known and two new
distractors, by the paper's rule."""


def _parts(task: str) -> tuple[str, str]:
    """The two concepts of a composition, named as in the paper's analysis."""
    goal = parse(task)
    return f"go to {goal.colour} object", f"go to {goal.shape}"


COMPONENTS = Suite(
    tuple(
        EvaluationTask(f"component {component}", part, learned=(task,), component=component)
        for task in COMPOSITIONS
        for part in _parts(task)
        for component in (1, 2)
    )
)
"""Generation with each of two learned components alone (paper, table 'Analysis of learned concepts')."""

COMPOSED = Suite(
    (
        *(
            EvaluationTask("two learned concepts", f"go to {colour} {shape}", learned=(f"go to {colour} object", f"go to {shape}"))
            for colour, shape in (("green", "cone"), ("green", "sphere"), ("purple", "sphere"))
        ),
        EvaluationTask("new + training", "go to red cone", learned=("go to cone",), texts=("go to red object",)),
        EvaluationTask("new + training", "go to yellow sphere", learned=("go to sphere",), texts=("go to yellow object",)),
        EvaluationTask("new + training", "go to purple bowl", learned=("go to purple object",), texts=("go to bowl",)),
    )
)
"""Targets of the validation suite as compositions of colour and shape, either or both learned; for tuning."""

SUITES = {"training": TRAINING, "paper": PAPER, "components": COMPONENTS, "validation": VALIDATION, "compositions": COMPOSED}

PUBLISHED = published(Path(__file__).parent / "published.csv")  # the paper's numbers
