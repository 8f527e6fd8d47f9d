"""File format of demonstrations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.data.formats.file_keys import KIND, OBSERVED, TEXTS
from ftl_lightning.data.formats.images import compressed, decompressed_images
from ftl_lightning.data.formats.npz import read_npz, write_npz
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.files import read_from
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.tensor_file import load_tensors, save_tensors
from ftl_lightning.services.validation import check_type

VERSION = 4
"""Version of the file format. Images are compressed (zlib) to 1-D uint8; the header has their shapes by key as ``compressed``."""


class Contents(TypedDict):
    """Content of a file, by the attributes of :class:`~ftl_lightning.data.container.Demonstrations`.

    Types are as annotated; shapes and values are validated by the container.
    """

    states: Tensor
    lengths: Tensor
    domain: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    concepts: tuple[str, ...]
    observed: Observed
    per_step: tuple[str, ...]
    scenes: Tensor | None
    provenance: Mapping[str, Any]


def write(path: str | Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write a safetensors file with a JSON header, or an ``.npz`` file, whole or not at all.

    Args:
        path: the file; the suffix ``.npz`` selects that format, which has no provenance.
        tensors: tensors by key; uint8 tensors are images and are compressed, see :data:`VERSION`.
        header: other attributes by key.

    Raises:
        UserError: if the file cannot be written.
    """
    if Path(path).suffix == ".npz":
        return write_npz(path, tensors, header)
    images = {key: values for key, values in tensors.items() if values.dtype == torch.uint8}
    shapes = {"compressed": {key: list(values.shape) for key, values in images.items()}} if images else {}
    stored = {**tensors, **{key: compressed(values) for key, values in images.items()}}
    save_tensors(path, KIND, stored, {**header, **shapes}, VERSION)


def read(path: str | Path) -> Contents:
    """Read a file of :func:`write`, an ``.npz`` file without objects, or a data set.

    Raises:
        UserError: naming the file, if it is missing, damaged, of another kind, or holds a value of another type.
    """
    kind, name = read_from(str(path))
    if kind == "lerobot":
        check_extra("lerobot", f"{path}: a LeRobot data set")
        from ftl_lightning.data.formats.lerobot import read_contents

        return read_contents(name)
    if kind == "minari":
        check_extra("minari", f"{path}: expected a file, found none; a Minari data set of this name")
        from ftl_lightning.data.formats.minari import read_contents as read_data_set

        return read_data_set(name)
    path = Path(path)
    tensors, header = read_npz(path) if path.suffix == ".npz" else load_tensors(path, KIND, VERSION)
    with about(path):
        if "states" not in tensors:
            names = short(", ".join(tensors)) or "nothing"
            raise UserError(f"key 'states': expected (demo, time, state), found only {names}")
        states = tensors["states"]
        demos, time, columns = states.shape if states.dim() == 3 else (0, 0, 0)
        texts = {key: _texts(key, header[key]) for key in TEXTS if key in header}
        per_step, scenes = texts.get("per_step", ()), tensors.get("scenes")
        if "compressed" in header and demos:
            tensors |= decompressed_images(tensors, header.get("compressed"), per_step)
        observed = {name.removeprefix(OBSERVED): values for name, values in tensors.items() if name.startswith(OBSERVED)}
        return {
            "states": states,
            "lengths": tensors.get("lengths", torch.full((demos,), time)),
            "domain": check_type(header.get("domain", ""), str, "domain"),
            "state_names": texts.get("state_names", tuple(map(str, range(columns)))),
            "state_units": texts.get("state_units", ("",) * columns),
            "concepts": texts.get("concepts", ("",) * demos),
            "observed": observed,
            "per_step": per_step,
            "scenes": scenes,
            "provenance": check_type(header.get("provenance", {}), Mapping[str, Any], "provenance"),
        }


def _texts(key: str, listed: object) -> tuple[str, ...]:
    if not isinstance(listed, list) or not all(isinstance(text, str) for text in listed):
        raise UserError(f"key {key!r}: expected a list of texts, found {shown(listed)}")
    return tuple(listed)
