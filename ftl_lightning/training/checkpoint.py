"""Checkpoints: written atomically, bound to a module class, and complete, so that a resumed run ends with the same bytes."""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from packaging.version import InvalidVersion, Version
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import UserError, require, short, shown
from ftl_lightning.services.files import check_readable
from ftl_lightning.services.store import fetched, is_url, modified
from ftl_lightning.services.tensor_file import atomic, check_finite, visible

SIGNATURE = "belongs_to"
_RANDOM = "random"
_VERSION = "pytorch-lightning_version"
_FORM: Mapping[str, type] = {
    "state_dict": dict,
    "epoch": int,
    "global_step": int,
    "loops": dict,
    _VERSION: str,
    "optimizer_states": list,
    "lr_schedulers": list,
    "callbacks": dict,
    SIGNATURE: dict,
    _RANDOM: dict,
}
"""Type of each checkpoint key; only those in :data:`_NEEDED` are required."""
_NEEDED = ("state_dict", "epoch", "global_step", "loops")


class WholeCheckpoints(TorchCheckpointIO):
    """Atomic checkpoint writes by renaming; damaged checkpoints are refused.

    Lightning writes to the folder for temporary files, and a move from there to another file system is not atomic.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint atomically; ``UserError`` if the folder cannot be written or the disk is full."""
        if is_url(path):  # stores write whole files
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with atomic(path) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: str | Path, map_location: Callable[..., Any] | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU by :func:`read_checkpoint`; ``weights_only`` is always on."""
        content = read_checkpoint(path)
        try:
            old = Version(content.get(_VERSION, "")) < Version("2")
        except InvalidVersion:
            old = True
        if old:  # Lightning would look for missing keys
            raise UserError(f"{path}: key {_VERSION!r}: expected 2.0 or newer, found {shown(content.get(_VERSION))}")
        return content


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint, from a store if the path is a URL, and verify its checksums.

    Raises:
        UserError: for a damaged or foreign file, with the newest whole checkpoint of a local folder.
    """
    if is_url(path):
        folder, _, name = str(path).rpartition("/")
        return _read(fetched(folder, [name]) / name)
    try:
        return _read(Path(path))
    except UserError as error:
        others = [checkpoint for checkpoint in visible(Path(path).parent, "*.ckpt") if checkpoint.name != Path(path).name]
        checkpoints = sorted(others, key=lambda checkpoint: checkpoint.stat().st_mtime, reverse=True)
        if whole := next((checkpoint for checkpoint in checkpoints if _is_whole(checkpoint)), None):
            raise UserError(f"{error}; go on from the newest whole one: --ckpt_path {whole}") from error.__cause__
        raise


def _read(path: Path) -> dict[str, Any]:
    size = check_readable(path, "checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > size:
                raise ValueError("its content is compressed, which that of a checkpoint is not")
            damaged = archive.testzip()  # torch does not verify checksums
        if damaged is not None:
            raise ValueError(f"the checksum of {damaged} is another")
        content = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch and zipfile raise many kinds
        raise UserError(f"{path}: expected a checkpoint, found a damaged or foreign file") from error
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected a checkpoint, found a {type(content).__name__}")
    for key, kind in _FORM.items():
        part = content.get(key)
        if (key in content or key in _NEEDED) and (not isinstance(part, kind) or isinstance(part, bool)):
            raise UserError(f"{path}: key {key!r}: expected a checkpoint's {kind.__name__}, found {_kind(part)}")
    for name, value in content["state_dict"].items():
        if not (isinstance(name, str) and isinstance(value, Tensor)):
            raise UserError(f"{path}: key 'state_dict': expected tensors by name, found {_kind(value)} as {str(name)[:50]!r}")
    return content


def _kind(value: object) -> str:
    return "nothing" if value is None else f"a {type(value).__name__}"


def _is_whole(path: Path) -> bool:
    try:
        _read(path)
    except UserError:
        return False
    return True


def last_checkpoint(trainer: pl.Trainer) -> str | None:
    """The newest of the last checkpoints of the trainer's callbacks; ``None`` without any."""
    callbacks = [callback for callback in trainer.checkpoint_callbacks if isinstance(callback, ModelCheckpoint)]
    # No public name: Lightning finds last checkpoints only while it resumes, too late to say that there is none.
    paths = []
    for callback in callbacks:
        protocol, remote, _ = str(callback.dirpath).partition("://")  # Lightning leaves the protocol out
        found = [str(path) for path in callback._find_last_checkpoints(trainer)]
        paths += [f"{protocol}://{path.lstrip('/')}" for path in found] if remote else found
    times = {path: modified(path) for path in paths}
    return max((path for path in paths if times[path] is not None), key=lambda path: times[path] or 0.0, default=None)


def check_parameters(parameters: Mapping[str, Any], module: pl.LightningModule) -> None:
    """Refuse checkpoint parameters that do not fit a module.

    Raises:
        UserError: for the first missing, unknown or non-finite parameter, or another shape.
    """
    expected = module.state_dict()
    for name in expected | dict(parameters):
        place = f"ckpt_path: key 'state_dict', {name!r}"
        require(name in parameters, place, "it", "nothing; it is damaged")
        require(name in expected, place, "nothing", "it; it is damaged")
        shapes = tuple(expected[name].shape), tuple(parameters[name].shape)
        require(shapes[0] == shapes[1], place, f"shape {shapes[0]}", f"{shapes[1]}; it is damaged")
    check_finite(parameters, "ckpt_path: key 'state_dict'", "take an older checkpoint")


def check_restored(module: pl.LightningModule, step: int) -> None:
    """Refuse inconsistent state that Lightning and torch accepted.

    Raises:
        UserError: for another step, an optimiser without state, or state whose shapes differ from the parameters'.
    """
    if module.trainer.global_step != step:
        raise UserError(f"ckpt_path: key 'loops': expected step {step}, found {module.trainer.global_step}; it is damaged")
    for optimizer in module.trainer.optimizers:
        if step and not optimizer.state:
            raise UserError("ckpt_path: key 'optimizer_states': expected the state of an optimiser, found none; it is damaged")
        for parameter, state in optimizer.state.items():
            for name, value in state.items():
                if not isinstance(value, Tensor) or value.shape not in (parameter.shape, ()):
                    shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                    raise UserError(
                        f"ckpt_path: key 'optimizer_states', {name!r}: expected shape {tuple(parameter.shape)}, found {shape}; "
                        "it is damaged"
                    )


class Random(NamedTuple):
    """States of the global generators after a step.

    Attributes:
        cpu: state of the CPU generator.
        cuda: state of the module's GPU generator; ``None`` on a CPU.
        iterations: loader iterations that an uninterrupted run starts before its next step; each draws a number.
    """

    cpu: Tensor
    cuda: Tensor | None
    iterations: int

    @classmethod
    def now(cls, device: torch.device, iterations: int) -> "Random":
        """The current states."""
        return cls(torch.get_rng_state(), torch.cuda.get_rng_state(device) if device.type == "cuda" else None, iterations)

    def restore(self, device: torch.device) -> None:
        """Restore the global generators to their states before the next step of an uninterrupted run."""
        torch.set_rng_state(self.cpu)
        for _ in range(self.iterations):
            torch.empty((), dtype=torch.int64).random_()
        if self.cuda is not None and device.type == "cuda":
            torch.cuda.set_rng_state(self.cuda, device)

    def write(self, checkpoint: dict[str, Any]) -> None:
        """Write to a checkpoint."""
        checkpoint[_RANDOM] = self._asdict()

    @classmethod
    def read(cls, checkpoint: Mapping[str, Any]) -> "Random":
        """Read from a checkpoint; ``UserError`` for missing or damaged states."""
        try:
            states = cls(**checkpoint[_RANDOM])
            torch.Generator().set_state(states.cpu)
        except (KeyError, TypeError, RuntimeError) as error:
            raise UserError(f"ckpt_path: key {_RANDOM!r}: expected states of generators, found something else") from error
        if not isinstance(states.iterations, int) or not 0 <= states.iterations <= 9 or not isinstance(states.cuda, Tensor | None):
            raise UserError(f"ckpt_path: key {_RANDOM!r}: expected states of generators, found something else")
        return states


def check_signature(expected: Mapping[str, Any], checkpoint: Mapping[str, Any]) -> None:
    """Refuse a checkpoint with another signature; ``UserError`` with the first key that differs."""
    signature = checkpoint.get(SIGNATURE, {})
    for key in expected | signature:
        value, setting = signature.get(key), expected.get(key)
        message = f"{short(str(value), 90)}; it is the checkpoint of something else"
        require(value == setting, f"ckpt_path: key {key!r}", short(str(setting), 90), message)


def data_hash(demonstrations: Demonstrations) -> str:
    """16-digit hash of demonstrations and their concepts, without a copy of large tensors."""
    digest = hashlib.sha256(json.dumps(demonstrations.concepts).encode())
    for name, tensor in sorted(demonstrations.tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        for row in tensor:
            digest.update(row.contiguous().numpy())
    return digest.hexdigest()[:16]


PATHS = ("output", "root", "demonstrations", "more")
"""Hyper-parameters that name places; the content of data is compared by :func:`data_hash`."""


def changed_options(before: object, now: Mapping[str, Any], section: str, places: Mapping[str, str]) -> dict[str, str]:
    """Hyper-parameters that differ from a checkpoint's, by option, as ``'value (before: value)'``.

    Args:
        before: hyper-parameters in the checkpoint.
        now: hyper-parameters of the run.
        section: ``'model'`` or ``'data'``.
        places: grouped options by flat name, see :func:`~ftl_lightning.services.validation.groups_of`.
    """
    if not isinstance(before, Mapping):
        raise UserError(f"ckpt_path: expected the options of {section}, found {_kind(before)}; it is damaged")
    names = [name for name in now if name in before and name not in PATHS and not name.startswith("_")]
    return {
        f"{section}.{places.get(name, name)}": f"{shown(now[name], 40)} (before: {shown(before[name], 40)})"
        for name in names
        if json.dumps(now[name], sort_keys=True, default=str) != json.dumps(before[name], sort_keys=True, default=str)
    }


def apply_rates(checkpoint: Mapping[str, Any], learning_rate: float, weight_decay: float) -> None:
    """Replace the learning rate and weight decay in a checkpoint's optimiser and schedule, which torch would restore."""
    with suppress(KeyError, IndexError, TypeError, AttributeError):  # a damaged part is refused where it is restored
        schedule, groups = checkpoint["lr_schedulers"][0], checkpoint["optimizer_states"][0]["param_groups"]
        (before,) = schedule["base_lrs"]
        for group in groups:
            group["lr"] = learning_rate * (group["lr"] / before if before else 0)
            group["initial_lr"], group["weight_decay"] = learning_rate, weight_decay
        schedule["base_lrs"], schedule["_last_lr"] = [learning_rate], [group["lr"] for group in groups]
