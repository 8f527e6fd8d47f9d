"""Tasks of object rearrangement: the paper's settings and numbers, and the validation suite for tuning."""

from pathlib import Path

from ftl_lightning.domains.comparison import published
from ftl_lightning.domains.object_rearrangement.scenes import AND, NOT, SHAPES, TRAINING_RELATIONS, Relation
from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite

TRAINING_CONCEPTS = tuple(str(relation) for relation in TRAINING_RELATIONS)


def _ring(radius: float) -> str:
    return str(Relation("ring", SHAPES, radius))


def _suite(compositions: tuple[str, ...], new_concepts: tuple[str, ...], with_training: dict[str, tuple[str, ...]]) -> Suite:
    return Suite(
        tuple(EvaluationTask("training composition", task, learned=(task,)) for task in compositions)
        + tuple(EvaluationTask("new concept", task, learned=(task,)) for task in new_concepts)
        + tuple(
            EvaluationTask("new + training", f"{new} and {text}", learned=(new,), texts=(text,))
            for new, texts in with_training.items()
            for text in texts
        )
    )


TRAINING = training_suite(TRAINING_CONCEPTS)
PAPER = _suite(
    compositions=(
        "triangle right of square and circle above square",
        "square right of triangle and circle above triangle",
        "circle right of square and triangle above square",
        "square right of circle and triangle above circle",
        "circle right of triangle and triangle right of square",
    ),
    new_concepts=(
        _ring(1.67),
        "square diagonal to triangle",
        "triangle diagonal to square",
        "circle diagonal to triangle",
        "triangle diagonal to circle",
    ),
    with_training={
        "square diagonal to triangle": (
            "circle right of square",
            "circle above square",
            "circle above triangle",
            "circle right of triangle",
            "triangle above circle",
        )
    },
)

VALIDATION = _suite(
    compositions=(
        "triangle right of circle and square above circle",
        "circle right of triangle and square above triangle",
        "square right of triangle and triangle right of circle",
        "triangle above square and square above circle",
        "circle right of square and circle above triangle",
        "triangle right of circle and triangle above square",
    ),
    new_concepts=(
        *(_ring(radius) for radius in (1.0, 1.25, 2.1, 2.3)),
        "circle antidiagonal to triangle",
        "triangle antidiagonal to square",
        "square antidiagonal to circle",
        "circle next to square",
    ),
    with_training={
        f"{a} antidiagonal to {b}": (
            f"{c} right of {a}",
            f"{c} above {a}",
            f"{c} above {b}",
            f"{c} right of {b}",
            f"{b} right of {c}",
        )
        for a, b, c in (("circle", "triangle", "square"), ("triangle", "square", "circle"), ("square", "circle", "triangle"))
    },
)

COMPONENTS = Suite(
    tuple(
        EvaluationTask(f"component {component}", part, learned=(task.goal,), component=component)
        for task in PAPER.tasks
        if task.setting == "training composition"
        for part in task.goal.split(AND)
        for component in (1, 2)
    )
)
"""Generation with each of two learned components alone (paper, table 'Analysis of learned concepts')."""

COMPOSITIONS = Suite(
    tuple(
        EvaluationTask("two learned concepts", AND.join(pair), learned=pair)
        for pair in (
            ("square antidiagonal to circle", "circle antidiagonal to triangle"),
            ("circle antidiagonal to triangle", "triangle antidiagonal to square"),
            ("triangle antidiagonal to square", "square antidiagonal to circle"),
            (_ring(1.0), "circle antidiagonal to triangle"),
            (_ring(1.25), "square antidiagonal to circle"),
            (_ring(2.1), "triangle antidiagonal to square"),
        )
    )
    + tuple(
        EvaluationTask("ring + training", f"{ring}{AND}{text}", learned=(ring,), texts=(text,))
        for ring, text in (
            (_ring(1.0), "circle above square"),
            (_ring(1.25), "triangle right of circle"),
            (_ring(2.1), "square above triangle"),
            (_ring(2.3), "circle right of triangle"),
        )
    )
    + tuple(
        EvaluationTask("three texts", AND.join(texts), texts=texts)
        for texts in (
            ("circle right of triangle", "circle right of square", "square above triangle"),
            ("triangle right of circle", "triangle right of square", "square above circle"),
            ("square above circle", "square above triangle", "circle right of triangle"),
            ("square above circle", "square above triangle", "triangle right of circle"),
            ("triangle right of circle", "circle right of square", "triangle right of square"),
            ("circle above triangle", "triangle above square", "circle above square"),
        )
    )
    + tuple(
        EvaluationTask("not", f"{text}{AND}{NOT}{excluded}", texts=(text,), without=(excluded,))
        for text, excluded in (
            ("circle above square", "triangle right of square"),
            ("triangle right of circle", "square above triangle"),
            ("square above triangle", "circle right of triangle"),
            ("circle right of triangle", "square above triangle"),
            ("square above circle", "triangle right of circle"),
            ("triangle right of square", "circle above square"),
        )
    )
)
"""Compositions beyond the validation suite, for tuning: two of its learned concepts, a ring and a training concept, three training
concepts (no two form a task of the paper), and a training concept without another that would often hold by chance."""

SUITES = {"training": TRAINING, "paper": PAPER, "components": COMPONENTS, "validation": VALIDATION, "compositions": COMPOSITIONS}

DESCRIBED = tuple(
    dict.fromkeys((*TRAINING_CONCEPTS, *(goal for suite in (TRAINING, PAPER, COMPONENTS, VALIDATION) for goal in suite.goals)))
)
"""Texts in the table of embeddings; compositions are left out, as their parts are included."""

PUBLISHED = published(Path(__file__).parent / "published.csv")  # the paper's numbers
