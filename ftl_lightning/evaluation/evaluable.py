"""Interface of evaluated modules."""

from collections.abc import Callable
from typing import Any, Protocol, TypeGuard

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.point import Point
from ftl_lightning.training.concept_model import ConceptModel


class Evaluable(Protocol):
    """Module with a model, names of method, form, variant and learned concepts, and points of concept space."""

    model: ConceptModel
    hparams: Any

    @property
    def domain(self) -> Domain: ...

    @property
    def method(self) -> str: ...

    @property
    def form(self) -> str: ...

    @property
    def variant(self) -> str: ...

    @property
    def concepts(self) -> tuple[str, ...]: ...

    def composition(self, task: EvaluationTask) -> Composition | None: ...

    def demonstrated(self, concept: str) -> Demonstrations | None: ...

    def concept_points(self) -> list[Point]: ...


def is_evaluable(module: object) -> TypeGuard[Evaluable]:
    """Whether a module implements :class:`Evaluable`.

    ``isinstance`` does not work: from Python 3.12 on it ignores ``__getattr__``, which provides submodules such as the model.
    """
    members = (*Evaluable.__annotations__, *(name for name in vars(Evaluable) if not name.startswith("_")))
    return all(hasattr(module, name) for name in members)


def demonstrations_of(task: EvaluationTask, demonstrated: Callable[[str], Demonstrations | None]) -> Demonstrations | None:
    """Concatenate the demonstrations of a task's learned concepts; ``None`` without learned concepts.

    Args:
        task: evaluated task.
        demonstrated: function from a concept's name to its demonstrations.
    """
    learned = [demonstrations for name in task.learned if (demonstrations := demonstrated(name)) is not None]
    return concatenate(learned) if len(learned) > 1 else next(iter(learned), None)
