"""DataModules: of pretraining, which a domain's own names, and of inversion, one for all domains.

Both deliver demonstrations in the domain's units; the model normalises them. What a step sees is a function of the seed and
the step's number alone, so a run that is killed and resumed goes on exactly as the unbroken one would.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from ftl_lightning.concepts.encoder import Encoder, load_encoder
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.demonstrations.features import expect_features
from ftl_lightning.domains.domain import Domain, Recoveries
from ftl_lightning.domains.from_file import OWN, domain_from_file, read_demonstrations, read_own
from ftl_lightning.domains.registry import load_domain, recorded_name
from ftl_lightning.errors import UserError, short
from ftl_lightning.processes import drawn, rows_of
from ftl_lightning.ranges import LARGEST, LARGEST_STEP, MOST_TOGETHER, expect_count, expect_factor, expect_range
from ftl_lightning.seeding import DEMONSTRATION_SEED, generator


class Batch(NamedTuple):
    """What a step of pretraining sees.

    Attributes:
        states: ``(batch, horizon, state)`` in the domain's units.
        concepts: ``(batch,)`` int64, rows of the domain's training concepts.
        observed: features ``(batch, *shape)`` by name.
    """

    states: Tensor
    concepts: Tensor
    observed: dict[str, Tensor]


class Steps(IterableDataset[int]):
    """The numbers of the steps of one epoch, from wherever the trainer stands."""

    def __init__(self, module: pl.LightningDataModule, length: int) -> None:
        self.module, self.length = module, length

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[int]:
        if self.module.trainer is None:
            raise UserError("data: expected a trainer, whose steps decide the batches, found none; give them to Trainer.fit")
        start = self.module.trainer.global_step
        return iter(range(start, start + self.length - start % self.length))


@dataclass(frozen=True)
class Windows:
    """Which windows of demonstrations a step of pretraining sees.

    Attributes:
        horizon: states in a window; ``None`` for the domain's plans.
        start_exponent: exponent u of the windows' starts, ``start = length * share^u``: 1 is uniform, with 3 half of the windows
            start in the first eighth of a demonstration. ``None`` for the domain's where windows are as long as plans, else 1.
        balance: exponent with which concepts are drawn by their number of states: 1 draws every state alike, 0 every concept, 0.5
            by the square root; of a concept, demonstrations are drawn by their length. ``None`` to draw demonstrations alike.
    """

    horizon: int | None = None
    start_exponent: float | None = None
    balance: float | None = None


class PretrainingData(pl.LightningDataModule):
    """Batches of (behaviour, concept) pairs of a domain. A subclass may name the domain.

    Args:
        domain: name of the domain, or ``package.module:DOMAIN``, see :func:`ftl_lightning.domains.registry.load_domain`; empty
            for the class's own.
        root: folder of the user's copy of the data, for domains whose demonstrations do not ship.
        samples_per_concept: demonstrations of each training concept.
        validation_per_concept: others of each, for the validation loss.
        recoveries: demonstrations more of each training concept that has some, which begin where behaviour went wrong, see
            :class:`~ftl_lightning.domains.domain.Recoveries`.
        more: file of further demonstrations of training concepts, such as corrections of a model; ``None`` for none.
        seed: decides the demonstrations and the order they are seen in.
        batch_size: windows a step, in each process.
        steps_per_epoch: an epoch is a unit of reporting: so many batches, drawn with replacement.
        encoder: text encoder, ``'table'`` (shipped embeddings), ``'minilm'``, ``'hashing'``, or the name or path of a language
            model, see :func:`ftl_lightning.concepts.encoder.load_encoder`.
        revision: of a Hugging Face model.
        **windows: which windows a step sees: the attributes of :class:`Windows`, which are keys of a configuration beside the
            others.

    Raises:
        UserError: for a value that is none.
    """

    own_domain: ClassVar[str] = ""
    """Name of the class's domain."""

    def __init__(
        self,
        domain: str = "",
        root: str | None = None,
        samples_per_concept: int = 100,
        validation_per_concept: int = 10,
        recoveries: int = 0,
        more: str | None = None,
        seed: int = 0,
        batch_size: int = 128,
        steps_per_epoch: int = 500,
        encoder: str = "table",
        revision: str = "main",
        **windows: Any,
    ) -> None:
        super().__init__()
        chosen = Windows(**windows)
        windows = asdict(chosen)  # hyper-parameters are the local variables: those that were not given count too
        # Configurations from before there were these keep their hash.
        unsaid = {"balance": chosen.balance is None, "recoveries": not recoveries, "more": more is None}
        self.save_hyperparameters(ignore=[name for name, absent in unsaid.items() if absent])
        if self.own_domain and domain not in ("", self.own_domain):
            raise UserError(f"data.domain: expected {self.own_domain!r} or none for {type(self).__name__}, found {domain!r}")
        self.domain_name, self.domain = self._domain(self.own_domain or domain)
        self._number = {text: number for number, text in enumerate(self.domain.concepts.training)}
        self.metrics: Mapping[str, float] = {}
        plans = self.domain.plans
        self.horizon = plans.horizon if chosen.horizon is None else chosen.horizon
        self.start_exponent = plans.exponent(self.horizon) if chosen.start_exponent is None else chosen.start_exponent
        if self.start_exponent < 1:
            raise UserError(f"data.start_exponent: expected 1 or more, found {chosen.start_exponent}")
        expect_factor("data.start_exponent", self.start_exponent, 1)
        counts = {
            "batch_size": (batch_size, MOST_TOGETHER),
            "steps_per_epoch": (steps_per_epoch, LARGEST_STEP),
            "horizon": (self.horizon, LARGEST),
            "samples_per_concept": (samples_per_concept, LARGEST),
            "validation_per_concept": (validation_per_concept, MOST_TOGETHER),
        }
        for name, (value, most) in counts.items():
            expect_count(f"data.{name}", value, 1, most)
        expect_range("data.seed", seed, 0)
        expect_count("data.recoveries", recoveries, 0, LARGEST)
        self.recoveries, self.more = recoveries, more
        self.balance = chosen.balance
        if self.balance is not None and not 0 <= self.balance <= 1:
            raise UserError(f"data.balance: expected a number from 0 to 1, found {self.balance}")
        self.root = None if root is None else Path(root)
        self.samples_per_concept = samples_per_concept
        self.validation_per_concept = validation_per_concept
        self.seed = seed
        self.batch_size = batch_size
        self.steps_per_epoch = steps_per_epoch
        self.encoder: Encoder = load_encoder(encoder, self.domain.concepts.table, revision)

    def _domain(self, name: str) -> tuple[str, Domain]:
        """The domain and the name by which a model knows it."""
        return recorded_name(name), load_domain(name)

    def setup(self, stage: str) -> None:
        source = self.domain.source(self.root)
        self.training = source.split("train", self.samples_per_concept, self.seed).fitted(self.domain.observed)
        if self.recoveries:
            if not isinstance(source, Recoveries):
                raise UserError(f"data.recoveries: expected 0, as domain {self.domain.name} has none, found {self.recoveries}")
            more = source.recoveries("train", self.recoveries, self.seed).fitted(self.domain.observed)
            self.training = concatenate([self.training, more])
        if self.more is not None:
            self.training = concatenate([self.training, self._read_more(self.more)])
        self.validation = source.split("validation", self.validation_per_concept, self.seed).fitted(self.domain.observed)
        if self.balance is not None:
            self._shares = shares(self.training, self.balance)
        # Evaluation draws initial states: a mistake in them is told before training, not after.
        starts = source.starts(self.domain.concepts.training[0], 1, self.seed) if self.domain.observed else None
        if starts is not None:
            expect_features(starts.observed, self.domain.observed)

    def _read_more(self, path: str) -> Demonstrations:
        found = read_demonstrations(path, self.domain)
        for text in found.concepts:
            if text not in self._number:
                raise UserError(f"{path}: expected demonstrations of training concepts, found {short(text)!r}")
        return found

    @property
    def examples(self) -> Demonstrations | None:
        """Demonstrations that are kept beside a model, if it is of a user's own data."""
        return None

    def batch(self, step: int) -> Batch:
        """The batch of a step, or its part of this process: demonstrations drawn with replacement, and of each a window."""
        draw, count = generator("cpu", self.seed, step), self.batch_size
        with rows_of(*((0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size))):
            if self.balance is None:
                rows = drawn(count, lambda n: torch.randint(len(self.training), (n,), generator=draw))
            else:
                rows = drawn(count, lambda n: torch.multinomial(self._shares, n, replacement=True, generator=draw))
            return self._windows(self.training, rows, draw)

    def _windows(self, demonstrations: Demonstrations, rows: Tensor, draw: torch.Generator) -> Batch:
        share = drawn(len(rows), lambda n: torch.rand(n, generator=draw))
        starts = demonstrations.starts(rows, share, self.start_exponent, self.horizon, self.domain.plans.at_rest)
        states, observed = demonstrations.windows(rows, starts, self.horizon)
        return Batch(states, self._concepts(demonstrations, rows), observed)

    def _concepts(self, demonstrations: Demonstrations, rows: Tensor) -> Tensor:
        """Which training concept each of some demonstrations shows ``(window,)``."""
        return torch.tensor([self._number[demonstrations.concepts[row]] for row in rows.tolist()])

    def some_windows(self, count: int) -> Batch:
        """Windows as steps of pretraining see them, as many of each demonstration, at least ``count`` together."""
        rows = torch.arange(len(self.training)).repeat(-(-count // len(self.training)))
        return self._windows(self.training, rows, generator("cpu", self.seed))

    def every_window(self) -> Batch:
        """One window from each time of each demonstration."""
        lengths = self.training.lengths
        if not self.domain.plans.at_rest:
            lengths = (lengths - self.horizon + 1).clamp(min=1)
        rows = torch.arange(len(lengths)).repeat_interleave(lengths)
        starts = torch.cat([torch.arange(length) for length in lengths.tolist()])
        states, observed = self.training.windows(rows, starts, self.horizon)
        return Batch(states, self._concepts(self.training, rows), observed)

    def first_windows(self) -> Batch:
        """One window from the start of the first demonstration of each training concept, in their order."""
        concepts = self.domain.concepts.training
        rows = torch.tensor([self.training.concepts.index(text) for text in concepts])
        states, observed = self.training.windows(rows, torch.zeros_like(rows), self.horizon)
        return Batch(states, torch.arange(len(concepts)), observed)

    def train_dataloader(self) -> DataLoader[Batch]:
        steps = Steps(self, self.steps_per_epoch)
        return DataLoader(steps, batch_size=None, collate_fn=self.batch)  # type: ignore[arg-type]

    def val_dataloader(self) -> DataLoader[Batch]:
        whole = torch.arange(len(self.validation))
        batch = self._windows(self.validation, whole, generator("cpu", self.seed))
        return DataLoader([batch], batch_size=None)  # type: ignore[arg-type]

    test_dataloader = val_dataloader


class OwnData(PretrainingData):
    """Batches of a user's own demonstrations, a file with one concept text for each: the file is the domain.

    A plan is as long as the longest demonstration, unless ``horizon`` says otherwise.

    Args:
        demonstrations: the file (``.npz`` or safetensors), see
            :meth:`ftl_lightning.demonstrations.container.Demonstrations.load`; or the folder of a LeRobot data set, or the name of
            an installed Minari data set.
        metrics: what plans are judged by, a name and a number each, see :mod:`ftl_lightning.domains.from_file`; empty for nothing.
        validation_share: share of each concept's demonstrations that is held out, at least one.
        seed, batch_size, steps_per_epoch, encoder, revision: see :class:`PretrainingData`; the default encoder is ``'minilm'``
            where it is installed, else ``'hashing'``.
        horizon, start_exponent: see :class:`Windows`.

    Raises:
        UserError: for a value out of its range, or a file that holds no such demonstrations.
    """

    def __init__(
        self,
        demonstrations: str,
        metrics: dict[str, float] | None = None,
        validation_share: float = 0.1,
        seed: int = 0,
        batch_size: int = 128,
        steps_per_epoch: int = 500,
        encoder: str = "auto",
        revision: str = "main",
        horizon: int | None = None,
        start_exponent: float | None = None,
    ) -> None:
        if not 0 < validation_share < 1:
            raise UserError(f"data.validation_share: expected a share between 0 and 1, found {validation_share}")
        self._file, self._share, self._metrics, self._asked = demonstrations, validation_share, dict(metrics or {}), horizon
        super().__init__(
            domain=OWN,
            seed=seed,
            batch_size=batch_size,
            steps_per_epoch=steps_per_epoch,
            encoder=encoder,
            revision=revision,
            horizon=horizon,
            start_exponent=start_exponent,
        )
        self.save_hyperparameters()
        self.metrics = self._metrics

    def _domain(self, name: str) -> tuple[str, Domain]:
        return OWN, domain_from_file(self._file, self._asked, self._metrics, self._share)

    @property
    def examples(self) -> Demonstrations:
        """The demonstrations that are held out."""
        return self.validation


class InversionData(pl.LightningDataModule):
    """A few demonstrations of each new concept, learned together.

    Args:
        domain: name of the domain, or ``package.module:DOMAIN``; ``'own'`` for a user's own data.
        suite: the concepts of this suite of the domain are learned, from demonstrations drawn from the seed.
        demonstrations: a file of your own instead (safetensors or npz), the folder of a LeRobot data set, or the name of an
            installed Minari data set. Its concept texts name the concepts to learn; demonstrations without a text belong to one
            concept named after the file.
        demonstrations_per_concept: how many are drawn; the paper's number is 5.
        seed: decides the demonstrations that are drawn.
        steps: gradient steps, which is the length of the one epoch.
        root: folder of the user's copy of the data, for domains whose demonstrations do not ship.

    Raises:
        UserError: for a value that is none, or a file that does not fit the domain.
    """

    def __init__(
        self,
        domain: str,
        suite: str = "paper",
        demonstrations: str | None = None,
        demonstrations_per_concept: int = 5,
        seed: int = 0,
        steps: int = 400,
        root: str | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        if steps < 1 or demonstrations_per_concept < 1:
            found = f"{steps} and {demonstrations_per_concept}"
            raise UserError(f"data.steps, data.demonstrations_per_concept: expected 1 or more, found {found}")
        expect_count("data.steps", steps, 1, LARGEST_STEP)
        expect_count("data.demonstrations_per_concept", demonstrations_per_concept, 1, MOST_TOGETHER)
        expect_range("data.seed", seed, 0)
        self.seed = seed
        self.steps = steps
        self.root = None if root is None else Path(root)
        self.own = demonstrations is not None
        self.domain_name = domain if domain == OWN else recorded_name(domain)
        if demonstrations is None and domain == OWN:
            raise UserError("data.demonstrations: expected a file of the new concepts' demonstrations, found none")
        if domain != OWN and suite not in (suites := load_domain(domain).concepts.suites):
            raise UserError(f"data.suite: expected one of {', '.join(suites)}, found {suite!r}")
        if domain == OWN:
            self.demonstrations = read_own(str(demonstrations))
        elif demonstrations is None:
            self.demonstrations = self._drawn(load_domain(domain), suite, demonstrations_per_concept)
        else:
            self.demonstrations = read_demonstrations(demonstrations, load_domain(domain))
        self.concepts = tuple(dict.fromkeys(self.demonstrations.concepts))

    def _drawn(self, domain: Domain, suite: str, count: int) -> Demonstrations:
        if not (learned := domain.concepts.suites[suite].learned):
            raise UserError(f"data.suite: expected a suite that learns concepts, found {suite!r}, which learns none")
        source = domain.source(self.root)
        return concatenate([source.draw(task, count, DEMONSTRATION_SEED + self.seed) for task in learned])

    def train_dataloader(self) -> DataLoader[int]:
        return DataLoader(Steps(self, self.steps), batch_size=None)

    def test_dataloader(self) -> DataLoader[int]:
        return DataLoader(range(1), batch_size=None)  # type: ignore[arg-type]

    val_dataloader = test_dataloader


def shares(demonstrations: Demonstrations, balance: float) -> Tensor:
    """How often each demonstration is drawn ``(demo,)``, see ``balance`` of :class:`Windows`; they sum to 1."""
    lengths = demonstrations.lengths.double()
    texts = {text: number for number, text in enumerate(dict.fromkeys(demonstrations.concepts))}
    concepts = torch.tensor([texts[text] for text in demonstrations.concepts])
    states = torch.zeros(len(texts), dtype=torch.double).index_add(0, concepts, lengths)
    weights = lengths * states[concepts] ** (balance - 1)
    return weights / weights.sum()
