"""Embeddings of a concept space, each with what it is."""

from typing import NamedTuple

from torch import Tensor

EMPTY_CONCEPT, TRAINING_CONCEPT, NEW_COMPONENT = "empty concept", "training concept", "new component"
"""Sets of points."""


class Part(NamedTuple):
    """One embedding of a learned concept, by numbers from 1.

    Attributes:
        weight: of its component.
        embedding: ``(n,)``.
        component: which component it is.
        mode: of which mode; ``None`` for none's.
        knot: at which time of the plan; ``None`` for all.
    """

    weight: float
    embedding: Tensor
    component: int
    mode: int | None = None
    knot: int | None = None

    @property
    def name(self) -> str:
        """Such as ``'component 1'``, ``'mode 2, component 1'`` or ``'component 1, knot 3'``."""
        mode = "" if self.mode is None else f"mode {self.mode}, "
        return f"{mode}component {self.component}{'' if self.knot is None else f', knot {self.knot}'}"


class Point(NamedTuple):
    """One embedding of a concept space.

    Attributes:
        text: name of the concept.
        set: one of :data:`EMPTY_CONCEPT`, :data:`TRAINING_CONCEPT` and :data:`NEW_COMPONENT`.
        embedding: ``(n,)``.
        part: of a learned concept, which of its embeddings it is; ``None`` of one that is not learned.
    """

    text: str
    set: str
    embedding: Tensor
    part: Part | None = None
