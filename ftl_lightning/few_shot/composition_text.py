"""Text of compositions on the command line and in ``FewShot.compose``: ``'walk@legs:0.8 + learned.safetensors'``."""

import math
from typing import NamedTuple

from ftl_lightning.services.errors import UserError, short
from ftl_lightning.services.validation import LARGEST_FACTOR


class Part(NamedTuple):
    """A part of a composition in text.

    Attributes:
        concept: text or file of the concept.
        weight: guidance weight omega.
        groups: groups of columns that the weight applies to; empty for all columns.
    """

    concept: str
    weight: float = 1.0
    groups: tuple[str, ...] = ()


def parse_composition(text: str) -> list[Part]:
    """Parse a composition such as ``'circle right of square:1.2 + walk@legs,trunk:0.8'``; the default weight is 1.

    Raises:
        UserError: for a weight that exceeds :data:`~ftl_lightning.services.validation.LARGEST_FACTOR`, or an empty concept or
            group.
    """
    parts = []
    for term in text.split(" + ") if text.strip() else ():
        place, colon, weight = term.partition(":")
        concept, at, groups = place.partition("@")
        try:
            omega = float(weight) if colon else 1.0
        except ValueError:
            omega = math.nan
        part = Part(concept.strip(), omega, tuple(group.strip() for group in groups.split(",")) if at else ())
        if not (part.concept and abs(part.weight) <= LARGEST_FACTOR and all(part.groups)):
            raise UserError(
                "compose: expected 'concept:weight + concept@group:weight', "
                f"weights up to {LARGEST_FACTOR:g}, found {short(term)!r}"
            )
        parts.append(part)
    return parts
