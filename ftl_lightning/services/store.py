"""Models and checkpoints in object stores, such as ``s3://bucket/model``, by fsspec."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import VARIABLE, most_bytes


def is_url(place: str | Path) -> bool:
    """Whether a place is in a store, such as ``s3://bucket/model``, and not in a local folder."""
    return "://" in str(place)


@contextmanager
def _store(url: str) -> Iterator[tuple[Any, str]]:
    """File system and path of a URL; every error of the store becomes a ``UserError``."""
    from fsspec.core import url_to_fs

    try:
        yield url_to_fs(url)
    except UserError:
        raise
    except Exception as error:  # each store raises its own kinds
        reason = short(f"{type(error).__name__}: {error}", 150)
        raise UserError(f"{short(url, 150)}: expected a place in a store that can be reached, found {reason}") from error


def modified(url: str) -> float | None:
    """Time of a file's last change in seconds; ``None`` without such a file.

    Raises:
        UserError: if the store cannot be reached.
    """
    with _store(url) as (files, path):
        return float(files.modified(path).timestamp()) if files.isfile(path) else None


@cache
def _copies() -> tempfile.TemporaryDirectory[str]:
    """Folder of local copies, removed when the program ends."""
    return tempfile.TemporaryDirectory(prefix="ftl-lightning-")


_FETCHED: dict[tuple[str, ...], Path] = {}
"""Local copies by URL, names of files, and version of the last file."""


def fetched(url: str, names: Sequence[str]) -> Path:
    """Copy the existing files of a remote folder to a local folder, and return the local folder.

    They are copied once in a process, and again after the last file has changed.

    Raises:
        UserError: if the store cannot be reached, or a file is larger than :func:`~ftl_lightning.services.files.most_bytes`.
    """
    with _store(url) as (files, path):
        last = f"{path}/{names[-1]}"
        key = (url, *names, files.ukey(last) if files.isfile(last) else "")
        if key in _FETCHED:
            return _FETCHED[key]
        folder = Path(tempfile.mkdtemp(dir=_copies().name))
        for name in names:
            if files.isfile(f"{path}/{name}"):
                size, most = files.size(f"{path}/{name}"), most_bytes()
                require(size <= most, f"{url}/{name}", f"at most {most} bytes; if it is honest, set {VARIABLE} to more", size)
                files.get_file(f"{path}/{name}", str(folder / name))
        _FETCHED[key] = folder
        return folder


def put(folder: Path, url: str, names: Sequence[str]) -> None:
    """Copy files of a local folder to a remote folder, in order.

    Raises:
        UserError: if the store cannot be reached or written.
    """
    with _store(url) as (files, path):
        files.makedirs(path, exist_ok=True)
        for name in names:
            files.put_file(str(folder / name), f"{path}/{name}")
