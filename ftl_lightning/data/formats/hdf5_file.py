"""Open HDF5 files of strangers. Needs ``h5py``: import this module only after the check of the extra."""

from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import MOST_HEADER, MOST_UNPACKED, check_readable, check_unpacked, raised
from ftl_lightning.services.validation import DEEPEST

MOST_OBJECTS = 2_000_000
"""Maximum number of groups and arrays in a file; scaled by :func:`~ftl_lightning.services.files.raised`."""


@contextmanager
def opened(path: Path, most: int = MOST_OBJECTS) -> Iterator[h5py.File]:
    """Open a file of at most ``most`` groups and arrays whose content lies in the file itself, each object under a single name.

    Raises:
        OSError, RuntimeError, ValueError: of h5py, for a damaged file.
        UserError: naming the file, if it is missing, much larger when unpacked, too deep or of too many objects; naming the object,
            for soft and external links, a second name, which may close a circle, external storage and virtual data sets.
    """
    packed = check_readable(path, "HDF5")
    with h5py.File(path, "r") as file:
        check_unpacked(_checked_size(file, most), packed, "arrays")
        yield file


def _checked_size(file: h5py.File, most: int) -> int:
    """Unpacked bytes of all arrays; texts and arrays of variable length count as their references."""
    names: list[bytes] = []
    known = {h5py.h5o.get_info(file.id).addr}

    def fault(name: bytes, link: h5py.h5l.LinkInfo) -> str | None:
        if link.type != h5py.h5l.TYPE_HARD:
            return f"{_shown(name)}: expected data of this file, found a link to another place or file"
        if link.u in known:
            return f"{_shown(name)}: expected an object of a single name, found another name of an object that has one"
        if len(names) >= raised(most):
            return f"content: expected at most {raised(most)} groups and arrays, found more"
        if name.count(b"/") >= DEEPEST:  # HDF5 crashes at groups that are too deep
            return f"content: expected groups at most {DEEPEST} deep, found deeper ones"
        known.add(link.u)
        names.append(name)
        return None

    if message := file.id.links.visit(fault, info=True):  # an exception in the function would be lost
        raise UserError(message)
    size = 0
    for name in names:
        item = h5py.h5o.open(file.id, name)
        if isinstance(item, h5py.h5d.DatasetID):
            place, settings = _shown(name), item.get_create_plist()
            require(settings.get_layout() != h5py.h5d.VIRTUAL, place, "data of this file", "a virtual data set, of other files")
            require(not settings.get_external_count(), place, "data of this file", "external storage, in other files")
            if settings.get_layout() == h5py.h5d.CHUNKED:  # read as a whole, however small the array
                chunk, most = prod(settings.get_chunk()) * item.get_type().get_size(), raised(MOST_UNPACKED)
                require(chunk <= most, place, f"chunks of at most {most} bytes", str(chunk))
            size += item.get_space().get_simple_extent_npoints() * item.get_type().get_size()
    return size


def read_array(item: h5py.Dataset, packed: int) -> NDArray[Any]:
    """Read numbers, or texts as objects, from a file of ``packed`` bytes.

    Raises:
        UserError: naming the array, for texts of MATLAB or longer than :data:`~ftl_lightning.services.files.MOST_HEADER`.
    """
    require("MATLAB_class" not in item.attrs, short(item.name), "an array of another program", "one of MATLAB; save it with -v7")
    kind = h5py.check_string_dtype(item.dtype)
    if kind is None or kind.length is not None:
        return np.asarray(item[()])
    if item.shape == ():
        return np.array(item.asstr()[()])
    most, texts = raised(MOST_HEADER), list[str]()
    batch = max(1, 16 * most // packed)  # a text that is stored once may stand for many
    require(len(item.shape) == 1, short(item.name), "a list of texts", f"texts of shape {item.shape}")
    for start in range(0, len(item), batch):
        texts += item.asstr()[start : start + batch].tolist()
        size = sum(map(len, texts))
        require(size <= most, short(item.name), f"at most {most} characters", "more")
    return np.array(texts, dtype=object)


def _shown(name: bytes) -> str:
    return short(name.decode("utf-8", "replace"))
