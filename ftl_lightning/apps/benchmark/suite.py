"""Frozen suites: training data, test tasks and measures, with hashes of all generated data; export of the data."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain, Recoveries
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import UserError, about, require, short
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.services.tensor_file import bytes_hash, file_hash, write_text
from ftl_lightning.services.validation import from_mapping, read_json
from ftl_lightning.version import __version__

FOLDER = Path(__file__).parent / "suites"
FAMILIES = {name: f"{__package__}.families:{name.upper()}" for name in ("beats", "pictures", "reaches", "strokes")}
"""References ``module:ATTRIBUTE`` of the benchmark's domains by short name: suites' files, which are hashed, name no module."""
SEEDS = (0, 1, 2)  # seeds of the protocol
TOLERANCE = 1e-3  # maximum relative difference of mean and mean square that is due to rounding on another processor
TRAINING, DEMONSTRATIONS, VALIDATION, STARTS = "training", "demonstrations", "validation", "starts"  # parts of a suite's data
REQUIRED = (DEMONSTRATIONS, STARTS)  # parts that every run draws, also without pretraining
EXPORTED = (TRAINING, VALIDATION, DEMONSTRATIONS)  # parts that :func:`write_data` writes
FORMATS = ("npz", "safetensors", "lerobot", "minari")  # formats of exported data


@dataclass(frozen=True, kw_only=True)
class Task:
    """Test task: setting and concept of the domain's test suite."""

    setting: str
    concept: str


@dataclass(frozen=True, kw_only=True)
class Training:
    """Pretraining data: texts of concepts, demonstrations of each, and up to ``recoveries`` more of each, which start from
    failures.
    """

    concepts: Sequence[str]
    count: int
    recoveries: int = 0


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Fingerprint of data: the hash of their bytes and, as rounding differs between processors, mean and mean square."""

    hash: str
    mean: float
    square: float

    @classmethod
    def of(cls, tensors: Sequence[Tensor], known_hash: str) -> "Fingerprint":
        """Fingerprint of tensors with a known hash."""
        values = torch.cat([tensor.double().flatten() for tensor in tensors])
        return cls(hash=known_hash, mean=float(f"{values.mean():.8g}"), square=float(f"{values.square().mean():.8g}"))

    def is_near(self, other: "Fingerprint") -> bool:
        """Whether mean and mean square are equal up to rounding."""
        size = max(self.square**0.5, 1e-12)
        return abs(self.mean - other.mean) <= TOLERANCE * size and abs(self.square - other.square) <= TOLERANCE * size**2


@dataclass(frozen=True, kw_only=True)
class BenchmarkSuite:
    """Frozen suite.

    Attributes:
        domain: short name in :data:`FAMILIES`, name of a registered domain, or ``module:ATTRIBUTE``.
        needs: extra with the simulator; empty for none.
        recordings: whether data are read from the user's copy.
        validation, test: concepts on which a method may be tuned, and test tasks, never tuned on.
        test_suite: name of the test suite in the domain.
        demonstrations, samples: demonstrations per new concept, and samples or episodes per concept.
        closed_loop: whether plans are executed.
        references: whether reference policies are measured, too; some are slow.
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
    data: Mapping[str, Mapping[str, Fingerprint]] = field(default_factory=dict)

    def is_rate(self, measure: str) -> bool:
        """Whether a measure is a fraction of the samples."""
        return self.measures[measure] != "distance"

    @property
    def headline(self) -> str:
        """Measure that is the suite's score."""
        return next(iter(self.measures))

    @property
    def hash(self) -> str:
        """16-digit hash of the suite's file."""
        return file_hash(FOLDER / f"{self.name}.json")

    @property
    def domain_reference(self) -> str:
        """Name of the domain for :func:`~ftl_lightning.domains.registry.load_domain`."""
        return FAMILIES.get(self.domain, self.domain)

    def loaded(self) -> Domain:
        """The domain. Raise UserError if it lacks the suite's concepts, as in another version, or its simulator is missing."""
        domain = load_domain(self.domain_reference)
        with about(f"suite {self.name}"):
            tasks = {(task.setting, task.name) for task in domain.concepts.suites[self.test_suite].tasks}
            unchanged = tuple(self.training.concepts) == domain.concepts.training
            if not unchanged or not {(task.setting, task.concept) for task in self.test} <= tasks:
                raise UserError(f"expected the concepts of the frozen suite, found others in domain {domain.name}; it was changed")
            if self.closed_loop and domain.closed_loop is not None:
                domain.closed_loop.expect()
        return domain

    def fingerprints(self, seed: int, root: Path | None, parts: Sequence[str]) -> dict[str, Fingerprint]:
        """Fingerprints of the data of a seed by part, without initial states in domains that have none."""
        source = self.loaded().source(root)
        fingerprints = {}
        for part in parts:
            if part == STARTS:
                starts = [source.starts(task.concept, self.samples, EVALUATION_SEED + seed) for task in self.test]
                tensors = [tensor for states in starts if states is not None for tensor in states.observed.values()]
                if tensors:
                    known_hash = bytes_hash(b"".join(tensor.contiguous().numpy().tobytes() for tensor in tensors))
                    fingerprints[part] = Fingerprint.of(tensors, known_hash)
            else:
                drawn = self.drawn(part, seed, root)
                fingerprints[part] = Fingerprint.of([drawn.states], drawn.hash)
        return fingerprints

    def drawn(self, part: str, seed: int, root: Path | None) -> Demonstrations:
        """Demonstrations of a part: of the test's concepts (``demonstrations``), or of :attr:`validation` or :attr:`training`."""
        domain = self.loaded()
        source = domain.source(root)
        if part == TRAINING:
            demonstrations = source.split("train", self.training.count, seed)
            if self.training.recoveries and isinstance(source, Recoveries):
                demonstrations = concatenate([demonstrations, source.recoveries("train", self.training.recoveries, seed)])
            return demonstrations
        concepts = self.validation if part == VALIDATION else domain.concepts.suites[self.test_suite].learned
        return concatenate([source.draw(concept, self.demonstrations, DEMONSTRATION_SEED + seed) for concept in concepts])

    def check_data(self, seed: int, root: Path | None, parts: Sequence[str]) -> bool:
        """Whether data are bit-identical to the frozen suite, or differ by rounding; parts without a fingerprint are skipped. Raise
        UserError for other data, with suite, seed, part and both hashes.
        """
        known = self.data.get(str(seed), {})
        drawn = self.fingerprints(seed, root, [part for part in parts if part in known])
        for part, value in drawn.items():
            require(
                value.hash == known[part].hash or value.is_near(known[part]),
                f"suite {self.name}, seed {seed}, {part}",
                f"data with the hash {known[part].hash}",
                f"{value.hash}: the generator was changed; take the version of ftl-lightning that the suite was frozen in",
            )
        return all(value.hash == known[part].hash for part, value in drawn.items())


def suite_names() -> tuple[str, ...]:
    """Sorted names of the suites."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def load_suite(name: str) -> BenchmarkSuite:
    """Load a suite. Raise UserError for an unknown name or a damaged file."""
    names = suite_names()
    require(name in names, "suites", f"some of {', '.join(names)}", short(name))
    path = FOLDER / f"{name}.json"
    with about(path):
        return from_mapping(BenchmarkSuite, read_json(path, "a suite"), "")


def write_data(suite: BenchmarkSuite, seeds: Sequence[int], folder: Path, form: str, root: Path | None) -> list[Path]:
    """Write training pairs, and demonstrations for tuning and test, with ``README.md`` and ``hashes.json``, to a subfolder of
    ``folder``. Minari's data sets go to Minari's folder, under ``benchmark/SUITE-PART-seedN-v0``. Returns the files.
    """
    require(form in FORMATS, "format", f"one of {', '.join(FORMATS)}", form)
    place, known = folder / suite.name, {}
    for seed in seeds:
        suite.check_data(seed, root, EXPORTED)
        for part in EXPORTED:
            drawn, name = suite.drawn(part, seed, root), f"{part}-seed{seed}"
            path = place / f"{name}.{form}"
            other = {"lerobot": f"lerobot:{place / name}", "minari": f"minari:benchmark/{suite.name}-{name}-v0"}
            drawn.save(other.get(form, str(path)))
            known[name] = {"content": drawn.hash, "demonstrations": str(len(drawn))}
            known[name] |= {"file": file_hash(path)} if path.is_file() else {}
    write_text(place / "hashes.json", json.dumps(known, indent=1) + "\n")
    write_text(place / "README.md", _card(suite, suite.drawn(DEMONSTRATIONS, seeds[0], root), seeds, form))
    return sorted(path for path in place.rglob("*") if path.is_file())


def _card(suite: BenchmarkSuite, example: Demonstrations, seeds: Sequence[int], form: str) -> str:
    """Description of exported data in Markdown."""
    columns = ", ".join(f"{name} ({unit})" for name, unit in zip(example.state_names[:8], example.state_units[:8], strict=True))
    more = f" and {len(example.state_names) - 8} more" if len(example.state_names) > 8 else ""
    new = tuple(dict.fromkeys(example.concepts))
    observed = ", ".join(example.observed) or "nothing: behaviour starts nowhere"
    licence = "that of your own copy of the recordings; do not pass them on." if suite.recordings else "MIT, as the software's."
    return f"""# {suite.title}

Data of the suite `{suite.name}` (hash {suite.hash}) of the benchmark *few-shot concepts*, generated by
ftl-lightning {__version__} from the seeds {", ".join(map(str, seeds))}.
Format: {form}. `hashes.json` has the hash of each part.

- `training-seedN`: {suite.training.count} demonstrations of each of {len(suite.training.concepts)} concepts, to pretrain on
- `validation-seedN`: {suite.demonstrations} of each of {len(suite.validation)} other concepts, to tune on
- `demonstrations-seedN`: {suite.demonstrations} of each of {len(new)} new concepts, from which they are learned; not to tune on

- States: {columns}{more}; up to {example.states.shape[1]} steps.
- Observed: {observed}.
- Training concepts: {", ".join(suite.training.concepts)}.
- Concepts to tune on: {", ".join(suite.validation)}.
- New concepts: {", ".join(new)}.
- Measures: {", ".join(suite.measures)}; {suite.samples} samples of each concept.

Licence: {licence}
"""
