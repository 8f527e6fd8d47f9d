"""Lightning's trainer with the additional verb ``invert``, on a single device or in several processes by DDP."""

import inspect
import math
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher  # no public name: tells processes from threads
from lightning.pytorch.utilities import rank_zero_only

from ftl_lightning.services import log_folder
from ftl_lightning.services.errors import UserError, mistake_behind, mistake_of_machine, note, require, short
from ftl_lightning.services.modes import single_precision, usual_modes
from ftl_lightning.services.text import line, silence
from ftl_lightning.services.validation import check_count, check_range
from ftl_lightning.training.adaptation import Adaptation
from ftl_lightning.training.board import LearningRate
from ftl_lightning.training.checkpoint import WholeCheckpoints

NUMBERS = {
    "accumulate_grad_batches",
    "benchmark",
    "deterministic",
    "fast_dev_run",
    "gradient_clip_algorithm",
    "gradient_clip_val",
    "limit_train_batches",
    "max_epochs",
    "max_steps",
    "max_time",
    "min_epochs",
    "min_steps",
    "overfit_batches",
    "plugins",
    "precision",
    "strategy",
    "sync_batchnorm",
    "use_distributed_sampler",
}
"""Options that can change the results of a run on a single device."""
USUAL = {"max_epochs": 1, "deterministic": True}
"""Defaults of the shipped configurations of ``invert`` that differ from Lightning's."""
LEAST = {
    -1: ("devices", "max_steps", "max_epochs", "num_sanity_val_steps"),
    0: ("min_steps", "min_epochs", "log_every_n_steps", "reload_dataloaders_every_n_epochs", "gradient_clip_val"),
    1: ("num_nodes", "check_val_every_n_epoch", "accumulate_grad_batches"),
}
"""Options by their minimum, which Lightning does not check: smaller values fail during a run, or are ignored."""
MOST_DEVICES, MOST_PROCESSES = 10_000, 256
"""Maximum number of devices or nodes, and of processes that learn concepts."""
SHARES = ("limit_train_batches", "limit_val_batches", "limit_test_batches", "overfit_batches", "val_check_interval")
"""Options that are a share or a number, which Lightning does not check."""
PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
"""Supported precisions: weights, data and learned concepts are float32."""
_STARTS = ("`val_check_interval`", "Early stopping conditioned")
"""Beginnings of Lightning's messages about options."""
_LOST = ("gloo", "NCCL", "Connection closed", "Connection reset", "Broken pipe", "TCPStore", "store->get")
"""Fragments of torch's messages to a process that waits for a process that ended."""


class LostProcess(UserError):
    """Another process of the run has ended early."""


@contextmanager
def one_voice() -> Iterator[None]:
    """Silence a process that another process started; its errors are a line, or none after :class:`LostProcess`."""
    if not getattr(rank_zero_only, "rank", 0):
        yield
        return
    silence()
    warnings.simplefilter("ignore")
    try:
        yield
    except LostProcess:
        raise SystemExit(2) from None
    except Exception as error:
        if (mistake := mistake_behind(error) or mistake_of_machine(error)) is None:
            raise
        sys.stderr.write(f"error: {line(str(mistake))}\n")
        raise SystemExit(2) from None


class _Begun(pl.Callback):
    """Record the start of learning, and check that metrics monitored by callbacks exist."""

    def on_train_batch_start(self, *_: Any) -> None:
        log_folder.keep()

    def on_validation_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if not trainer.sanity_checking:
            _expect_monitors(trainer)


def _expect_monitors(trainer: pl.Trainer) -> None:
    """Refuse a callback that monitors a metric which is not logged: it would have no effect."""
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        watched = getattr(callback, "monitor", None)
        if isinstance(watched, str) and watched not in trainer.callback_metrics:
            known, name = short(", ".join(sorted(trainer.callback_metrics)), 150), type(callback).__name__
            raise UserError(f"trainer.callbacks: {name}: monitor: expected one of {known}, found {short(watched)!r}")


class Trainer(pl.Trainer):
    """A trainer with the additional verb ``invert``.

    Attributes:
        verb: current verb, for the progress bar.
        unusual: options that can affect learning and differ from their defaults; they are part of a result's identity.
        processes: number of processes among which ``invert`` divides the concepts, see :mod:`ftl_lightning.training.in_processes`.
    """

    verb = "fit"

    def __init__(self, *arguments: Any, processes: int = 1, **options: Any) -> None:
        check_count("trainer.processes", processes, 1, MOST_PROCESSES)
        self.processes = processes
        _check_options(options)
        try:
            super().__init__(*arguments, **options)
        except UserError:
            raise
        except Exception as error:  # of many types, by accelerators, strategies and plugins
            raise UserError(f"trainer: {short(str(error), 200)}") from error
        if isinstance(self.accelerator, CPUAccelerator):
            check_range("trainer.devices", self.num_devices, 1, os.cpu_count() or 1)
        require(self.precision in PRECISIONS, "trainer.precision", f"one of {', '.join(PRECISIONS)}", repr(self.precision))
        parameters = inspect.signature(pl.Trainer.__init__).parameters
        usual = {name: parameter.default for name, parameter in parameters.items()} | USUAL
        self.unusual = {
            name: value if isinstance(value, int | float | str | None) else type(value).__name__
            for name, value in options.items()
            if name in NUMBERS and value != usual.get(name)
        }
        self.callbacks += [_Begun(), LearningRate()]  # type: ignore[attr-defined]
        if type(self.strategy.checkpoint_io) is TorchCheckpointIO:  # unless it is configured
            self.strategy.checkpoint_io = WholeCheckpoints()

    def check_alone(self, verb: str) -> None:
        """Refuse several processes for a single-process verb; ``UserError`` naming the verb."""
        instead = "use trainer.processes" if verb == "invert" else "`fit` alone runs on several"
        processes = self.num_devices * self.num_nodes
        require(processes == 1, "trainer.devices", f"1 for {verb}", f"{processes}; {instead}")

    @usual_modes()
    def fit(self, model: pl.LightningModule, *arguments: Any, **options: Any) -> None:
        """Lightning's ``fit``, for models that learn."""
        if isinstance(model, Adaptation) and not model.learns:
            raise UserError(f"verb: expected invert (model.class_path: {type(model).__name__} learns nothing), found fit")
        for key, length in (("max_steps", self.max_steps), ("max_epochs", self.max_epochs)):
            require(length != 0, f"trainer.{key}", "1 or more, or -1 for no limit", "0, with which nothing is learned")
        require(self.limit_train_batches != 0, "trainer.limit_train_batches", "more than 0", "0, with which nothing is learned")
        self._check_exact()
        if self.global_rank:
            silence()
        with self._restoring():
            try:
                super().fit(model, *arguments, **options)
            except (ValueError, RuntimeError) as error:
                if str(error).strip().startswith(_STARTS):
                    raise UserError(f"trainer: {short(str(error), 250)}") from error
                if self.world_size > 1 and any(words in str(error) for words in _LOST):
                    expected = f"expected {self.world_size} processes to the end, the connection to one was lost"
                    raise LostProcess(f"trainer.devices: {expected}; go on with --ckpt_path last") from error
                raise
        _expect_monitors(self)
        if self.ckpt_path and self.global_step == getattr(model, "resumed_from", None):
            ended = f"the run had ended at step {self.global_step}, so nothing was learned; raise trainer.max_steps to go on"
            note(f"ckpt_path: {ended}")

    @single_precision()
    def validate(self, *arguments: Any, **options: Any) -> Any:
        """Lightning's ``validate``, in a single process."""
        self.check_alone("validate")
        with self._restoring():
            return super().validate(*arguments, **options)

    @single_precision()
    def test(self, *arguments: Any, **options: Any) -> Any:
        """Lightning's ``test``, in a single process."""
        self.check_alone(self.verb if self.verb == "invert" else "test")
        with self._restoring():
            return super().test(*arguments, **options)

    def _check_exact(self) -> None:
        """Refuse several processes unless each is started separately and holds all weights."""
        separate = isinstance(self.strategy.launcher, _SubprocessScriptLauncher | None)
        exact = self.world_size == 1 or (separate and isinstance(self.strategy, DDPStrategy))
        name = f"{type(self.strategy).__name__} with {type(self.strategy.launcher).__name__}"
        require(exact, "trainer.strategy", "ddp for several processes", name)

    @contextmanager
    def _restoring(self) -> Iterator[None]:
        """Convert errors of Lightning and torch while restoring a checkpoint to a ``UserError``."""
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            # No public attribute shows that a checkpoint is being restored; this one is emptied at the end of restoring.
            if not self._checkpoint_connector._loaded_checkpoint:
                raise
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:150]
            raise UserError(
                f"{self.ckpt_path}: expected a checkpoint of the same kind of run, found one that cannot be restored ({reason})"
            ) from error

    def invert(self, model: Adaptation, datamodule: pl.LightningDataModule) -> None:
        """Learn the concepts, write them to files, then generate and judge samples."""
        adapts = isinstance(model, Adaptation)
        require(adapts, "model.class_path", "a module that adapts a pretrained model", type(model).__name__)
        self.verb = "invert"
        self.check_alone(self.verb)
        for name, value in self.unusual.items() if model.learns else ():
            reason = "as data.steps and model.budget decide how concepts are learned"
            raise UserError(f"trainer.{name}: expected no such option, {reason}, found {value}")
        if model.learns:
            self.fit(model, datamodule=datamodule)
        else:
            require(self.processes == 1, "trainer.processes", f"1 for {model.method}, which learns nothing", self.processes)
        self.test(model, datamodule=datamodule, verbose=False)


def _check_options(options: dict[str, Any]) -> None:
    """Refuse values that Lightning does not check."""
    for least, names in LEAST.items():
        for name in names:
            value = options.get(name)
            value = int(value) if isinstance(value, str) and value.isdecimal() else value  # devices may be a string
            if isinstance(value, int | float) and not isinstance(value, bool):
                check_range(f"trainer.{name}", value, least, MOST_DEVICES if name in ("devices", "num_nodes") else math.inf)
    for name in SHARES:
        value = options.get(name)
        if isinstance(value, int | float):
            whole = f"a whole number of {'steps' if name == 'val_check_interval' else 'batches'}"
            valid = 0 <= value <= 1 or (value > 1 and value == int(value))
            require(valid, f"trainer.{name}", f"a share from 0 to 1 or {whole}", value)
    never = "0; trainer.limit_val_batches 0 validates never"
    require(options.get("val_check_interval") != 0, "trainer.val_check_interval", "more than 0", never)
