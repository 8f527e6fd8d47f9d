"""DataModules for pretraining and inversion, shared by all domains.

Both deliver demonstrations in the domain's units; the model normalises them. Each batch depends only on the seed and the step
number, so an interrupted and resumed run matches an uninterrupted run.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from ftl_lightning.data.actions import PRESENT
from ftl_lightning.data.check import check_each
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.data.features import check_features
from ftl_lightning.data.shards import TOGETHER, Stream
from ftl_lightning.domains.domain import OWN, Domain, Recoveries
from ftl_lightning.domains.from_file import RECOGNISED, FileSource, domain_from_file, read_demonstrations, read_own
from ftl_lightning.domains.registry import load_domain, recorded_name
from ftl_lightning.networks.text_encoder import Encoder, load_encoder
from ftl_lightning.services.errors import UserError, about, note, require, short
from ftl_lightning.services.modes import single_precision
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, drawn, generator, rows_of
from ftl_lightning.services.text import alike
from ftl_lightning.services.validation import LARGEST_STEP, MOST_TOGETHER, check_count, check_factor, check_range
from ftl_lightning.training.quality import calibration_of


class Batch(NamedTuple):
    """Batch of a pretraining step.

    Attributes:
        states: ``(batch, horizon, state)`` in the domain's units.
        concepts: ``(batch,)`` int64, rows of the domain's training concepts.
        observed: features ``(batch, *shape)`` by name.
    """

    states: Tensor
    concepts: Tensor
    observed: dict[str, Tensor]


class Steps(IterableDataset[int]):
    """Step numbers of the current epoch, from the trainer's global step."""

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
    """How pretraining samples windows of demonstrations.

    Attributes:
        horizon: states in a window; ``None`` for the domain's horizon.
        start_exponent: exponent u of window starts, ``start = length * share^u``: 1 is uniform; with 3, half of the windows start
            in the first eighth of a demonstration. ``None`` for the domain's exponent if windows are as long as plans, else 1.
        balance: concepts are drawn in proportion to their number of states to this power: 1 is uniform over states, 0 over
            concepts. Within a concept, demonstrations are drawn by length. ``None`` for uniform over demonstrations.
    """

    horizon: int | None = None
    start_exponent: float | None = None
    balance: float | None = None


class PretrainingData(pl.LightningDataModule):
    """Batches of (behaviour, concept) pairs of a domain.

    Args:
        domain: name of the domain, or ``package.module:DOMAIN``, see :func:`ftl_lightning.domains.registry.load_domain`.
        root: folder of the user's copy of the data, for domains whose demonstrations do not ship.
        samples_per_concept: demonstrations of each training concept.
        validation_per_concept: validation demonstrations of each training concept.
        recoveries: additional demonstrations of each training concept that start after a failure, see
            :class:`~ftl_lightning.domains.domain.Recoveries`.
        more: file of further demonstrations of training concepts, such as corrections of a model; ``None`` for none.
        seed: seed of the demonstrations and of their order.
        batch_size: windows per step and process.
        steps_per_epoch: batches per epoch, drawn with replacement; an epoch is only a unit of reporting.
        encoder: text encoder, ``'table'`` (shipped embeddings), ``'minilm'``, ``'hashing'``, or the name or path of a language
            model, see :func:`ftl_lightning.networks.text_encoder.load_encoder`.
        revision: revision of a Hugging Face model.
        **windows: attributes of :class:`Windows`, as further keys of the configuration.

    Raises:
        UserError: for an invalid value.
    """

    def __init__(
        self,
        domain: str,
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
        windows = asdict(chosen)  # hyper-parameters are the local variables: include defaults
        self.save_hyperparameters()
        self.domain_name, self.domain = self._domain(domain)
        self._number = {text: number for number, text in enumerate(self.domain.concepts.training)}
        self.metrics: Mapping[str, float] = {}
        plans = self.domain.plans
        self.horizon = plans.horizon if chosen.horizon is None else chosen.horizon
        self.start_exponent = plans.exponent(self.horizon) if chosen.start_exponent is None else chosen.start_exponent
        check_factor("data.start_exponent", self.start_exponent, 1)
        check_count("data.batch_size", batch_size, 1, MOST_TOGETHER)
        check_count("data.steps_per_epoch", steps_per_epoch, 1, LARGEST_STEP)
        check_count("data.horizon", self.horizon, 1)
        check_count("data.samples_per_concept", samples_per_concept, 1)
        check_count("data.validation_per_concept", validation_per_concept, 1, MOST_TOGETHER)
        check_count("data.recoveries", recoveries, 0)
        check_range("data.seed", seed, 0)
        if chosen.balance is not None:
            check_range("data.balance", chosen.balance, 0, 1)
        self.recoveries, self.more, self.balance = recoveries, more, chosen.balance
        self.root = None if root is None else Path(root)
        self.samples_per_concept = samples_per_concept
        self.validation_per_concept = validation_per_concept
        self.seed = seed
        self.batch_size = batch_size
        self.steps_per_epoch = steps_per_epoch
        self.encoder: Encoder = load_encoder(encoder, self.domain.concepts.table, revision)

    def _domain(self, name: str) -> tuple[str, Domain]:
        """Recorded name and domain."""
        return recorded_name(name), load_domain(name)

    @single_precision()
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
        shortest = int(self.training.lengths.min())
        long_enough = self.domain.plans.at_rest or shortest >= self.horizon
        require(long_enough, "data.horizon", f"at most {shortest}, as behaviour does not rest at the end", self.horizon)
        self.validation = source.split("validation", self.validation_per_concept, self.seed).fitted(self.domain.observed)
        if self.balance is not None:
            self._shares = shares(self.training, self.balance)
        # Evaluation draws initial states: check them before training.
        starts = source.starts(self.domain.concepts.training[0], 1, self.seed) if self.domain.observed else None
        if starts is not None:
            check_features(starts.observed, self.domain.observed)

    def _read_more(self, path: str) -> Demonstrations:
        demonstrations = read_demonstrations(path, self.domain)
        for text in demonstrations.concepts:
            require(text in self._number, path, "demonstrations of training concepts", repr(short(text)))
        return demonstrations

    @property
    def view(self) -> str:
        """View that the data need; empty for none."""
        return ""

    @property
    def examples(self) -> Demonstrations | None:
        """Demonstrations saved with a model of user data, else ``None``."""
        return None

    @single_precision()
    def batch(self, step: int) -> Batch:
        """Batch of a step (this process's share): demonstrations drawn with replacement, a window of each."""
        draw, count = generator("cpu", self.seed, step), self.batch_size
        with rows_of(*((0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size))):
            if self.balance is None:
                rows = drawn(count, lambda n: torch.randint(len(self.training), (n,), generator=draw))
            else:
                rows = drawn(count, lambda n: torch.multinomial(self._shares, n, replacement=True, generator=draw))
            return self._windows(self.training, rows, _even(rows, draw))

    def _windows(self, demonstrations: Demonstrations, rows: Tensor, share: Tensor) -> Batch:
        """Windows of demonstrations ``rows (window,)``, whose starts are spread by ``share (window,)`` from 0 to 1."""
        starts = demonstrations.starts(rows, share, self.start_exponent, self.horizon, self.domain.plans.at_rest)
        states, observed = demonstrations.windows(rows, starts, self.horizon)
        return Batch(states, self._concepts(demonstrations, rows), observed)

    def _concepts(self, demonstrations: Demonstrations, rows: Tensor) -> Tensor:
        """Index of the training concept of each row ``(window,)``."""
        return torch.tensor([self._number[demonstrations.concepts[row]] for row in rows.tolist()])

    def some_windows(self, count: int) -> Batch:
        """At least ``count`` pretraining windows, equally many per demonstration."""
        rows = torch.arange(len(self.training)).repeat(-(-count // len(self.training)))
        return self._windows(self.training, rows, _even(rows, generator("cpu", self.seed)))

    def every_window(self) -> Batch:
        """A window from every possible start of every demonstration."""
        lengths = self.training.lengths
        if not self.domain.plans.at_rest:
            lengths = (lengths - self.horizon + 1).clamp(min=1)
        rows = torch.arange(len(lengths)).repeat_interleave(lengths)
        starts = torch.cat([torch.arange(length) for length in lengths.tolist()])
        states, observed = self.training.windows(rows, starts, self.horizon)
        return Batch(states, self._concepts(self.training, rows), observed)

    def first_windows(self) -> Batch:
        """The first window of the first demonstration of each training concept, in order."""
        concepts = self.domain.concepts.training
        rows = torch.tensor([self.training.concepts.index(text) for text in concepts])
        states, observed = self.training.windows(rows, torch.zeros_like(rows), self.horizon)
        return Batch(states, torch.arange(len(concepts)), observed)

    def train_dataloader(self) -> DataLoader[Batch]:
        steps = Steps(self, self.steps_per_epoch)
        return DataLoader(steps, batch_size=None, collate_fn=self.batch)  # type: ignore[arg-type]

    @single_precision()
    def val_dataloader(self) -> DataLoader[Batch]:
        rows = torch.arange(len(self.validation))
        batch = self._windows(self.validation, rows, _even(rows, generator("cpu", self.seed)))
        return DataLoader([batch], batch_size=None)  # type: ignore[arg-type]

    test_dataloader = val_dataloader


def _even(rows: Tensor, draw: torch.Generator) -> Tensor:
    """A random share from 0 to 1 for each row ``(window,)``."""
    return drawn(len(rows), lambda n: torch.rand(n, generator=draw))


MOST_HISTORY = 16
"""Maximum number of observed states."""


class OwnData(PretrainingData):
    """Batches of user demonstrations; the file, with a concept text per demonstration, defines the domain.

    Plans have the length of the longest demonstration unless ``horizon`` is given, or demonstrations are longer than
    :data:`~ftl_lightning.domains.from_file.LONGEST_PLAN`.

    Args:
        demonstrations: the file (``.npz`` or safetensors), see
            :meth:`ftl_lightning.data.demonstrations.Demonstrations.load`; a folder of such files, see
            :mod:`ftl_lightning.data.shards`; the folder of a LeRobot data set, or the name of an installed Minari data set.
        metrics: metrics of plans, number by name, see :mod:`ftl_lightning.domains.from_file`; empty for none.
        kinds: kinds of columns by name, such as ``{heading: angle}``, see :mod:`ftl_lightning.data.kinds`; other columns have the
            kind that the file declares or the data show.
        check: whether likely faults of the demonstrations are reported before training.
        history: number of states that plans of data with actions observe, where they are windows from the present state; more
            than 1 where a state alone does not say how it changes, such as positions without velocities.
        validation_share: share of each concept's demonstrations to hold out, at least a single demonstration.
        seed, batch_size, steps_per_epoch, encoder, revision: see :class:`PretrainingData`; the default encoder is ``'minilm'``
            where it is installed, else ``'hashing'``.
        horizon, start_exponent: see :class:`Windows`.

    Raises:
        UserError: for a value out of range, or an invalid file.
    """

    def __init__(
        self,
        demonstrations: str,
        metrics: dict[str, float] | None = None,
        kinds: dict[str, str] | None = None,
        check: bool = True,
        history: int = 1,
        validation_share: float = 0.1,
        seed: int = 0,
        batch_size: int = 128,
        steps_per_epoch: int = 500,
        encoder: str = "auto",
        revision: str = "main",
        horizon: int | None = None,
        start_exponent: float | None = None,
    ) -> None:
        require(0 < validation_share < 1, "data.validation_share", "a share between 0 and 1", validation_share)
        self._file, self._share, self._metrics, self._horizon = demonstrations, validation_share, dict(metrics or {}), horizon
        check_count("data.history", history, 1, MOST_HISTORY)
        self._kinds, self._check, self._history = dict(kinds or {}), check, history
        self._stream: Stream | None = None
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
        self.save_hyperparameters(ignore=["history"] if history == 1 else [])
        self.metrics = self._metrics
        source = self.domain.source(None)
        assert isinstance(source, FileSource)
        longest = int(source.demonstrations.lengths.max())
        if horizon is None and self.horizon < longest and PRESENT not in self.domain.observed:
            text = f"demonstrations have up to {longest} steps, so plans are windows of {self.horizon}"
            note(f"data.horizon: {text}; --data.horizon N makes them longer or shorter")
        if self.horizon > 2 * longest:
            note(f"data.horizon: demonstrations have at most {longest} steps, so most of a plan of {self.horizon} steps is at rest")
        for text in alike(self.domain.concepts.training):
            note(f"{demonstrations}: {text}")

    def _domain(self, name: str) -> tuple[str, Domain]:
        return OWN, domain_from_file(self._file, self._horizon, self._metrics, self._share, self._kinds, self._history)

    def setup(self, stage: str) -> None:
        super().setup(stage)
        source = self.domain.source(None)
        assert isinstance(source, FileSource)
        if source.shards is not None:
            held: dict[int, frozenset[int]] = {}
            for (number, row), out in zip(source.shards.origins, source.held_out.tolist(), strict=True):
                held[number] = held.get(number, frozenset()) | ({row} if out else frozenset())
            self._stream = Stream(source.shards, self._opened, held, self.seed)
            note(f"{self._file}: {source.shards.about}; windows come from {TOGETHER} files at a time")
        if stage == "fit" and RECOGNISED in self.metrics:
            text = calibration_of(self.domain, self.domain.concepts.training[0], RECOGNISED)
            note(f"{self._file}: {text if text.startswith(RECOGNISED) else f'{RECOGNISED} {text}'}")
        if self._check and stage == "fit":
            for text in check_each(self.training):
                note(f"{self._file}: {text}; --data.check false turns this off")

    def _opened(self, path: str) -> Demonstrations:
        with about(path):
            fitted = self.domain.fitted(read_own(path))
        for text in set(fitted.concepts) - set(self._number):
            raise UserError(f"{path}: expected the concepts that the file had at the start, found also {text!r}")
        return fitted

    @single_precision()
    def batch(self, step: int) -> Batch:
        """Batch of a step; of a folder of files, windows of demonstrations of a few files, equally likely."""
        if self._stream is None:
            return super().batch(step)
        draw, parts = generator("cpu", self.seed, step), self._stream.at(step)
        ends = torch.tensor([len(part) for part in parts]).cumsum(dim=0)
        with rows_of(*((0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size))):
            rows = drawn(self.batch_size, lambda n: torch.randint(int(ends[-1]), (n,), generator=draw))
            share = _even(rows, draw)
        part_of = torch.bucketize(rows, ends, right=True)
        batches = [
            self._windows(part, rows[part_of == number] - int(ends[number]) + len(part), share[part_of == number])
            for number, part in enumerate(parts)
            if (part_of == number).any()
        ]
        states, concepts = torch.cat([batch.states for batch in batches]), torch.cat([batch.concepts for batch in batches])
        return Batch(
            states, concepts, {name: torch.cat([batch.observed[name] for batch in batches]) for name in batches[0].observed}
        )

    @property
    def view(self) -> str:
        """The continuous view, if a column is not linear."""
        return next(iter(self.domain.plans.views), "")

    @property
    def examples(self) -> Demonstrations:
        """Held-out demonstrations."""
        return self.validation


class InversionData(pl.LightningDataModule):
    """A few demonstrations of each new concept; all concepts are learned in the same run.

    Args:
        domain: name of the domain, or ``package.module:DOMAIN``; ``'own'`` for user data.
        suite: suite of the domain whose concepts are learned, from demonstrations drawn with the seed.
        demonstrations: file used instead (safetensors or npz), folder of a LeRobot data set, or name of an installed Minari data
            set. Its concept texts name the concepts to learn; demonstrations without a text form a concept named after the file.
        demonstrations_per_concept: number drawn per concept; 5 in the paper.
        seed: seed of the drawn demonstrations.
        steps: gradient steps.
        root: folder of the user's copy of the data, for domains whose demonstrations do not ship.
        check: whether likely faults of demonstrations from a file are reported before learning.

    Raises:
        UserError: for an invalid value, or a file that does not fit the domain.
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
        check: bool = True,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        check_count("data.steps", steps, 1, LARGEST_STEP)
        check_count("data.demonstrations_per_concept", demonstrations_per_concept, 1, MOST_TOGETHER)
        check_range("data.seed", seed, 0)
        self.seed = seed
        self.steps = steps
        self.root = None if root is None else Path(root)
        self.of_user = demonstrations is not None
        self.check = check
        self.domain_name = domain if domain == OWN else recorded_name(domain)
        if demonstrations is None and domain == OWN:
            raise UserError("data.demonstrations: expected a file of the new concepts' demonstrations, found none")
        if domain == OWN:
            self.demonstrations = read_own(str(demonstrations))
        else:
            loaded = load_domain(domain)
            require(suite in loaded.concepts.suites, "data.suite", f"one of {', '.join(loaded.concepts.suites)}", repr(suite))
            if demonstrations is None:
                self.demonstrations = self._drawn(loaded, suite, demonstrations_per_concept)
            else:
                self.demonstrations = read_demonstrations(demonstrations, loaded)
        self.concepts = tuple(dict.fromkeys(self.demonstrations.concepts))

    def _drawn(self, domain: Domain, suite: str, count: int) -> Demonstrations:
        learned = domain.concepts.suites[suite].learned
        require(learned, "data.suite", "a suite that learns concepts", f"{suite!r}, which learns none")
        source = domain.source(self.root)
        return concatenate([source.draw(task, count, DEMONSTRATION_SEED + self.seed) for task in learned])

    def test_dataloader(self) -> DataLoader[int]:
        return DataLoader(range(1), batch_size=None)  # type: ignore[arg-type]

    train_dataloader = test_dataloader


def shares(demonstrations: Demonstrations, balance: float) -> Tensor:
    """Sampling probability of each demonstration ``(demo,)``, see ``balance`` of :class:`Windows`."""
    lengths = demonstrations.lengths.double()
    texts = {text: number for number, text in enumerate(dict.fromkeys(demonstrations.concepts))}
    concepts = torch.tensor([texts[text] for text in demonstrations.concepts])
    states = torch.zeros(len(texts), dtype=torch.double).index_add(0, concepts, lengths)
    weights = lengths * states[concepts] ** (balance - 1)
    return weights / weights.sum()
