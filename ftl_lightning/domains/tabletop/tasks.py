"""The tasks of the table-top, and when one is done."""

from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.errors import UserError

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
"""Of the paper."""
WIDE_CONCEPTS = (*TRAINING_CONCEPTS, PUSH_TO_BOWL, PUSH_TO_WHITE, BESIDE_TRIANGLE)
"""Of the wide model: pushes and picks to several things, of which no pair of verb and thing is asked for in the end."""
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
"""The validation task is of another kind, so that nothing is tuned on what is asked in the end.

``representation`` is the paper's baseline: the scenes of the new task, told to push as on the table.
"""
WIDE_SUITES = {
    "training": training_suite(WIDE_CONCEPTS),
    "paper": SUITES["paper"],
    "pairs": Suite((EvaluationTask("new concept", PUSH_TO_BOOK, (PUSH_TO_BOOK,)),)),
    "validation": SUITES["validation"],
}
"""``pairs``: a verb and a thing that pretraining shows apart from each other."""


def expect_task(task: str) -> str:
    """The task itself.

    Raises:
        UserError: for one that is not known.
    """
    if task not in TASKS:
        raise UserError(f"table-top task: expected one of {', '.join(map(repr, TASKS))}, found {task!r}")
    return task
