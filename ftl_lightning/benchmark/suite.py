"""Frozen suites: what is given, what is asked and how it is measured, as data, with hashes of all that is generated."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain, Recoveries, Source
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.errors import UserError, about, short
from ftl_lightning.schema import from_mapping, read_json
from ftl_lightning.seeding import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.tensor_file import bytes_hash, file_hash

FOLDER = Path(__file__).parent / "suites"
SEEDS = (0, 1, 2)
"""Of the protocol."""
CLOSE = 1e-3
"""Data whose mean and mean square differ by less, relatively, are those of another processor, which rounds in another way."""
TRAINING, DEMONSTRATIONS, VALIDATION, STARTS = "training", "demonstrations", "validation", "starts"
"""Parts of a suite's data."""
ASKED = (DEMONSTRATIONS, STARTS)
"""Those that a run draws whether it pretrains or not."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """What is asked: a setting and a concept, as the domain's suite of the test has them."""

    setting: str
    concept: str


@dataclass(frozen=True, kw_only=True)
class Training:
    """What a method may be pretrained on.

    Attributes:
        concepts: with a text each.
        count: demonstrations of each.
        recoveries: demonstrations more of each concept that has some, which begin where behaviour went wrong.
    """

    concepts: Sequence[str]
    count: int
    recoveries: int = 0


@dataclass(frozen=True, kw_only=True)
class Print:
    """What data are known by: the hash of their bytes and, for processors that round in another way, mean and mean square."""

    hash: str
    mean: float
    square: float

    @classmethod
    def of(cls, tensors: Sequence[Tensor], known_by: str) -> "Print":
        """That of some numbers, with the hash that they have."""
        every = torch.cat([tensor.double().flatten() for tensor in tensors])
        return cls(hash=known_by, mean=float(f"{every.mean():.8g}"), square=float(f"{every.square().mean():.8g}"))

    def is_near(self, other: "Print") -> bool:
        """Whether the numbers are the same but for rounding, as far as mean and mean square tell."""
        size = max(self.square**0.5, 1e-12)
        return abs(self.mean - other.mean) <= CLOSE * size and abs(self.square - other.square) <= CLOSE * size**2


@dataclass(frozen=True, kw_only=True)
class BenchmarkSuite:
    """A suite.

    Attributes:
        name: of its file.
        title: in words.
        domain: name of the domain, or ``module:ATTRIBUTE`` of this package.
        needs: extra whose simulator it takes; empty for none.
        recordings: whether data are read from the user's own copy.
        training: what a method may be pretrained on.
        validation: concepts on which a method may be tuned.
        test: what is asked, and never tuned on.
        test_suite: the domain's suite that holds the test.
        demonstrations: that each new concept is learned from.
        samples: of each concept, or episodes.
        closed_loop: whether plans are executed.
        references: whether reference lines are measured, too; somewhere they take long.
        measures: by name, what each is: a ``rate`` of right samples, an ``error rate`` or a ``distance``, of both of which less is
            better; the first is the suite's score.
        data: prints of the parts, by seed.
    """

    name: str
    title: str
    domain: str
    needs: str = ""
    recordings: bool = False
    training: Training
    validation: Sequence[str]
    test: Sequence[Task]
    test_suite: str
    demonstrations: int
    samples: int
    closed_loop: bool = False
    references: bool = True
    measures: Mapping[str, Literal["rate", "error rate", "distance"]]
    data: Mapping[str, Mapping[str, Print]] = field(default_factory=dict)

    def is_rate(self, measure: str) -> bool:
        """Whether a measure is a share of samples."""
        return self.measures[measure] != "distance"

    @property
    def headline(self) -> str:
        """The measure that is the suite's score."""
        return next(iter(self.measures))

    @property
    def hash(self) -> str:
        """16-digit hash of the file that defines it."""
        return file_hash(FOLDER / f"{self.name}.json")

    def loaded(self) -> Domain:
        """Its domain, which has to have the concepts that the suite says.

        Raises:
            UserError: for another version of the domain, or one whose simulator is missing.
        """
        domain = load_domain(self.domain)
        with about(f"suite {self.name}"):
            asked = {(task.setting, task.name) for task in domain.concepts.suites[self.test_suite].tasks}
            if (
                tuple(self.training.concepts) != domain.concepts.training
                or not {(t.setting, t.concept) for t in self.test} <= asked
            ):
                raise UserError(f"expected the concepts of the frozen suite, found others in domain {domain.name}; it was changed")
            if self.closed_loop and domain.closed_loop is not None:
                domain.closed_loop.expect()
        return domain

    def prints(self, seed: int, root: Path | None, parts: Sequence[str]) -> dict[str, Print]:
        """Prints of what is generated from a seed, by the parts' names; of initial states only where there are some."""
        domain = self.loaded()
        found = {}
        for part in parts:
            if part == STARTS:
                source = domain.source(root)
                starts = [source.starts(task.concept, self.samples, EVALUATION_SEED + seed) for task in self.test]
                tensors = [tensor for one in starts if one is not None for tensor in one.observed.values()]
                if tensors:
                    known_by = bytes_hash(b"".join(tensor.contiguous().numpy().tobytes() for tensor in tensors))
                    found[part] = Print.of(tensors, known_by)
            else:
                drawn = self.drawn(part, seed, root)
                found[part] = Print.of([drawn.states], drawn.hash)
        return found

    def drawn(self, part: str, seed: int, root: Path | None) -> Demonstrations:
        """The demonstrations of a part.

        Args:
            part: ``training``, ``demonstrations`` of the test's concepts, or ``validation``: those of the concepts to tune on.
            seed: decides them.
            root: folder of the user's copy of the data.
        """
        source = self.loaded().source(root)
        if part == TRAINING:
            return self._training(source, seed)
        concepts = self.validation if part == VALIDATION else self.learned
        return concatenate([source.draw(concept, self.demonstrations, DEMONSTRATION_SEED + seed) for concept in concepts])

    def _training(self, source: Source, seed: int) -> Demonstrations:
        found = source.split("train", self.training.count, seed)
        if self.training.recoveries and isinstance(source, Recoveries):
            found = concatenate([found, source.recoveries("train", self.training.recoveries, seed)])
        return found

    @property
    def learned(self) -> tuple[str, ...]:
        """New concepts, each once, in the order of the domain's suite."""
        return load_domain(self.domain).concepts.suites[self.test_suite].learned

    def expect_data(self, seed: int, root: Path | None, parts: Sequence[str]) -> bool:
        """Refuse data that are not those of the frozen suite. Parts whose print the suite does not have are not looked at.

        Returns:
            Whether they are the same to the last bit; else they are rounded in another way.

        Raises:
            UserError: naming suite, seed, part and both hashes.
        """
        known = self.data.get(str(seed), {})
        found = self.prints(seed, root, [part for part in parts if part in known])
        for part, one in found.items():
            if one.hash != known[part].hash and not one.is_near(known[part]):
                raise UserError(
                    f"suite {self.name}, seed {seed}, {part}: expected data with the hash {known[part].hash}, found {one.hash}: "
                    "the generator was changed; take the version of ftl-lightning that the suite was frozen in"
                )
        return all(one.hash == known[part].hash for part, one in found.items())


def suite_names() -> tuple[str, ...]:
    """Names of the suites that ship, in alphabetical order."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def load_suite(name: str) -> BenchmarkSuite:
    """A suite by its name.

    Raises:
        UserError: for a name that is none, or a damaged file.
    """
    if name not in suite_names():
        raise UserError(f"suites: expected some of {', '.join(suite_names())}, found {short(name)!r}")
    path = FOLDER / f"{name}.json"
    with about(path):
        return from_mapping(BenchmarkSuite, read_json(path, "a suite"), "")


def suites() -> Iterator[BenchmarkSuite]:
    """All that ship."""
    return (load_suite(name) for name in suite_names())
