"""Tasks of the table-top, and their evaluation suites."""

from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.services.errors import UserError

TO_BOOK = "pick green circle to book"
TO_WHITE = "pick green circle to elevated white surface"
PUSH = "push green circle to orange triangle"
AROUND_BOWL = "push green circle to orange triangle around purple bowl"
PUSH_ON_BOOK = "push green circle to orange triangle on book"
BESIDE_BOWL = "pick green circle to beside purple bowl"
PUSH_TO_BOWL = "push green circle to purple bowl"
PUSH_TO_WHITE = "push green circle to elevated white surface"
PUSH_TO_BOOK = "push green circle to book"
BESIDE_TRIANGLE = "pick green circle to beside orange triangle"

TRAINING_CONCEPTS = (TO_BOOK, TO_WHITE, PUSH, AROUND_BOWL)
"""Training concepts of the paper."""
WIDE_CONCEPTS = (*TRAINING_CONCEPTS, PUSH_TO_BOWL, PUSH_TO_WHITE, BESIDE_TRIANGLE)
"""Training concepts of the wide model: more pushes and picks, none of which is an evaluation task."""
TASKS = (*TRAINING_CONCEPTS, PUSH_ON_BOOK, BESIDE_BOWL, PUSH_TO_BOWL, PUSH_TO_WHITE, PUSH_TO_BOOK, BESIDE_TRIANGLE)
PUSHES = tuple(task for task in TASKS if task.startswith("push"))
BESIDE = (BESIDE_BOWL, BESIDE_TRIANGLE)
"""Picks that end on the table."""

SUITES = {
    "training": training_suite(TRAINING_CONCEPTS),
    "paper": Suite((EvaluationTask("new concept", PUSH_ON_BOOK, (PUSH_ON_BOOK,)),)),
    "representation": Suite((EvaluationTask("training representation", PUSH_ON_BOOK, texts=(PUSH,)),)),
    "validation": Suite((EvaluationTask("new concept", BESIDE_BOWL, (BESIDE_BOWL,)),)),
}
"""The validation task is of another kind, so that nothing is tuned on the evaluation task.

``representation`` is the paper's baseline: scenes of the new task with the text of the push on the table.
"""
WIDE_SUITES = {
    "training": training_suite(WIDE_CONCEPTS),
    "paper": SUITES["paper"],
    "pairs": Suite((EvaluationTask("new concept", PUSH_TO_BOOK, (PUSH_TO_BOOK,)),)),
    "validation": SUITES["validation"],
}
"""``pairs``: a verb and an object that pretraining shows separately."""


def check_task(task: str) -> str:
    """Return a known task.

    Raises:
        UserError: for an unknown task.
    """
    if task not in TASKS:
        raise UserError(f"table-top task: expected one of {', '.join(map(repr, TASKS))}, found {task!r}")
    return task
