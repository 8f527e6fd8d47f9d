"""Tasks of Meta-World: names, texts, and the suites of its benchmarks."""

import csv
from collections.abc import Collection
from pathlib import Path

from ftl_lightning.domains.tasks import EvaluationTask, Suite, training_suite

HERE = Path(__file__).parent
with (HERE / "tasks.csv").open(encoding="utf-8", newline="") as file:
    ROWS = tuple(csv.DictReader(file))
NAMES = tuple(row["name"] for row in ROWS)
"""Names of the 50 tasks; a scene holds the number of a name."""
TEXTS = {row["name"]: row["text"] for row in ROWS}
"""Concept of each task, by the task's name."""
NUMBER = {row["text"]: number for number, row in enumerate(ROWS)}
"""Number of each task, by its concept."""
NUMBERS = tuple(str(fold) for fold in range(1, 10))
"""Folds of ML45's training tasks, five tasks each, drawn at random."""
VALIDATION = ("button-press", "faucet-open", "handle-pull", "plate-slide", "peg-unplug-side", "coffee-pull")
"""Tasks for tuning: training tasks of ML45 outside ML10."""


DETOURS = {
    "reach-wall": ("reach", "pick-place-wall"),
    "push-wall": ("push", "reach-wall"),
    "button-press-wall": ("button-press", "reach-wall"),
    "button-press-topdown-wall": ("button-press-topdown", "reach-wall"),
}
"""Tasks behind a wall, with two training concepts that describe them together: the task without a wall, and a way past a wall."""


def texts(**columns: Collection[str]) -> tuple[str, ...]:
    """Concepts of the tasks whose columns have one of the values, in the file's order."""
    return tuple(row["text"] for row in ROWS if all(row[key] in values for key, values in columns.items()))


def learned(setting: str, concepts: tuple[str, ...]) -> Suite:
    """Suite of tasks learned from demonstrations."""
    return Suite(tuple(EvaluationTask(setting, text, (text,)) for text in concepts))


def suites(training: tuple[str, ...], new: tuple[str, ...]) -> dict[str, Suite]:
    """Suites: ``training``; ``paper``, the test tasks; ``validation``, tasks in neither; ``composition``, of :data:`DETOURS`."""
    validation = tuple(text for text in (TEXTS[name] for name in VALIDATION) if text not in (*training, *new))
    made = {"training": training_suite(training), "paper": learned("new concept", new)}
    made |= {"validation": learned("new concept", validation)} if validation else {}
    named = {TEXTS[name]: tuple(TEXTS[part] for part in parts) for name, parts in DETOURS.items()}
    if set(training) >= {text for goal, parts in named.items() for text in (goal, *parts)}:
        tasks = [EvaluationTask("composition", goal, texts=parts) for goal, parts in named.items()]
        made["composition"] = Suite(
            (*tasks, *(EvaluationTask("one of both", goal, texts=parts[:1]) for goal, parts in named.items()))
        )
    return made
