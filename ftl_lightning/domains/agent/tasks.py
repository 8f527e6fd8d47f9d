"""Tasks of navigation: the paper's settings and numbers, and the validation suite for tuning."""

from collections.abc import Sequence

from ftl_lightning.domains.agent.scenes import parse
from ftl_lightning.domains.comparison import Published
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

_NEW = "new initial state"
PUBLISHED = (
    # Table 'Ablation on the number of learned concepts' (learned weights)
    Published("training composition", 0.52, 0.08, components=1),
    Published("training composition", 0.68, 0.13, components=2),
    Published(_NEW, 0.54, 0.07, components=1),
    Published(_NEW, 0.67, 0.05, components=2),
    # Table 'Classifier-free guidance weight choice effect'; learned weights are in the table above
    *(
        Published(_NEW, value, error, omega=omega)
        for omega, value, error in (("1.2", 0.64, 0.08), ("1.4", 0.66, 0.05), ("1.6", 0.73, 0.07), ("1.8", 0.63, 0.06))
    ),
    # Table 'Analysis of learned concepts': generation with each component alone
    *(
        Published(f"component {component}", value, task=f"{goal} (learned from: go to {colour} {shape})")
        for colour, a, b, shape, c, d in (
            ("red", 0.42, 0.48, "bowl", 0.66, 0.56),
            ("yellow", 0.72, 0.44, "bowl", 0.58, 0.74),
            ("red", 0.42, 0.76, "cube", 0.44, 0.96),
            ("yellow", 0.40, 0.32, "cube", 0.82, 0.78),
            ("purple", 0.48, 0.42, "cone", 0.56, 0.36),
        )
        for goal, values in ((f"go to {colour} object", (a, b)), (f"go to {shape}", (c, d)))
        for component, value in enumerate(values, start=1)
    ),
    # Baselines in the table of guidance weights
    *(
        Published(_NEW, value, error, method=method)
        for method, value, error in (("BC", 0.46, 0.05), ("CVAE", 0.60, 0.06), ("in-context", 0.57, 0.03), ("language", 0.63, 0.07))
    ),
)
"""The paper's numbers for navigation."""
