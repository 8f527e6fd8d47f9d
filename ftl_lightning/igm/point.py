"""Labelled embeddings of a concept space."""

from typing import NamedTuple

from torch import Tensor

EMPTY_CONCEPT, TRAINING_CONCEPT, NEW_COMPONENT = "empty concept", "training concept", "new component"
"""Values of :attr:`Point.set`."""


class Part(NamedTuple):
    """An embedding of a learned concept. Numbers count from 1.

    Attributes:
        weight: weight of the component.
        embedding: ``(n,)``.
        component: number of the component.
        mode: number of the mode; ``None`` without modes.
        knot: number of the knot; ``None`` for a single knot.
    """

    weight: float
    embedding: Tensor
    component: int
    mode: int | None = None
    knot: int | None = None

    @property
    def name(self) -> str:
        """Name such as ``'component 1'``, ``'mode 2, component 1'`` or ``'component 1, knot 3'``."""
        mode = "" if self.mode is None else f"mode {self.mode}, "
        return f"{mode}component {self.component}{'' if self.knot is None else f', knot {self.knot}'}"


class Point(NamedTuple):
    """An embedding of a concept space.

    Attributes:
        text: name of the concept.
        set: :data:`EMPTY_CONCEPT`, :data:`TRAINING_CONCEPT` or :data:`NEW_COMPONENT`.
        embedding: ``(n,)``.
        part: part of a learned concept; ``None`` otherwise.
    """

    text: str
    set: str
    embedding: Tensor
    part: Part | None = None
