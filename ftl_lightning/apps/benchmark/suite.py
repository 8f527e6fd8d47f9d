"""Frozen suites: training data, test tasks and measures, with hashes of all generated data."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain, Recoveries, Source
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.services.tensor_file import bytes_hash, file_hash
from ftl_lightning.services.validation import from_mapping, read_json

FOLDER = Path(__file__).parent / "suites"
SEEDS = (0, 1, 2)
"""Seeds of the protocol."""
CLOSE = 1e-3
"""Maximum relative difference of mean and mean square that is due to rounding on another processor."""
TRAINING, DEMONSTRATIONS, VALIDATION, STARTS = "training", "demonstrations", "validation", "starts"
"""Parts of a suite's data."""
ASKED = (DEMONSTRATIONS, STARTS)
"""Parts that every run draws, also without pretraining."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A test task: a setting and a concept of the domain's test suite."""

    setting: str
    concept: str


@dataclass(frozen=True, kw_only=True)
class Training:
    """Pretraining data.

    Attributes:
        concepts: texts of the concepts.
        count: demonstrations per concept.
        recoveries: additional demonstrations per concept, if it has any, which start from failures.
    """

    concepts: Sequence[str]
    count: int
    recoveries: int = 0


@dataclass(frozen=True, kw_only=True)
class Print:
    """Fingerprint of data: the hash of their bytes and, as rounding differs between processors, mean and mean square."""

    hash: str
    mean: float
    square: float

    @classmethod
    def of(cls, tensors: Sequence[Tensor], known_by: str) -> "Print":
        """The fingerprint of tensors with a known hash."""
        every = torch.cat([tensor.double().flatten() for tensor in tensors])
        return cls(hash=known_by, mean=float(f"{every.mean():.8g}"), square=float(f"{every.square().mean():.8g}"))

    def is_near(self, other: "Print") -> bool:
        """Whether mean and mean square are equal up to rounding."""
        size = max(self.square**0.5, 1e-12)
        return abs(self.mean - other.mean) <= CLOSE * size and abs(self.square - other.square) <= CLOSE * size**2


@dataclass(frozen=True, kw_only=True)
class BenchmarkSuite:
    """A suite.

    Attributes:
        name: name of its file.
        title: title in words.
        domain: name of the domain, or ``module:ATTRIBUTE`` of this package.
        needs: extra with the simulator; empty for none.
        recordings: whether data are read from the user's copy.
        training: pretraining data.
        validation: concepts on which a method may be tuned.
        test: test tasks, never tuned on.
        test_suite: name of the test suite in the domain.
        demonstrations: demonstrations per new concept.
        samples: samples or episodes per concept.
        closed_loop: whether plans are executed.
        references: whether reference lines are measured, too; some are slow.
        measures: kind of each measure by name: a ``rate`` of right samples, or an ``error rate`` or a ``distance``, for which less
            is better; the first measure is the suite's score.
        data: fingerprints of the parts, by seed.
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
        """16-digit hash of the suite's file."""
        return file_hash(FOLDER / f"{self.name}.json")

    def loaded(self) -> Domain:
        """Its domain, checked for the concepts of the suite.

        Raises:
            UserError: for another version of the domain, or a missing simulator.
        """
        domain = load_domain(self.domain)
        with about(f"suite {self.name}"):
            tasks = {(task.setting, task.name) for task in domain.concepts.suites[self.test_suite].tasks}
            if (
                tuple(self.training.concepts) != domain.concepts.training
                or not {(t.setting, t.concept) for t in self.test} <= tasks
            ):
                raise UserError(f"expected the concepts of the frozen suite, found others in domain {domain.name}; it was changed")
            if self.closed_loop and domain.closed_loop is not None:
                domain.closed_loop.expect()
        return domain

    def prints(self, seed: int, root: Path | None, parts: Sequence[str]) -> dict[str, Print]:
        """Fingerprints of the data of a seed by part, without initial states where there are none."""
        domain = self.loaded()
        prints = {}
        for part in parts:
            if part == STARTS:
                source = domain.source(root)
                starts = [source.starts(task.concept, self.samples, EVALUATION_SEED + seed) for task in self.test]
                tensors = [tensor for states in starts if states is not None for tensor in states.observed.values()]
                if tensors:
                    known_by = bytes_hash(b"".join(tensor.contiguous().numpy().tobytes() for tensor in tensors))
                    prints[part] = Print.of(tensors, known_by)
            else:
                drawn = self.drawn(part, seed, root)
                prints[part] = Print.of([drawn.states], drawn.hash)
        return prints

    def drawn(self, part: str, seed: int, root: Path | None) -> Demonstrations:
        """The demonstrations of a part.

        Args:
            part: ``training``, ``demonstrations`` of the test's concepts, or ``validation`` for the concepts to tune on.
            seed: seed of the data.
            root: folder of the user's copy of the data.
        """
        source = self.loaded().source(root)
        if part == TRAINING:
            return self._training(source, seed)
        concepts = self.validation if part == VALIDATION else self.learned
        return concatenate([source.draw(concept, self.demonstrations, DEMONSTRATION_SEED + seed) for concept in concepts])

    def _training(self, source: Source, seed: int) -> Demonstrations:
        demonstrations = source.split("train", self.training.count, seed)
        if self.training.recoveries and isinstance(source, Recoveries):
            demonstrations = concatenate([demonstrations, source.recoveries("train", self.training.recoveries, seed)])
        return demonstrations

    @property
    def learned(self) -> tuple[str, ...]:
        """Distinct new concepts, in the order of the domain's suite."""
        return load_domain(self.domain).concepts.suites[self.test_suite].learned

    def check_data(self, seed: int, root: Path | None, parts: Sequence[str]) -> bool:
        """Compare data with the frozen suite. Parts without a fingerprint are skipped.

        Returns:
            Whether the data are bit-identical; else they differ by rounding.

        Raises:
            UserError: for other data, with suite, seed, part and both hashes.
        """
        known = self.data.get(str(seed), {})
        prints = self.prints(seed, root, [part for part in parts if part in known])
        for part, value in prints.items():
            if value.hash != known[part].hash and not value.is_near(known[part]):
                raise UserError(
                    f"suite {self.name}, seed {seed}, {part}: expected data with the hash {known[part].hash}, found {value.hash}: "
                    "the generator was changed; take the version of ftl-lightning that the suite was frozen in"
                )
        return all(value.hash == known[part].hash for part, value in prints.items())


def suite_names() -> tuple[str, ...]:
    """Sorted names of the suites."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def load_suite(name: str) -> BenchmarkSuite:
    """Load a suite.

    Raises:
        UserError: for an unknown name or a damaged file.
    """
    if name not in suite_names():
        raise UserError(f"suites: expected some of {', '.join(suite_names())}, found {short(name)!r}")
    path = FOLDER / f"{name}.json"
    with about(path):
        return from_mapping(BenchmarkSuite, read_json(path, "a suite"), "")


def suites() -> Iterator[BenchmarkSuite]:
    """All suites."""
    return (load_suite(name) for name in suite_names())
