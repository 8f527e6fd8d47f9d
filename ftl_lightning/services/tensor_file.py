"""Write files atomically, and read them without unpickling."""

import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from ftl_lightning.services.errors import UserError, about, require, short, shown
from ftl_lightning.services.files import MOST_HEADER, MOST_TENSORS, check_file, check_readable, raised
from ftl_lightning.services.validation import parse_json

_HEADER = "ftl_lightning"
FORMAT = 1
"""Default version of a file's format; a reader refuses all others."""


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/ftl-lightning``, or ``~/.cache/ftl-lightning``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ftl-lightning"


def data_folder() -> Path:
    """``$XDG_DATA_HOME/ftl-lightning``, or ``~/.local/share/ftl-lightning``: files that a user keeps."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "ftl-lightning"


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder, which is renamed to ``path`` on success and removed on failure.

    A symbolic link is kept and its target replaced. Temporary files are hidden (see :func:`visible`). Those that a killed process
    left of the same file are removed first.

    Raises:
        UserError: if the folder cannot be written, the disk is full, or ``path`` exists and is no file.
    """
    check_file(path)
    path = Path(path).resolve() if Path(path).is_symlink() else Path(path)
    temporary: Path | None = None
    handle = -1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        begin = f".{path.name.encode()[:_LONGEST].decode(errors='ignore')}."
        _remove_left(path.parent, begin, path.suffix)
        handle, temporary = _locked(path.parent, begin, path.suffix)
        yield temporary
        os.fsync(handle)
        os.umask(umask := os.umask(0))
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error}); choose a writable place with room") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
            os.close(handle)


_LONGEST = 100
"""Bytes of a file's name that are kept in its temporary name."""


def _locked(folder: Path, begin: str, end: str) -> tuple[int, Path]:
    """Create a file that is locked while its handle is open, which shows that its process still runs."""
    while True:
        handle, name = tempfile.mkstemp(prefix=begin, suffix=end, dir=folder)
        fcntl.flock(handle, fcntl.LOCK_EX)
        if os.fstat(handle).st_nlink:  # else another process removed it as left over
            return handle, Path(name)
        os.close(handle)


def _remove_left(folder: Path, begin: str, end: str) -> None:
    """Remove temporary files of this name whose process has ended."""
    for left in folder.iterdir():
        if not (left.name.startswith(begin) and left.name.endswith(end) and left.is_file()):
            continue
        with suppress(OSError), left.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()


@contextmanager
def alone(folder: str | Path) -> Iterator[None]:
    """Lock a folder, made if missing, so that processes change its files in turn."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def visible(folder: Path, pattern: str) -> list[Path]:
    """Sorted paths below a folder that match a pattern, without hidden ones such as the temporary files of :func:`atomic`."""
    paths = sorted(folder.glob(pattern))
    return [path for path in paths if not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def serialise(kind: str, tensors: Mapping[str, Tensor], header: Mapping[str, Any], version: int = FORMAT) -> bytes:
    """Serialise tensors with a JSON header as safetensors; the same content gives the same bytes.

    Args:
        kind: kind of file, checked by readers.
        tensors: tensors by name.
        header: anything JSON can hold.
        version: version of this kind's format.
    """
    # A single metadata key: safetensors does not keep the order of several, and bytes would differ between runs.
    text = json.dumps({"kind": kind, "format": version, **header}, sort_keys=True)
    # Copies: safetensors refuses tensors that share memory, such as a scene that is the only observed feature.
    copies = {name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()}
    return safetensors.torch.save(copies, {_HEADER: text})


def save_tensors(
    path: str | Path, kind: str, tensors: Mapping[str, Tensor], header: Mapping[str, Any], version: int = FORMAT
) -> None:
    """Write the bytes of :func:`serialise`, with the same arguments, atomically."""
    with atomic(path) as temporary:
        temporary.write_bytes(serialise(kind, tensors, header, version))


def load_tensors(path: str | Path, kind: str, version: int = FORMAT) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a file of :func:`save_tensors`: tensors by name, and the header.

    Raises:
        UserError: for a file that is missing, damaged, or of another kind.
    """
    with _opened(Path(path), kind) as (file, text):
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no mapping)
    with about(path):
        return tensors, check_kind(parse_json(text), kind, version)


def load_header(path: str | Path, kind: str) -> tuple[dict[str, tuple[int, ...]], Any]:
    """Read shapes by name and the header of a file of tensors, without the tensors and without the checks of :func:`check_kind`.

    Raises:
        UserError: for a file that is missing or damaged.
    """
    with _opened(Path(path), kind) as (file, text):
        shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 (it is no mapping)
    with about(path):
        return shapes, parse_json(text)


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[tuple[Any, str]]:
    """Open a file of tensors; yield it with the text of its header."""
    _check_header(path, kind, check_readable(path, kind))
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            yield file, (file.metadata() or {}).get(_HEADER, "{}")
    except (safetensors.SafetensorError, OSError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: expected a {kind} file, found a damaged or foreign file ({short(str(error), 100)})") from error


def check_kind(header: object, kind: str, version: int = FORMAT) -> dict[str, Any]:
    """Refuse the header of a file of another kind or version.

    Raises:
        UserError: naming the actual kind or version.
    """
    actual = header.get("kind") if isinstance(header, dict) else None
    if not isinstance(header, dict) or actual != kind:
        message = f"a {short(str(actual))} file" if actual else "a file of other software"
        raise UserError(f"expected a {kind} file, found {message}")
    actual = header.get("format")
    same = actual == version and not isinstance(actual, bool)
    require(same, "key 'format'", str(version), f"{shown(actual)}; it is of another version")
    return header


def kind_of(content: bytes) -> str:
    """Kind of a safetensors file of this package, from its header alone; empty for any other content."""
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or length > min(len(content), raised(MOST_HEADER)):
        return ""
    try:
        header = parse_json(content[8 : 8 + length])
        metadata = parse_json(header["__metadata__"][_HEADER])
        return str(metadata["kind"])
    except (UserError, KeyError, TypeError, IndexError):
        return ""


def _check_header(path: Path, kind: str, size: int) -> None:
    """Refuse a safetensors file of ``size`` bytes whose header is too long or names too many tensors: reading it takes minutes."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        most = raised(MOST_HEADER)
        message = "a damaged or foreign file" if length > size else f"a header of {length} bytes, more than {most}"
        require(length <= min(size, most), str(path), f"a {kind} file", message)
        # Each tensor is a mapping, however its keys are written; braces in texts are too few to matter.
        tensors = file.read(length).count(b"{")
        require(tensors <= MOST_TENSORS, str(path), f"a {kind} file of at most {MOST_TENSORS} tensors", tensors)


def check_finite(tensors: Mapping[str, Tensor], where: str, advice: str) -> None:
    """Refuse tensors with numbers that are not finite.

    Raises:
        UserError: naming the first such tensor.
    """
    for name, value in tensors.items():
        require(value.isfinite().all(), where, "finite numbers", f"others in {short(name)!r}; {advice}")


def bytes_hash(content: bytes) -> str:
    """First 16 hexadecimal digits of the SHA-256 of bytes."""
    return hashlib.sha256(content).hexdigest()[:16]


def file_hash(path: str | Path) -> str:
    """:func:`bytes_hash` of a file."""
    return bytes_hash(Path(path).read_bytes())


def content_hash(content: Any) -> str:
    """:func:`bytes_hash` of anything JSON can hold."""
    return bytes_hash(json.dumps(content, sort_keys=True, default=str).encode())
