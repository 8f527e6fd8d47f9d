"""Files of demonstrations: safetensors with a JSON header, and ``.npz`` of plain arrays, the form of other software."""

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import FORMATS, KIND, OBSERVED, Contents, Demonstrations, Format
from ftl_lightning.services.errors import UserError, about, require, short
from ftl_lightning.services.files import MOST_HEADER, check_unpacked
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import atomic, cache_folder, content_hash, load_tensors, save_tensors
from ftl_lightning.services.validation import check_type

VERSION = 4
"""Version of the safetensors format. Images are compressed (zlib) to 1-D uint8; the header has their shapes by key as
``compressed``."""
TEXTS = ("state_names", "state_units", "state_kinds", "concepts", "per_step", "action_names")
"""Keys of lists of texts."""
OPTIONAL = ("state_kinds", "action_names")
"""Keys that are not written if they are empty."""
MOST_SHRUNK = 1032
"""Maximum compression ratio of zlib."""
MOST_ARRAYS = 2000
"""Maximum number of arrays in an ``.npz`` file, and of groups and arrays in an HDF5 file."""
SLOW = 20
"""Minimum number of demonstrations for progress lines without a terminal."""
DAMAGED = (
    *(OSError, ValueError, EOFError, AttributeError, TypeError, RuntimeError, LookupError, MemoryError, SyntaxError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError),
)
"""Exceptions of numpy, zipfile and others for damaged or foreign files."""

Tell = Callable[[], None]


def write_safetensors(demonstrations: Demonstrations, name: str) -> None:
    """Write a safetensors file atomically; the same demonstrations give the same bytes."""
    tensors = demonstrations.tensors
    images = {key: values for key, values in tensors.items() if values.dtype == torch.uint8}
    header = {**_header(demonstrations), "provenance": dict(demonstrations.provenance)}
    if images:
        header["compressed"] = {key: list(values.shape) for key, values in images.items()}
    save_tensors(name, KIND, {**tensors, **{key: _compressed(values) for key, values in images.items()}}, header, VERSION)


def read_safetensors(name: str) -> Contents:
    """Read a file of :func:`write_safetensors`.

    Raises:
        UserError: naming the file, if it is missing, damaged, of another kind, or holds a value of another type.
    """
    tensors, header = load_tensors(name, KIND, VERSION)
    with about(name):
        return contents_of(tensors, header)


def write_npz(demonstrations: Demonstrations, name: str) -> None:
    """Write an ``.npz`` file without compression and without provenance, atomically."""
    arrays: dict[str, Any] = {key: values.detach().cpu().numpy() for key, values in demonstrations.tensors.items()}
    arrays |= {key: np.array(value, dtype=np.str_) for key, value in _header(demonstrations).items()}
    with atomic(name) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def _header(demonstrations: Demonstrations) -> dict[str, Any]:
    texts = {key: getattr(demonstrations, key) for key in TEXTS}
    return {"domain": demonstrations.domain, **{key: value for key, value in texts.items() if key not in OPTIONAL or value}}


def contents_of(tensors: dict[str, Tensor], header: Mapping[str, Any]) -> Contents:
    """Attributes of demonstrations, with defaults for missing keys."""
    names = short(", ".join(tensors)) or "nothing"
    require("states" in tensors, "key 'states'", "(demo, time, state)", f"only {names}")
    states = tensors["states"]
    demos, time, columns = states.shape if states.dim() == 3 else (0, 0, 0)
    texts: dict[str, tuple[str, ...]] = {key: check_type(header[key], tuple[str, ...], key) for key in TEXTS if key in header}
    per_step = texts.get("per_step", ())
    shapes: dict[str, tuple[int, ...]] = check_type(header.get("compressed", {}), Mapping[str, tuple[int, ...]], "compressed")
    for key, shape in shapes.items():
        leading = states.shape[: 2 if key.removeprefix(OBSERVED) in per_step else 1]
        tensors[key] = _decompressed(key, tensors.get(key), shape, tuple(leading))
    return {
        "states": states,
        "lengths": tensors.get("lengths", torch.full((demos,), time)),
        "domain": check_type(header.get("domain", ""), str, "domain"),
        "state_names": texts.get("state_names", tuple(map(str, range(columns)))),
        "state_units": texts.get("state_units", ("",) * columns),
        "concepts": texts.get("concepts", ("",) * demos),
        "observed": {key.removeprefix(OBSERVED): values for key, values in tensors.items() if key.startswith(OBSERVED)},
        "per_step": per_step,
        "scenes": tensors.get("scenes"),
        "provenance": check_type(header.get("provenance", {}), Mapping[str, Any], "provenance"),
        "state_kinds": texts.get("state_kinds", ()),
        "actions": tensors.get("actions"),
        "action_names": texts.get("action_names", ()),
    }


def _compressed(images: Tensor) -> Tensor:
    """Compress images ``(demo, ...)`` uint8 to ``(byte,)``."""
    return torch.frombuffer(bytearray(zlib.compress(images.detach().cpu().numpy().tobytes())), dtype=torch.uint8)


def _decompressed(key: str, packed: Tensor | None, shape: tuple[int, ...], leading: tuple[int, ...]) -> Tensor:
    """Decompress images ``(byte,)`` to a shape that begins with ``leading``; nothing beyond the shape is decompressed."""
    place = f"key {short(key)!r}"
    if packed is None or not key.startswith(OBSERVED) or packed.dtype != torch.uint8 or packed.dim() != 1:
        actual = "nothing" if packed is None else f"{str(packed.dtype).removeprefix('torch.')} of shape {tuple(packed.shape)}"
        raise UserError(f"{place}: expected compressed images, uint8 of shape (byte,) under 'observed/NAME', found {actual}")
    size = math.prod(shape)
    expected = f"images of shape ({', '.join(map(str, leading))}, ...) that fit into {len(packed)} compressed bytes"
    fits = shape[: len(leading)] == leading and size <= MOST_SHRUNK * len(packed)
    require(fits, place, expected, f"the shape {list(shape)} in the header; the file is damaged")
    with about(place):
        check_unpacked(size, len(packed), "images")
    reader = zlib.decompressobj()
    try:
        content = bytearray(reader.decompress(packed.numpy().tobytes(), size + 1))  # a byte more, to reach the end
    except zlib.error as error:
        raise UserError(f"{place}: expected compressed images, found damaged bytes ({error}); take another copy") from error
    longer = len(content) > size or bool(reader.unused_data)
    actual = "more" if longer else f"{len(content)}{'' if reader.eof else ' and no end'}"
    whole = len(content) == size and reader.eof and not longer
    require(whole, place, f"{size} bytes of images", f"{actual}; the file is damaged: take another copy")
    return torch.from_numpy(np.frombuffer(content, dtype=np.uint8)).reshape(shape)


def check_arrays(path: Path, size: int) -> None:
    """Refuse an archive that is much larger than its file, or an array whose header contradicts its size in bytes.

    Raises:
        ValueError: naming the mismatch.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        names = Counter(member.filename.removesuffix(".npy") for member in members)
        with about(path):
            require(len(members) <= MOST_ARRAYS, "content", f"at most {MOST_ARRAYS} arrays", str(len(members)))
            for name, count in names.most_common(1):
                require(count == 1, f"key {short(name)!r}", "it once", "it several times")
            check_unpacked(sum(member.file_size for member in members), size, "arrays")
        for member in members:
            with archive.open(member) as file:
                check_array(member.filename, file, member.file_size)


def check_array(name: str, file: IO[bytes], size: int) -> None:
    """Refuse an array of ``.npy`` whose header contradicts its ``size`` in bytes.

    Raises:
        ValueError: naming the array.
    """
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    start, width = file.tell(), 2 if version == (1, 0) else 4
    if int.from_bytes(file.read(width), "little") > size:
        raise ValueError(f"{name} is shorter than its header states")
    file.seek(start)
    shape, _, dtype = read(file)
    stated = math.prod(shape) * max(1, dtype.itemsize)  # items of no bytes could be any number
    if not dtype.hasobject and (min(shape, default=0) < 0 or stated != size - file.tell()):
        raise ValueError(f"{name} is not of the size that its header states")


def cached(settings: Mapping[str, Any], total: int, make: Callable[[Tell], Demonstrations]) -> Demonstrations:
    """Read demonstrations from the user's cache folder, or make and cache them, with a progress bar.

    Args:
        settings: everything that determines them; their hash with the version of the file format names the file.
        total: number of demonstrations.
        make: function that makes them, and calls its argument after each.
    """
    path = cache_folder() / f"{settings['domain']}-{content_hash({**settings, 'format': VERSION})}.safetensors"
    if path.is_file():
        try:
            return Demonstrations.load(path)
        except UserError:
            path.unlink(missing_ok=True)  # damaged; another process may have removed the file
    with bar(f"{settings['domain']}: demonstrations", total, lines=total >= SLOW) as advance:
        made = make(advance)
    made.save(path)
    return made


FORMATS[".safetensors"] = Format(read_safetensors, write_safetensors)


MATRIX, COMPRESSED, DATA = 14, 15, (*range(1, 8), 9, 12, 13, 16, 17, 18)
"""Types of elements: an array, a compressed one, and numbers or characters; scipy crashes at others."""
CELLS, STRUCTS, PLAIN = 1, 2, (4, *range(6, 16))
"""Classes of arrays: cells and structs, which hold arrays; texts and numbers."""


def check_matlab(path: Path, size: int, read: Callable[[str], bool]) -> None:
    """Refuse a file that unpacks to far more than its bytes, or whose variables hold others than texts and numbers.

    Args:
        path, size: file and its bytes.
        read: whether a variable of a name is read.

    Raises:
        UserError, ValueError, struct.error, zlib.error: for such a file, or a damaged one.
    """
    total = 0
    with path.open("rb") as file:
        order = "<" if file.read(128)[126:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, count = struct.unpack(f"{order}II", tag)
            content, parts, reader = file.read(min(count, size)), list[bytes](), zlib.decompressobj()
            while kind == COMPRESSED and content:
                parts.append(reader.decompress(content, MOST_HEADER))
                total += len(parts[-1])
                check_unpacked(total, size, "variables")
                content = reader.unconsumed_tail
            _check_array(b"".join(parts)[8:] if kind == COMPRESSED else content, order, (*PLAIN, CELLS, STRUCTS), read)


def _check_array(content: bytes, order: str, classes: tuple[int, ...], read: Callable[[str], bool] | None = None) -> None:
    """Check the content of an array: flags, dimensions, name, and numbers or arrays."""
    (flags,) = struct.unpack_from(f"{order}I", content, 8)
    kind, elements = flags & 0xFF, list[tuple[int, bytes]]()
    at = 16
    while at < len(content):
        (first,) = struct.unpack_from(f"{order}I", content, at)
        if first >> 16:  # small: type, size and data in eight bytes
            elements.append((first & 0xFFFF, content[at + 4 : at + 4 + (first >> 16)]))
            at += 8
        else:
            (count,) = struct.unpack_from(f"{order}I", content, at + 4)
            elements.append((first, content[at + 8 : at + 8 + count]))
            at += 8 + count + (0 if first == MATRIX else -count % 8)
    if read is not None and not read(elements[1][1].decode("latin-1")):
        return
    items = math.prod(struct.unpack(f"{order}{len(elements[0][1]) // 4}i", elements[0][1]))
    parts = [data for type_, data in elements if type_ == MATRIX]
    known = all(type_ in (MATRIX, *DATA) for type_, _ in elements)
    fits = known and kind in classes and 0 <= items <= len(content)
    if kind in PLAIN:
        fits &= not parts and len(elements) == 3 + (flags >> 11 & 1)
    elif fits:
        fields = 1 if kind == CELLS else len(elements[3][1]) // struct.unpack_from(f"{order}i", elements[2][1])[0]
        fits &= len(parts) == items * fields == len(elements) - (2 if kind == CELLS else 4)
    if not fits:
        raise ValueError("an array of others than texts and numbers, or of another size than stated")
    for part in parts:
        _check_array(part, order, PLAIN)
