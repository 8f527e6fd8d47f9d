"""Several processes of one run: only the first prints, and all end when any of them fails, with a one-line reason."""

import os
import signal
import subprocess
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import lightning.pytorch as pl
from lightning.fabric.utilities.distributed import _set_num_threads_if_needed
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher
from torch import distributed

from ftl_lightning.services.errors import UserError, mistake_behind, mistake_of_machine, short
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.text import line, say, silence

NOTES = "FTL_LIGHTNING_NOTES"
"""Environment variable of started processes: the folder to which they write why they end."""
LOOK = 0.3
"""Seconds between checks whether the other processes still run."""
PATIENCE = 5.0
"""Seconds in which a process notices by itself that another process ended."""
_LOST = ("gloo", "NCCL", "Connection closed", "Connection reset", "Broken pipe", "TCPStore", "store->get")
"""Fragments of torch's messages to a process that waits for a process that ended."""


@contextmanager
def one_voice() -> Iterator[None]:
    """Within the block, silence a process that another process started, write its error down, and end it with its parent."""
    if NOTES not in os.environ:
        yield
        return
    silence()
    warnings.simplefilter("ignore")
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        yield
    except Exception as error:
        mistake = mistake_behind(error) or mistake_of_machine(error)
        if mistake is None and not _is_loss(error):
            raise
        if mistake is not None:
            write_text(Path(os.environ[NOTES]) / str(os.getpid()), line(str(mistake)))
        raise SystemExit(2) from None


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK)
    os._exit(2)


def _is_loss(error: BaseException) -> bool:
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _LOST)


def _grouped(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Result of a function; the process group is destroyed, so nothing later can wait for other processes."""
    result = function(*arguments, **options)
    if distributed.is_initialized():
        distributed.destroy_process_group()
    return result


class Launcher(_SubprocessScriptLauncher):
    """Starts the other processes. Lightning's launcher kills the first process seconds after another ends, without a message."""

    def launch(self, function: Callable[..., Any], *args: Any, trainer: "pl.Trainer | None" = None, **kwargs: Any) -> Any:
        """Run a function in all processes.

        Raises:
            UserError: in the first process, if another process ends early.
        """
        self.cluster_environment.validate_settings(num_devices=self.num_processes, num_nodes=self.num_nodes)
        if self.cluster_environment.creates_processes_externally:
            _set_num_threads_if_needed(num_processes=self.num_processes)
            return _grouped(function, *args, **kwargs)
        with tempfile.TemporaryDirectory() as notes:
            os.environ[NOTES] = notes
            self._call_children_scripts()
            del os.environ[NOTES]
            _set_num_threads_if_needed(num_processes=self.num_processes)
            ended = threading.Event()
            threading.Thread(target=self._watch, args=(ended, Path(notes)), daemon=True).start()
            try:
                result = _grouped(function, *args, **kwargs)
                self._wait()
            except RuntimeError as error:
                if not _is_loss(error):
                    raise
                self._wait()
                raise UserError(self._reason(Path(notes))) from error
            finally:
                ended.set()
                self.kill(signal.SIGKILL)
            return result

    def _wait(self) -> None:
        """Wait for the other processes, which are about to end."""
        end = time.monotonic() + PATIENCE
        while any(process.poll() is None for process in self.procs) and time.monotonic() < end:
            time.sleep(0.02)

    def _watch(self, ended: threading.Event, notes: Path) -> None:
        """End this process if it does not notice by itself that another process ended, such as within NCCL."""
        while not ended.wait(LOOK):
            if any(process.poll() for process in self.procs):
                if not ended.wait(PATIENCE):
                    self._end(notes)
                return

    def _end(self, notes: Path) -> NoReturn:
        say("error:", self._reason(notes), error=True)
        self.kill(signal.SIGKILL)
        os._exit(2)

    def _reason(self, notes: Path) -> str:
        """Why the other processes ended, in one line."""
        if written := sorted(path for path in notes.iterdir() if path.name.isdecimal()):
            return written[0].read_text("utf-8")
        rank, gone = next(((rank, process) for rank, process in enumerate(self.procs, 1) if process.poll()), (0, None))
        reason = "the connection to one was lost" if gone is None else f"process {rank} ended {_how(gone)}"
        return f"trainer.devices: expected {self.num_processes} processes to the end, {reason}; go on with --ckpt_path last"


def _how(process: "subprocess.Popen[bytes]") -> str:
    code = process.returncode
    return f"with code {code}" if code > 0 else f"by signal {-code} ({signal.Signals(-code).name})"


def take_over(trainer: pl.Trainer) -> None:
    """Let a trainer start its processes with a :class:`Launcher`, and exchange gradients in place."""
    launcher = trainer.strategy.launcher
    if type(launcher) is _SubprocessScriptLauncher:
        replacement = Launcher(launcher.cluster_environment, launcher.num_processes, launcher.num_nodes)
        trainer.strategy._launcher = replacement
    if isinstance(trainer.strategy, DDPStrategy):  # avoids copies of gradients before and after the exchange
        trainer.strategy._ddp_kwargs.setdefault("gradient_as_bucket_view", True)


def check_alone(trainer: pl.Trainer, verb: str) -> None:
    """Refuse several processes for a verb that runs in one process.

    Raises:
        UserError: naming the verb.
    """
    if (processes := trainer.num_devices * trainer.num_nodes) > 1:
        instead = "use trainer.processes" if verb == "invert" else "`fit` alone runs on several"
        raise UserError(f"trainer.devices: expected 1 for {verb}, found {processes}; {instead}")


def check_exact(trainer: pl.Trainer) -> None:
    """Refuse several processes unless each is started separately and holds all weights.

    Raises:
        UserError: naming the strategy.
    """
    strategy = trainer.strategy
    if trainer.num_devices * trainer.num_nodes > 1 and not (
        isinstance(strategy, DDPStrategy) and isinstance(strategy.launcher, _SubprocessScriptLauncher | None)
    ):
        raise UserError(f"trainer.strategy: expected ddp for several processes, found {_name(strategy)}")


def _name(strategy: object) -> str:
    return str(getattr(strategy, "_start_method", None) or short(type(strategy).__name__))
