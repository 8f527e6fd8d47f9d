"""Check MATLAB files of version 5 to 7 before scipy reads them, which follows what they state about nesting and sizes."""

import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from ftl_lightning.services.files import MOST_HEADER, check_unpacked

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
