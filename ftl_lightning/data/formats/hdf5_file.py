"""Open HDF5 files of strangers. Needs ``h5py``: import this module only after the check of the extra."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.files import check_readable, check_unpacked, raised

MOST_OBJECTS = 2_000_000
"""Maximum number of groups and arrays in a file; scaled by :func:`~ftl_lightning.services.files.raised`."""


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a file whose content lies in the file itself, each object under a single name.

    Raises:
        OSError, RuntimeError, ValueError: of h5py, for a damaged file.
        UserError: naming the file, if it is missing or much larger when unpacked; naming the object, for soft and external links, a
            second name, which may close a circle, external storage and virtual data sets.
    """
    packed = check_readable(path, "HDF5")
    with h5py.File(path, "r") as file:
        check_unpacked(_checked_size(file), packed, "arrays")
        yield file


def _checked_size(file: h5py.File) -> int:
    """Unpacked bytes of all arrays; texts and arrays of variable length count as their references."""
    names: list[bytes] = []
    known = {h5py.h5o.get_info(file.id).addr}

    def fault(name: bytes, link: h5py.h5l.LinkInfo) -> str | None:
        if link.type != h5py.h5l.TYPE_HARD:
            return f"{_shown(name)}: expected data of this file, found a link to another place or file"
        if link.u in known:
            return f"{_shown(name)}: expected an object of a single name, found another name of an object that has one"
        if len(names) >= raised(MOST_OBJECTS):
            return f"content: expected at most {raised(MOST_OBJECTS)} groups and arrays, found more"
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
            size += item.get_space().get_simple_extent_npoints() * item.get_type().get_size()
    return size


def _shown(name: bytes) -> str:
    return short(name.decode("utf-8", "replace"))
