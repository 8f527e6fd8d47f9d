"""Requests of the page, as read from JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ftl_lightning.services.errors import require
from ftl_lightning.services.validation import check_count, check_factor, check_range

MOST_SAMPLES, MOST_DRAWN, MOST_PARTS, MOST_NAME = 64, 20, 12, 100
"""Maximum number of samples and of drawn demonstrations per request, of concepts in a mixture, and of letters in a name."""
MOST_TEMPERATURE = 4.0


def check_name(name: str) -> None:
    """Refuse an invalid name. Raise UserError for an empty or too long name, or letters that cannot be printed."""
    require(1 <= len(name.strip()) <= MOST_NAME and name.isprintable(), "name", f"1 to {MOST_NAME} letters", len(name))


@dataclass(frozen=True)
class Open:
    """Open a model, by name."""

    model: str


@dataclass(frozen=True)
class Pose:
    """Draw a new scene, of a task where scenes differ."""

    task: str = ""


@dataclass(frozen=True)
class Recorded:
    """Demonstration recorded by hand in a scene: positions ``(step, piece, 2)`` in the film's unit, and seconds from any zero. They
    are checked by :func:`~ftl_lightning.domains.recorder.check_path`, sizes first.
    """

    scene: int
    path: Any
    seconds: Any


@dataclass(frozen=True)
class Drawn:
    """Draw demonstrations from the library."""

    task: str
    count: int = 5

    def __post_init__(self) -> None:
        check_count("count", self.count, 1, MOST_DRAWN)


@dataclass(frozen=True)
class One:
    """A demonstration by its number."""

    id: int


@dataclass(frozen=True)
class Named:
    """A concept, by its identifier on the page."""

    id: str


@dataclass(frozen=True)
class Renamed:
    """New name of a concept that was learned or opened here."""

    id: str
    name: str

    def __post_init__(self) -> None:
        check_name(self.name)


@dataclass(frozen=True)
class Nothing:
    """Request without content."""


@dataclass(frozen=True)
class Learn:
    """Learn the concept ``name`` quickly from the current demonstrations, in the paper's form; or with ``again``, the identifier of
    a concept that was learned so, from its demonstrations in the form that these select. ``replaces`` is the identifier of a
    concept learned here that the new one replaces; empty for none.
    """

    name: str = ""
    again: str = ""
    replaces: str = ""

    def __post_init__(self) -> None:
        if not self.again:
            check_name(self.name)


@dataclass(frozen=True)
class Mixed:
    """Term of a mixture: identifier of a concept on the page, factor of its weight, and groups of columns (empty for all)."""

    id: str
    weight: float = 1.0
    groups: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_factor(f"weight of {self.id}", self.weight)


@dataclass(frozen=True)
class Sample:
    """Generate samples of a mixture. ``temperature`` is ``None`` for the tuned value, ``task`` empty for the default initial
    states.
    """

    parts: Sequence[Mixed]
    count: int = 8
    seed: int = 0
    temperature: float | None = None
    execute: bool = False
    task: str = ""

    def __post_init__(self) -> None:
        check_count("parts", len(self.parts), 1, MOST_PARTS)
        check_count("count", self.count, 1, MOST_SAMPLES)
        check_range("seed", self.seed, 0)
        if self.temperature is not None:
            check_range("temperature", self.temperature, 0, MOST_TEMPERATURE)
