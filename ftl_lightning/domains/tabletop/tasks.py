"""The tasks of the table-top, and when one is done."""

from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite
from ftl_lightning.errors import UserError

TO_BOOK = "pick green circle to book"
TO_WHITE = "pick green circle to elevated white surface"
PUSH = "push green circle to orange triangle"
AROUND_BOWL = "push green circle to orange triangle around purple bowl"
PUSH_ON_BOOK = "push green circle to orange triangle on book"
BESIDE_BOWL = "pick green circle to beside purple bowl"

TRAINING_CONCEPTS = (TO_BOOK, TO_WHITE, PUSH, AROUND_BOWL)
"""Of the paper."""
TASKS = (*TRAINING_CONCEPTS, PUSH_ON_BOOK, BESIDE_BOWL)
PUSHES = (PUSH, AROUND_BOWL, PUSH_ON_BOOK)

SUITES = {
    "training": training_suite(TRAINING_CONCEPTS),
    "paper": Suite((EvaluationTask("new concept", PUSH_ON_BOOK, (PUSH_ON_BOOK,)),)),
    "representation": Suite((EvaluationTask("training representation", PUSH_ON_BOOK, texts=(PUSH,)),)),
    "validation": Suite((EvaluationTask("new concept", BESIDE_BOWL, (BESIDE_BOWL,)),)),
}
"""The validation task is of another kind, so that nothing is tuned on what is asked in the end.

``representation`` is the paper's baseline: the scenes of the new task, told to push as on the table.
"""


def expect_task(task: str) -> str:
    """The task itself.

    Raises:
        UserError: for one that is not known.
    """
    if task not in TASKS:
        raise UserError(f"table-top task: expected one of {', '.join(map(repr, TASKS))}, found {task!r}")
    return task
