"""Tasks of driving: the paper's scenarios, and the validation suite for tuning."""

from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite

TRAINING_CONCEPTS = ("highway", "exit", "merge", "intersection")
NEW = "new initial state"

TRAINING = training_suite(TRAINING_CONCEPTS)
PAPER = Suite((EvaluationTask(NEW, "roundabout", learned=("roundabout",)),))
VALIDATION = Suite((EvaluationTask(NEW, "roundabout third exit", learned=("roundabout third exit",)),))
"""Another route through the same roundabout."""

OTHER = Suite(
    tuple(
        EvaluationTask("other roundabout", name, learned=("roundabout",))
        for name in ("roundabout of three lanes", "roundabout of one lane")
    )
)
"""Roundabouts of other sizes, for the concept learned in the paper's roundabout; not used for tuning."""

SUITES = {"training": TRAINING, "paper": PAPER, "validation": VALIDATION, "other roundabouts": OTHER}
