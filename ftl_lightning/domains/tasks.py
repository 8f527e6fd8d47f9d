"""What is evaluated: tasks, and suites of them."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class EvaluationTask:
    """One bar of a chart: behaviour to generate and the goal it is judged by.

    Attributes:
        setting: name of the group it is averaged in, e.g. ``'training composition'``.
        goal: the task in words, as the domain's metrics read it.
        learned: name of the learned concept that is used, or ``None``.
        texts: training concepts that are composed in.
        component: number (from 1) of the only component of the learned concept that is used, or ``None`` for all.
        initial: where behaviour starts, in domains with initial states: in new ones, or in those of the demonstrations that the
            concept was learned from.
    """

    setting: str
    goal: str
    learned: str | None = None
    texts: tuple[str, ...] = ()
    component: int | None = None
    initial: Literal["new", "demonstrated"] = "new"

    @property
    def name(self) -> str:
        """Its name within its setting."""
        return self.goal if self.component is None else f"{self.goal} (learned from: {self.learned})"


@dataclass(frozen=True)
class Suite:
    """Evaluation tasks that are reported together."""

    tasks: tuple[EvaluationTask, ...]

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the concepts to learn, each once, in order."""
        return tuple(dict.fromkeys(task.learned for task in self.tasks if task.learned))

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings, each once, in order."""
        return tuple(dict.fromkeys(task.setting for task in self.tasks))

    @property
    def goals(self) -> tuple[str, ...]:
        """The goals, each once, in order."""
        return tuple(dict.fromkeys(task.goal for task in self.tasks))


def training_suite(concepts: tuple[str, ...]) -> Suite:
    """Each training concept, generated and judged by itself."""
    return Suite(tuple(EvaluationTask("training concept", text, texts=(text,)) for text in concepts))


def few_shot_suites(training: tuple[str, ...], new: tuple[str, ...]) -> dict[str, Suite]:
    """The suites ``'training'`` and ``'new'``: training concepts, and others that are learned from a few demonstrations each.

    The goal of each is its own text.
    """
    return {"training": training_suite(training), "new": Suite(tuple(EvaluationTask("new concept", text, text) for text in new))}
