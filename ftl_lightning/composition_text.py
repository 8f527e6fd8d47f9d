"""Compositions in words, as the command line and ``FewShot.compose`` take them: ``'walk@legs:0.8 + learned.safetensors'``."""

import math
from typing import NamedTuple

from ftl_lightning.errors import UserError, short
from ftl_lightning.ranges import LARGEST_FACTOR


class Part(NamedTuple):
    """A part of a composition, as it is told in words.

    Attributes:
        concept: its text or file.
        weight: omega.
        groups: names of the groups of columns that its weight is on; all columns where empty.
    """

    concept: str
    weight: float = 1.0
    groups: tuple[str, ...] = ()


def parse_composition(text: str) -> list[Part]:
    """Concepts, weights and groups of columns from ``'circle right of square:1.2 + walk@legs,trunk:0.8'``; a missing weight is 1.

    Raises:
        UserError: for a weight that is no number up to :data:`~ftl_lightning.ranges.LARGEST_FACTOR`, or an empty concept or group.
    """
    parts = []
    for told in text.split(" + ") if text.strip() else ():
        place, colon, weight = told.partition(":")
        concept, at, groups = place.partition("@")
        try:
            omega = float(weight) if colon else 1.0
        except ValueError:
            omega = math.nan
        part = Part(concept.strip(), omega, tuple(group.strip() for group in groups.split(",")) if at else ())
        if not (part.concept and abs(part.weight) <= LARGEST_FACTOR and all(part.groups)):
            raise UserError(
                "compose: expected 'concept:weight + concept@group:weight', "
                f"weights up to {LARGEST_FACTOR:g}, found {short(told)!r}"
            )
        parts.append(part)
    return parts
