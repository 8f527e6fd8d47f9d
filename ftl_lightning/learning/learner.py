"""Learning concepts without a trainer: what a method offers to the Python API."""

from collections.abc import Callable
from typing import Protocol

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.inversion_settings import InversionSettings


class Learner(Protocol):
    """Learns every concept of some demonstrations."""

    def __call__(
        self,
        model: ConceptModel,
        demonstrations: Demonstrations,
        settings: InversionSettings,
        steps: int,
        tell: Callable[[float], None] = ...,
        /,
    ) -> dict[str, Concept]:
        """The concepts by name.

        Args:
            model: frozen.
            demonstrations: with concept texts, which name the concepts.
            settings: how; a method without gradient descent does not look at them.
            steps: of gradient descent.
            tell: called with the mean loss after each step.
        """
