"""What the page may ask for, as it stands in a request's JSON."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from ftl_lightning.errors import UserError
from ftl_lightning.ranges import expect_count, expect_factor, expect_range

MOST_SAMPLES, MOST_DRAWN, MOST_PARTS, MOST_NAME = 64, 20, 12, 100
"""Samples at a time, demonstrations drawn at a time, concepts in a mix, and letters of a name."""
MOST_TEMPERATURE = 4.0


def expect_name(name: str) -> None:
    """Refuse a name that is none.

    Raises:
        UserError: for an empty or long one, or letters that cannot be printed.
    """
    if not 1 <= len(name.strip()) <= MOST_NAME or not name.isprintable():
        raise UserError(f"name: expected 1 to {MOST_NAME} letters, found {len(name)}")


@dataclass(frozen=True)
class Open:
    """Another model, by name."""

    model: str


@dataclass(frozen=True)
class Pose:
    """A new scene to show something in, of a task where scenes differ."""

    task: str = ""


@dataclass(frozen=True)
class Recorded:
    """What a hand did.

    Attributes:
        scene: number of the scene that it was done in.
        path: places ``(step, piece, 2)`` in the film's unit.
        seconds: of each step, from any zero.
    """

    scene: int
    path: Sequence[Sequence[Sequence[float]]]
    seconds: Sequence[float]


@dataclass(frozen=True)
class Drawn:
    """Demonstrations from the library."""

    task: str
    count: int = 5

    def __post_init__(self) -> None:
        expect_count("count", self.count, 1, MOST_DRAWN)


@dataclass(frozen=True)
class One:
    """A demonstration by its number."""

    id: int


@dataclass(frozen=True)
class Named:
    """A concept by its name on the page."""

    id: str


@dataclass(frozen=True)
class Renamed:
    """Another name for a concept that was learned or opened here."""

    id: str
    name: str

    def __post_init__(self) -> None:
        expect_name(self.name)


@dataclass(frozen=True)
class Nothing:
    """No more than the address says."""


@dataclass(frozen=True)
class Learn:
    """Learn from the demonstrations that are there.

    Attributes:
        name: of the concept.
        quick: in the paper's form and until little changes; else in the form that the demonstrations ask for.
    """

    name: str
    quick: bool = True

    def __post_init__(self) -> None:
        expect_name(self.name)


@dataclass(frozen=True)
class Mixed:
    """A concept in a mix, by its name on the page, with a weight that multiplies its own, on some groups of columns or all."""

    id: str
    weight: float = 1.0
    groups: Sequence[str] = ()

    def __post_init__(self) -> None:
        expect_factor(f"weight of {self.id}", self.weight)


@dataclass(frozen=True)
class Sample:
    """Samples of a mix.

    Attributes:
        parts: what is mixed.
        count: of samples.
        seed: of the noise and of what samples start from.
        temperature: of the sampler; ``None`` for the tuned one.
        execute: whether they are executed in closed loop.
        task: whose initial states they start from; empty for a usual one.
    """

    parts: Sequence[Mixed]
    count: int = 8
    seed: int = 0
    temperature: float | None = None
    execute: bool = False
    task: str = field(default="")

    def __post_init__(self) -> None:
        expect_count("parts", len(self.parts), 1, MOST_PARTS)
        expect_count("count", self.count, 1, MOST_SAMPLES)
        expect_range("seed", self.seed, 0)
        if self.temperature is not None and not 0 <= self.temperature <= MOST_TEMPERATURE:
            raise UserError(f"temperature: expected 0 to {MOST_TEMPERATURE:g}, found {self.temperature}")
