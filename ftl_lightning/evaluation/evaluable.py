"""What an evaluated module offers."""

from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.learning.concept_model import ConceptModel


@runtime_checkable
class Evaluable(Protocol):
    """The model, names of the method, of its variant and of learned concepts, and embeddings."""

    model: ConceptModel
    hparams: Any

    @property
    def domain(self) -> Domain: ...

    @property
    def method(self) -> str: ...

    @property
    def variant(self) -> str: ...

    @property
    def concepts(self) -> tuple[str, ...]: ...

    def composition(self, task: EvaluationTask) -> Composition | None: ...

    def demonstrated(self, concept: str) -> Demonstrations | None: ...

    def concept_embeddings(self) -> dict[str, Tensor]: ...
