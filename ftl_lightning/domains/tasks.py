"""Evaluation tasks and suites."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ftl_lightning.services.errors import require
from ftl_lightning.services.validation import from_mapping

WITHOUT_WEIGHT = -0.5
"""Guidance weight of the texts in ``without``."""


@dataclass(frozen=True)
class EvaluationTask:
    """Behaviour to generate, and the goal it is judged by.

    Attributes:
        setting: name of the group over which results are averaged, e.g. ``'training composition'``.
        goal: text of the task, as the domain's metrics read it.
        learned: names of the learned concepts that are composed, usually one.
        texts: training concepts in the composition.
        without: training concepts in the composition with the negative weight :data:`WITHOUT_WEIGHT`: what behaviour should not be.
        component: number (from 1) of the only component of the learned concept that is used, or ``None`` for all.
        on: concepts, learned or texts, that act on some groups of a state's columns only, each with the names of the groups.
        initial: where plans start, in domains with initial states: in new ones, or where the demonstrations of the learned concept
            start (``'demonstrated'``) or end (``'last'``).

    Raises:
        UserError: at construction, for ``learned``, ``texts`` or ``without`` that are no tuples, or where a single component or the
            demonstrations' starts are asked for without exactly one learned concept.
    """

    setting: str
    goal: str
    learned: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    component: int | None = None
    on: tuple[tuple[str, tuple[str, ...]], ...] = ()
    initial: Literal["new", "demonstrated", "last"] = "new"

    def __post_init__(self) -> None:
        place = f"evaluation task {self.goal!r}"
        for key in ("learned", "texts", "without"):
            names = getattr(self, key)
            require(isinstance(names, tuple), f"{place}: {key}", "a tuple of names", repr(names))
        special = "component" if self.component is not None else "initial" if self.initial != "new" else ""
        require(not special or len(self.learned) == 1, f"{place}: {special}", "one learned concept", len(self.learned))

    @property
    def name(self) -> str:
        """Name within its setting."""
        return self.goal if self.component is None else f"{self.goal} (learned from: {self.learned[0]})"


@dataclass(frozen=True)
class Suite:
    """Suite of evaluation tasks that are reported together."""

    tasks: tuple[EvaluationTask, ...]

    @property
    def learned(self) -> tuple[str, ...]:
        """Distinct names of the concepts to learn, in order."""
        return tuple(dict.fromkeys(name for task in self.tasks for name in task.learned))

    @property
    def settings(self) -> tuple[str, ...]:
        """Distinct names of the settings, in order."""
        return tuple(dict.fromkeys(task.setting for task in self.tasks))

    @property
    def goals(self) -> tuple[str, ...]:
        """Distinct goals, in order."""
        return tuple(dict.fromkeys(task.goal for task in self.tasks))


def training_suite(concepts: tuple[str, ...]) -> Suite:
    """Suite of single training concepts."""
    return Suite(tuple(EvaluationTask("training concept", text, texts=(text,)) for text in concepts))


def read_suites(path: Path) -> dict[str, Suite]:
    """Suites of a CSV file by name: a line for each task, with the attributes of :class:`EvaluationTask` but ``on``.

    Several names are separated by semicolons; an empty cell is the attribute's default.
    """
    suites: dict[str, tuple[EvaluationTask, ...]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for number, row in enumerate(csv.DictReader(file), start=2):
            given: dict[str, Any] = {key: text for key, text in row.items() if text}
            given |= {key: given[key].split("; ") for key in ("learned", "texts", "without") if key in given}
            given |= {"component": int(given["component"])} if "component" in given else {}
            suite = given.pop("suite")
            suites[suite] = (*suites.get(suite, ()), from_mapping(EvaluationTask, given, f"line {number}"))
    return {name: Suite(tasks) for name, tasks in suites.items()}


def few_shot_suites(training: tuple[str, ...], new: tuple[str, ...]) -> dict[str, Suite]:
    """The suites ``'training'`` and ``'new'``, of concepts learned from a few demonstrations each; goals are their texts."""
    return {"training": training_suite(training), "new": Suite(tuple(EvaluationTask("new concept", text, (text,)) for text in new))}
