"""Protocol for learning concepts without a trainer."""

from collections.abc import Callable
from typing import Protocol

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.concept import Concept
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.inversion_settings import InversionSettings


class Learner(Protocol):
    """Learns every concept of the demonstrations."""

    def __call__(
        self,
        model: ConceptModel,
        demonstrations: Demonstrations,
        settings: InversionSettings,
        steps: int,
        tell: Callable[[float], None] = ...,
        /,
    ) -> dict[str, Concept]:
        """Learned concepts by name.

        Args:
            model: the frozen model.
            demonstrations: demonstrations; their concept texts name the concepts.
            settings: settings of the inversion; ignored without gradient descent.
            steps: gradient steps.
            tell: called with the mean loss after each step.
        """
