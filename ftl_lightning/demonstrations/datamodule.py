"""DataModules: of pretraining (one subclass a domain) and of inversion (one for all domains).

Both deliver demonstrations in the domain's units; the model normalises them. What a step sees is a function of the seed and
the step's number alone, so a run that is killed and resumed goes on exactly as the unbroken one would have.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import lightning.pytorch as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from ftl_lightning.concepts.encoder import Encoder, load_encoder
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.domains.domain import Domain, load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.seeding import DEMONSTRATION_SEED, VALIDATION_SEED, generator


class Batch(NamedTuple):
    """What a step of pretraining sees.

    Attributes:
        states: ``(batch, horizon, state)`` in the domain's units.
        concepts: ``(batch,)`` int64, rows of the domain's training concepts.
        initial_states: ``(batch, initial state)`` or ``None``.
    """

    states: Tensor
    concepts: Tensor
    initial_states: Tensor | None


class Steps(IterableDataset[int]):
    """The numbers of the steps of one epoch, from wherever the trainer stands."""

    def __init__(self, module: pl.LightningDataModule, length: int) -> None:
        self.module, self.length = module, length

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[int]:
        assert self.module.trainer is not None
        start = self.module.trainer.global_step
        return iter(range(start, start + self.length - start % self.length))


class PretrainingData(pl.LightningDataModule):
    """Batches of (behaviour, concept) pairs. A domain's subclass says how many.

    Args:
        domain: the domain.
        samples_per_concept: demonstrations of each training concept.
        validation_per_concept: others of each, for the validation loss, from a seed that no training run uses.
        seed: decides the demonstrations and the order they are seen in.
        batch_size: demonstrations a step.
        steps_per_epoch: an epoch is a unit of reporting: so many batches, drawn with replacement.
        encoder, revision: text encoder, see :func:`ftl_lightning.concepts.encoder.load_encoder`.
        horizon: states in a plan; ``None`` for the domain's.
        early: how much more often windows start early in a demonstration; ``None`` for the domain's rule
            (:meth:`~ftl_lightning.domains.domain.Domain.start_power`).
    """

    def __init__(
        self,
        domain: Domain,
        samples_per_concept: int,
        validation_per_concept: int,
        seed: int,
        batch_size: int,
        steps_per_epoch: int,
        encoder: str,
        revision: str,
        horizon: int | None = None,
        early: float | None = None,
    ) -> None:
        super().__init__()
        self.horizon = domain.horizon if horizon is None else horizon
        self.early = domain.start_power(self.horizon) if early is None else early
        if self.early < 1:
            raise UserError(f"data.early: expected 1 or more, found {early}")
        for name, value in (("batch_size", batch_size), ("steps_per_epoch", steps_per_epoch), ("horizon", self.horizon)):
            if value < 1:
                raise UserError(f"data.{name}: expected 1 or more, found {value}")
        self.domain = domain
        self.samples_per_concept = samples_per_concept
        self.validation_per_concept = validation_per_concept
        self.seed = seed
        self.batch_size = batch_size
        self.steps_per_epoch = steps_per_epoch
        self.encoder: Encoder = load_encoder(encoder, domain.table, revision)

    def setup(self, stage: str) -> None:
        self.training = self.domain.training_set(self.samples_per_concept, self.seed)
        self.validation = self.domain.training_set(self.validation_per_concept, VALIDATION_SEED + self.seed)

    def batch(self, step: int) -> Batch:
        """The batch of a step: demonstrations drawn with replacement, and of each a window."""
        draw = generator("cpu", self.seed, step)
        rows = torch.randint(len(self.training), (self.batch_size,), generator=draw)
        return self._windows(self.training, rows, draw)

    def _windows(self, demonstrations: Demonstrations, rows: Tensor, draw: torch.Generator) -> Batch:
        concepts = torch.tensor([self.domain.training_concepts.index(demonstrations.concepts[row]) for row in rows.tolist()])
        starts = demonstrations.starts(rows, torch.rand(len(rows), generator=draw), self.early)
        states, initial = demonstrations.windows(rows, starts, self.horizon)
        return Batch(states, concepts, initial)

    def every_window(self) -> Batch:
        """One window from each time of each demonstration."""
        lengths = self.training.lengths
        rows = torch.arange(len(lengths)).repeat_interleave(lengths)
        starts = torch.cat([torch.arange(length) for length in lengths.tolist()])
        concepts = torch.tensor([self.domain.training_concepts.index(text) for text in self.training.concepts])[rows]
        states, initial = self.training.windows(rows, starts, self.horizon)
        return Batch(states, concepts, initial)

    def first_windows(self) -> Batch:
        """One window from the start of the first demonstration of each training concept, in their order."""
        concepts = self.domain.training_concepts
        rows = torch.tensor([self.training.concepts.index(text) for text in concepts])
        states, initial = self.training.windows(rows, torch.zeros_like(rows), self.horizon)
        return Batch(states, torch.arange(len(concepts)), initial)

    def train_dataloader(self) -> DataLoader[Batch]:
        steps = Steps(self, self.steps_per_epoch)
        return DataLoader(steps, batch_size=None, collate_fn=self.batch)  # type: ignore[arg-type]

    def val_dataloader(self) -> DataLoader[Batch]:
        whole = torch.arange(len(self.validation))
        batch = self._windows(self.validation, whole, generator("cpu", self.seed))
        return DataLoader([batch], batch_size=None)  # type: ignore[arg-type]

    test_dataloader = val_dataloader


class InversionData(pl.LightningDataModule):
    """A few demonstrations of each new concept, learned together.

    Args:
        domain: name of the domain.
        suite: the concepts of this suite of the domain are learned, from demonstrations drawn from the seed.
        demonstrations: a file of your own instead (safetensors or npz). Its concept texts name the concepts to learn;
            demonstrations without a text belong to one concept named after the file.
        demonstrations_per_concept: how many are drawn; the paper's number is 5.
        seed: decides the demonstrations that are drawn.
        steps: gradient steps, which is the length of the one epoch.
    """

    def __init__(
        self,
        domain: str,
        suite: str = "paper",
        demonstrations: str | None = None,
        demonstrations_per_concept: int = 5,
        seed: int = 0,
        steps: int = 400,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.domain = load_domain(domain)
        if steps < 1 or demonstrations_per_concept < 1:
            found = f"{steps} and {demonstrations_per_concept}"
            raise UserError(f"data.steps, data.demonstrations_per_concept: expected 1 or more, found {found}")
        if suite not in self.domain.suites:
            raise UserError(f"data.suite: expected one of {', '.join(self.domain.suites)}, found {suite!r}")
        self.seed = seed
        self.steps = steps
        self.demonstrations = (
            self._drawn(suite, demonstrations_per_concept) if demonstrations is None else self._read(Path(demonstrations))
        )
        self.concepts = tuple(dict.fromkeys(self.demonstrations.concepts))

    def _drawn(self, suite: str, count: int) -> Demonstrations:
        learned = self.domain.suites[suite].learned
        if not learned:
            raise UserError(f"data.suite: expected a suite that learns concepts, found {suite!r}, which learns none")
        return concatenate([self.domain.generate(task, count, DEMONSTRATION_SEED + self.seed) for task in learned])

    def _read(self, path: Path) -> Demonstrations:
        found = Demonstrations.load(path)
        columns = len(self.domain.state_names)
        if found.domain not in ("", self.domain.name):
            raise UserError(f"{path}: key 'domain': expected {self.domain.name!r}, found {found.domain!r}")
        if found.states.shape[2] != columns:
            raise UserError(f"{path}: key 'states': expected shape (demo, time, {columns}), found {tuple(found.states.shape)}")
        return found.named(path.stem)

    def train_dataloader(self) -> DataLoader[int]:
        return DataLoader(Steps(self, self.steps), batch_size=None)

    def test_dataloader(self) -> DataLoader[int]:
        return DataLoader(range(1), batch_size=None)  # type: ignore[arg-type]

    val_dataloader = test_dataloader
