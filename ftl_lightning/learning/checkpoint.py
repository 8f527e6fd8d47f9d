"""Checkpoints: whole or absent, of one module class alone, and with all that a resumed run needs to end with the same bytes."""

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from packaging.version import InvalidVersion, Version
from torch import Tensor

from ftl_lightning.errors import UserError, shown
from ftl_lightning.limits import expect_readable
from ftl_lightning.tensor_file import atomic, expect_finite, visible

_KEY = "belongs_to"
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
    _KEY: dict,
    _RANDOM: dict,
}
"""Of a checkpoint's keys the kinds; all but those of :data:`_NEEDED` may be missing."""
_NEEDED = ("state_dict", "epoch", "global_step", "loops")


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint beside its name and renames it, and refuses a damaged one.

    Lightning writes to the folder for temporary files, from which a file on another file system is copied and not renamed.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write it whole or not at all.

        Raises:
            UserError: where the folder cannot be written or the disk is full.
        """
        if "://" in str(path):  # on a store that renames nothing
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with atomic(path) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: str | Path, map_location: Callable[..., Any] | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read it on the CPU, as :func:`read_checkpoint`; nothing is unpickled whatever the caller says."""
        if "://" in str(path):
            return super().load_checkpoint(path, map_location, weights_only=True)
        content = read_checkpoint(path)
        try:
            old = Version(content.get(_VERSION, "")) < Version("2")
        except InvalidVersion:
            old = True
        if old:  # Lightning would look for what they do not have
            raise UserError(f"{path}: key {_VERSION!r}: expected 2.0 or newer, found {shown(content.get(_VERSION))}")
        return content


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint whose every byte is as it was written.

    Raises:
        UserError: for a file that is damaged or no checkpoint, naming the newest whole checkpoint beside it.
    """
    try:
        return _read(Path(path))
    except UserError as error:
        others = sorted(_beside(Path(path)), key=lambda other: other.stat().st_mtime, reverse=True)
        if whole := next((other for other in others if _is_whole(other)), None):
            raise UserError(f"{error}; go on from the newest whole one: --ckpt_path {whole}") from error.__cause__
        raise


def _read(path: Path) -> dict[str, Any]:
    size = expect_readable(path, "checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > size:
                raise ValueError("its content is compressed, which that of a checkpoint is not")
            damaged = archive.testzip()  # torch itself does not look at the checksums
        if damaged is not None:
            raise ValueError(f"the checksum of {damaged} is another")
        content = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch and zipfile raise many kinds
        raise UserError(f"{path}: expected a checkpoint, found a damaged or foreign file") from error
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected a checkpoint, found a {type(content).__name__}")
    for key, kind in _FORM.items():
        found = content.get(key)
        if (key in content or key in _NEEDED) and (not isinstance(found, kind) or isinstance(found, bool)):
            raise UserError(f"{path}: key {key!r}: expected a checkpoint's {kind.__name__}, found {_kind(found)}")
    for name, value in content["state_dict"].items():
        if not (isinstance(name, str) and isinstance(value, Tensor)):
            raise UserError(f"{path}: key 'state_dict': expected tensors by name, found {_kind(value)} as {str(name)[:50]!r}")
    return content


def _kind(found: object) -> str:
    return "nothing" if found is None else f"a {type(found).__name__}"


def _is_whole(path: Path) -> bool:
    try:
        _read(path)
    except UserError:
        return False
    return True


def _beside(path: Path) -> list[Path]:
    """Other checkpoints of the folder."""
    return [other for other in visible(path.parent, "*.ckpt") if other.name != path.name]


def last_checkpoint(trainer: pl.Trainer) -> Path | None:
    """The checkpoint that ``last`` names: the newest of those that the trainer's callbacks keep as their last; maybe none."""
    callbacks = [one for one in trainer.checkpoint_callbacks if isinstance(one, ModelCheckpoint)]
    found = [Path(path) for callback in callbacks for path in callback._find_last_checkpoints(trainer)]
    return max((path for path in found if path.is_file()), key=lambda path: path.stat().st_mtime, default=None)


def check_parameters(found: Mapping[str, Any], module: pl.LightningModule, optional: str = "") -> None:
    """Refuse parameters of a checkpoint that are not those of a module.

    Args:
        found: of the checkpoint, by name.
        module: with its layers.
        optional: what the names of the only parameters that a checkpoint holds begin with; empty for all.

    Raises:
        UserError: naming the first one that is missing, unknown, of another shape or not finite.
    """
    expected = {name: value for name, value in module.state_dict().items() if name.startswith(optional)}
    for name in expected | dict(found):
        if name not in found or name not in expected:
            what = ("it", "nothing") if name not in found else ("nothing", "it")
            raise UserError(f"ckpt_path: key 'state_dict', {name!r}: expected {what[0]}, found {what[1]}; it is damaged")
        if found[name].shape != expected[name].shape:
            shapes = f"expected shape {tuple(expected[name].shape)}, found {tuple(found[name].shape)}"
            raise UserError(f"ckpt_path: key 'state_dict', {name!r}: {shapes}; it is damaged")
    # Losses that a concept has not reached yet are infinite.
    own = [name for name, _ in module.named_parameters() if name in found] if optional else list(found)
    expect_finite({name: found[name] for name in own}, "ckpt_path: key 'state_dict'", "take an older checkpoint")


def check_restored(module: pl.LightningModule, step: int) -> None:
    """Refuse what was restored if Lightning and torch took it though it does not belong together.

    Args:
        module: whose trainer starts.
        step: of the checkpoint.

    Raises:
        UserError: for another step, an optimiser without a state, or one whose tensors are not of their parameters' shapes.
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
    """Where the global generators stood after a step.

    Attributes:
        cpu: state of the CPU's.
        cuda: that of the module's GPU; ``None`` on a CPU.
        iterations: how often the unbroken run begins to iterate a loader before its next step; each time draws one number.
    """

    cpu: Tensor
    cuda: Tensor | None
    iterations: int

    @classmethod
    def now(cls, device: torch.device, iterations: int) -> "Random":
        """As they stand."""
        return cls(torch.get_rng_state(), torch.cuda.get_rng_state(device) if device.type == "cuda" else None, iterations)

    def restore(self, device: torch.device) -> None:
        """Put them where they stand in the unbroken run before its next step."""
        torch.set_rng_state(self.cpu)
        for _ in range(self.iterations):
            torch.empty((), dtype=torch.int64).random_()
        if self.cuda is not None and device.type == "cuda":
            torch.cuda.set_rng_state(self.cuda, device)

    def write(self, checkpoint: dict[str, Any]) -> None:
        """Into a checkpoint."""
        checkpoint[_RANDOM] = self._asdict()

    @classmethod
    def read(cls, checkpoint: Mapping[str, Any]) -> "Random":
        """From a checkpoint.

        Raises:
            UserError: if the states are missing or damaged.
        """
        try:
            found = cls(**checkpoint[_RANDOM])
            torch.Generator().set_state(found.cpu)
        except (KeyError, TypeError, RuntimeError) as error:
            raise UserError(f"ckpt_path: key {_RANDOM!r}: expected states of generators, found something else") from error
        if not isinstance(found.iterations, int) or not 0 <= found.iterations <= 9 or not isinstance(found.cuda, Tensor | None):
            raise UserError(f"ckpt_path: key {_RANDOM!r}: expected states of generators, found something else")
        return found


def _signature(module: pl.LightningModule, more: Mapping[str, Any]) -> dict[str, Any]:
    return {"module_class": type(module).__name__, **more}


def sign(module: pl.LightningModule, checkpoint: dict[str, Any], more: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Write the module's class, and the settings that must match before it is loaded, into its checkpoint."""
    checkpoint[_KEY] = _signature(module, more)


def check_signature(module: pl.LightningModule, checkpoint: dict[str, Any], more: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Refuse a checkpoint with another signature.

    Raises:
        UserError: naming the first key that differs.
    """
    own, signature = _signature(module, more), checkpoint.get(_KEY, {})
    for key in own | signature:  # a setting that one of them does not name is at its default there
        if (found := signature.get(key)) != (expected := own.get(key)):
            raise UserError(f"ckpt_path: key {key!r}: expected {expected}, found {found}; it is the checkpoint of something else")
