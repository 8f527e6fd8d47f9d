"""Demonstrations as an ``.npz`` file of plain arrays, the form of other software."""

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.formats.file_keys import OBSERVED, TEXTS
from ftl_lightning.services.errors import UserError, about, short
from ftl_lightning.services.files import MOST_TENSORS, check_readable, check_unpacked
from ftl_lightning.services.tensor_file import atomic

_DAMAGED = (OSError, ValueError, EOFError, AttributeError, TypeError, RuntimeError, LookupError, MemoryError, SyntaxError)
"""Exceptions of numpy and zipfile for damaged or foreign files."""


def read_npz(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read numbers by key, and texts by key as in the header of a safetensors file.

    Raises:
        UserError: naming the file, if it is missing, damaged, holds objects, or an array of another type than its key requires.
    """
    size = check_readable(path, "demonstrations")
    try:
        check_arrays(path, size)
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
            texts = {name: array.tolist() for name, array in arrays.items() if array.dtype.kind == "U"}
        "".join(text for value in texts.values() for text in np.ravel(value)).encode()
    except (*_DAMAGED, zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError) as error:
        message = short(str(error), 100)
        raise UserError(f"{path}: expected an .npz of plain arrays, found a damaged one or one with objects ({message})") from error
    tensors = {}
    for name, array in arrays.items():
        measured = name.startswith(OBSERVED) or name in ("states", "lengths", "scenes")
        if (measured and array.dtype.kind not in "fiub") or (name in (*TEXTS, "domain") and array.dtype.kind != "U"):
            expected = "numbers" if measured else "texts"
            raise UserError(f"{path}: key {short(name)!r}: expected an array of {expected}, found one of {short(str(array.dtype))}")
        if array.dtype.kind in "fiub":
            # Images stay uint8; all other measurements become float32.
            image = array.dtype == np.uint8 and name.startswith(OBSERVED)
            kind = np.uint8 if image else np.int64 if name == "lengths" and array.dtype.kind in "iu" else np.float32
            with np.errstate(over="ignore"):  # overflow is reported later as a number that is not finite
                tensors[name] = torch.from_numpy(np.array(array, dtype=kind, order="C", ndmin=array.ndim))
    for name, value in texts.items():
        if isinstance(value, str):
            # A single text is that of all demonstrations.
            several = name == "concepts" and "states" in tensors and tensors["states"].dim()
            texts[name] = [value] * len(tensors["states"]) if several else [value]
    header: dict[str, Any] = dict(texts)
    if len(texts.get("domain", ())) == 1:
        header["domain"] = texts["domain"][0]
    return tensors, header


def write_npz(path: str | Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write a file for :func:`read_npz`, without compression, whole or not at all.

    Args:
        path: the file.
        tensors: numbers by key.
        header: only the domain and lists of texts are written; arrays have no place for the rest.

    Raises:
        UserError: if the file cannot be written.
    """
    arrays: dict[str, Any] = {key: values.detach().cpu().numpy() for key, values in tensors.items()}
    arrays |= {key: np.array(header[key], dtype=np.str_) for key in ("domain", *TEXTS) if key in header}
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def check_arrays(path: Path, size: int) -> None:
    """Refuse an archive that is much larger than its file, or an array whose header contradicts its size in bytes.

    Raises:
        ValueError: naming the mismatch.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > MOST_TENSORS:
            raise ValueError(f"{len(members)} arrays")
        with about(path):
            check_unpacked(sum(member.file_size for member in members), size, "arrays")
        for member in members:
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
                stated = math.prod(shape) * dtype.itemsize
                if not dtype.hasobject and (min(shape, default=0) < 0 or stated != member.file_size - file.tell()):
                    raise ValueError(f"{member.filename} is not of the size that it says")
