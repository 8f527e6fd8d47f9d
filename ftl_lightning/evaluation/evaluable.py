"""What an evaluated module offers."""

from collections.abc import Callable
from typing import Any, Protocol, TypeGuard

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.point import Point
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.learning.concept_model import ConceptModel


class Evaluable(Protocol):
    """The model, names of the method, of its form, of its variant and of learned concepts, and the points of concept space."""

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
    """Whether a module offers all of that.

    Not by ``isinstance``: from Python 3.12 on it looks past ``__getattr__``, by which a module gives its submodules, the model too.
    """
    members = (*Evaluable.__annotations__, *(name for name in vars(Evaluable) if not name.startswith("_")))
    return all(hasattr(module, name) for name in members)


def demonstrations_of(task: EvaluationTask, demonstrated: Callable[[str], Demonstrations | None]) -> Demonstrations | None:
    """What a task's concepts were learned from, one after another; ``None`` if nothing was learned.

    Args:
        task: what is evaluated.
        demonstrated: what a concept was learned from, by its name.
    """
    learned = [demonstrations for name in task.learned if (demonstrations := demonstrated(name)) is not None]
    return concatenate(learned) if len(learned) > 1 else next(iter(learned), None)
