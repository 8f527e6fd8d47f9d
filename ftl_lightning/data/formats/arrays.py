"""Arrays by name as demonstrations, and readers of other programs' files of arrays and tables.

The names are those of an ``.npz`` file, see :meth:`~ftl_lightning.data.demonstrations.Demonstrations.load`:

=====================  ==========================================================================================================
file                   content
=====================  ==========================================================================================================
``.npy``               states ``(demo, time, state)``
``.json``              an object of nested lists; states may be lists of different lengths
``.mat``               MATLAB variables up to version 7; version 7.3 is HDF5
``.h5``, ``.hdf5``     data sets, ``observed/NAME`` in a group; needs the extra ``hdf5``
``.pt``, ``.pth``      tensors by name, or states alone; read without unpickling objects
``.csv``               a table with a row for each time: ``demonstration``, ``concept``, optionally ``time``; all other columns of
                       numbers are the columns of a state
``.parquet``           the same; needs the extra ``lerobot``
=====================  ==========================================================================================================
"""

import difflib
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import FORMATS, OBSERVED, Contents, Demonstrations, Format, padded
from ftl_lightning.data.features import check_single, precise
from ftl_lightning.data.formats.files import DAMAGED, TEXTS, check_arrays, contents_of, write_npz
from ftl_lightning.services.errors import UserError, about, note, require, short
from ftl_lightning.services.files import check_readable, check_unpacked
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.validation import read_json

Arrays = dict[str, NDArray[Any]]
NUMBERS = ("states", "lengths", "scenes")
"""Keys of arrays of numbers, besides observed features."""
EPISODE, TIME, CONCEPT = (
    ("demonstration", "demo", "episode", "episode_index"),
    ("time", "step", "frame_index", "timestamp"),
    ("concept", "task"),
)
"""Names of the columns of a table that are no columns of a state."""
CHANNELS, LEAST_SIDE = (1, 3, 4), 8
"""Numbers of channels of an image, and minimum side for numbers to be an image."""


def contents_of_arrays(arrays: Mapping[str, NDArray[Any]], place: str) -> Contents:
    """Attributes of demonstrations from arrays by name; what is not read or is converted is noted.

    Args:
        arrays: see this module.
        place: file, for messages.

    Raises:
        UserError: for an array of another type than its key requires.
    """
    tensors: dict[str, torch.Tensor] = {}
    header: dict[str, Any] = {}
    states = np.atleast_1d(arrays.get("states", np.zeros(0)))
    for key, array in arrays.items():
        found = f"one of {short(str(array.dtype))}"
        if key.startswith(OBSERVED) or key in NUMBERS:
            require(array.dtype.kind in "fiub", f"key {short(key)!r}", "an array of numbers", found)
            per_step = key.removeprefix(OBSERVED) in _texts(arrays.get("per_step"))
            values = _image(place, key, array, 2 if per_step else 1) if key.startswith(OBSERVED) else array
            tensors[key] = tensor_of(key, values, arrays.get("lengths"))
        elif key in (*TEXTS, "domain"):
            texts = _texts(array)
            require(texts or not array.size, f"key {key!r}", "an array of texts", found)
            repeated = len(states) if key == "concepts" and not array.ndim else 1
            header[key] = texts[0] if key == "domain" and len(texts) == 1 else texts * repeated
        else:
            note(f"{place}: array {short(key)!r} is not read; {_nearest(key)}")
    return contents_of(tensors, header)


def tensor_of(key: str, array: NDArray[Any], lengths: NDArray[Any] | None = None) -> torch.Tensor:
    """Convert an array: images stay uint8, whole lengths int64, states float64 where float32 loses steps; others float32."""
    if key == "states":
        each = None if lengths is None else np.ravel(lengths).tolist()
        return torch.from_numpy(np.array(precise(array, each), order="C", ndmin=array.ndim))
    if key.startswith(OBSERVED):
        check_single(key, array)
    image = array.dtype == np.uint8 and key.startswith(OBSERVED)
    kind = np.uint8 if image else np.int64 if key == "lengths" and array.dtype.kind in "iu" else np.float32
    with np.errstate(over="ignore"):  # overflow is reported later as a number that is not finite
        return torch.from_numpy(np.array(array, dtype=kind, order="C", ndmin=array.ndim))


def _texts(array: NDArray[Any] | None) -> list[Any]:
    """Texts of an array of texts, or of bytes in UTF-8; empty for other arrays."""
    if array is None or array.dtype.kind not in "US":
        return []
    texts: list[Any] = np.atleast_1d(array if array.dtype.kind == "U" else np.char.decode(array, "utf-8")).tolist()
    return texts


def _nearest(key: str) -> str:
    """Advice about a name that is not read."""
    plain = key.strip().lower().replace("\\", "/")
    for prefix in ("observed/", "observed_", "observed.", "observation/", "observation_", "observation.", "obs/", "obs_", "obs."):
        if plain.startswith(prefix) and len(plain) > len(prefix):
            return f"an observed feature is named {OBSERVED + plain.removeprefix(prefix)!r}"
    near = difflib.get_close_matches(plain, (*NUMBERS, *TEXTS, "domain"), n=1, cutoff=0.6)
    return f"the nearest known name is {near[0]!r}" if near else f"known are {', '.join((*NUMBERS, *TEXTS))} and {OBSERVED}NAME"


def _image(place: str, key: str, array: NDArray[Any], leading: int) -> NDArray[Any]:
    """Images as uint8 with their channels first, from shares or bytes with channels first or last; other features unchanged."""
    shape = array.shape[leading:]
    if len(shape) != 3:
        return array
    first, last = shape[0] in CHANNELS and min(shape[1:]) >= LEAST_SIDE, shape[2] in CHANNELS and min(shape[:2]) >= LEAST_SIDE
    if not first and not last:
        return array
    changes = []
    if array.dtype != np.uint8:
        if array.dtype.kind == "f" and array.size and array.min() >= 0 and array.max() <= 1:
            array = np.round(array * 255).astype(np.uint8)
            changes.append("shares in [0, 1] to bytes")
        elif array.size and array.min() >= 0 and array.max() <= 255 and bool((array == np.round(array)).all()):
            array = array.astype(np.uint8)
            changes.append("numbers in [0, 255] to bytes")
        else:
            return array
    if last and not first:
        array = np.moveaxis(array, -1, leading)
        changes.append("channels from the last axis to the first")
    if changes:
        note(f"{place}: {short(key)!r} is read as images: {' and '.join(changes)}")
    return array


def _read(name: str, kind: str, load: Callable[[Path, int], Arrays]) -> Contents:
    """Contents of a file that a function loads as arrays.

    Raises:
        UserError: naming the file, if it is missing, damaged, or not as described.
    """
    path = Path(name)
    size = check_readable(path, "demonstrations")
    try:
        with about(path):
            arrays = load(path, size)
    except (*DAMAGED, ImportError) as error:
        message = f"a damaged or foreign file, or objects ({short(str(error), 100)})"
        raise UserError(f"{path}: expected {kind}, found {message}") from error
    with about(path):
        return contents_of_arrays(arrays, name)


def _npz(path: Path, size: int) -> Arrays:
    check_arrays(path, size)
    with np.load(path, allow_pickle=False) as archive:
        arrays = {key: np.asarray(archive[key]) for key in archive.files}
    "".join(text for array in arrays.values() if array.dtype.kind == "U" for text in np.ravel(array)).encode()
    return arrays


def _npy(path: Path, size: int) -> Arrays:
    return {"states": np.load(path, allow_pickle=False)}


def _json(path: Path, size: int) -> Arrays:
    content = read_json(path)
    content = {"states": content} if isinstance(content, list) else content
    require(isinstance(content, dict), "content", "an object of arrays by name", type(content).__name__)
    arrays: Arrays = {}
    ragged = content.get("states")
    if isinstance(ragged, list) and len({len(part) for part in ragged if isinstance(part, list)}) > 1:
        states, lengths = padded([torch.from_numpy(np.asarray(part, dtype=np.float64)) for part in ragged])
        content = {**content, "states": states.numpy(), "lengths": lengths.numpy()}
    for key, value in content.items():
        if isinstance(value, dict) and key == OBSERVED.strip("/"):
            arrays |= {OBSERVED + name: np.asarray(part) for name, part in value.items()}
        else:
            arrays[key] = np.asarray(value)
    return arrays


def _mat(path: Path, size: int) -> Arrays:
    from scipy.io import loadmat, whosmat

    stated = sum(8 * math.prod(shape) for _, shape, _ in whosmat(path))
    check_unpacked(stated, size, "arrays")
    content = {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
    texts = {key: np.asarray(_of_matlab(value)) if key in (*TEXTS, "domain") else value for key, value in content.items()}
    return {key: value.reshape(-1) if key == "lengths" else value for key, value in texts.items()}


def _of_matlab(value: NDArray[Any]) -> list[str]:
    """Texts of a cell array, or of a matrix of characters."""
    return [str(np.ravel(part)[0]) if isinstance(part, np.ndarray) else str(part).strip() for part in np.ravel(value)]


def _hdf5(path: Path, size: int) -> Arrays:
    check_extra("hdf5", f"{path}: an HDF5 file")
    from h5py import Dataset

    from ftl_lightning.data.formats.hdf5_file import opened

    arrays: Arrays = {}

    def add(name: str, item: Any) -> None:
        if isinstance(item, Dataset):
            array = np.asarray(item.asstr()[()] if item.dtype.kind == "O" else item[()])
            arrays[name] = array.astype(np.str_) if array.dtype.kind == "O" else array

    with opened(path) as file:
        file.visititems(add)
    return arrays


def _torch(path: Path, size: int) -> Arrays:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        raise UserError("expected plain tensors and texts, found other objects, which are never read") from error
    content = {"states": content} if isinstance(content, torch.Tensor) else content
    require(isinstance(content, dict), "content", "tensors by name", type(content).__name__)
    return {str(key): value.numpy() if isinstance(value, torch.Tensor) else np.asarray(value) for key, value in content.items()}


def _csv(path: Path, size: int) -> Arrays:
    import pandas as pd

    return _of_table(pd.read_csv(path), path)


def _parquet(path: Path, size: int) -> Arrays:
    check_extra("lerobot", f"{path}: a Parquet file")
    from ftl_lightning.data.formats.parquet import read_table

    return _of_table(read_table(path), path)


def _of_table(table: Any, path: Path) -> Arrays:
    """Arrays of a table (pandas) with a row for each time of each demonstration."""
    columns = {str(name).strip().lower(): name for name in table.columns}
    episode, time, concept = (
        next((columns[name] for name in names if name in columns), None) for names in (EPISODE, TIME, CONCEPT)
    )
    for name in [name for name in table.columns if str(name).startswith("Unnamed:")]:
        note(f"{path}: column {short(str(name))!r} without a name is not read")
        table = table.drop(columns=name)
    if episode is not None:
        whole = not bool(table[episode].isna().any())
        require(whole, f"column {episode!r}", "the demonstration of every row", "empty cells; fill them down")
    if time is not None and episode is not None and bool(table.duplicated([episode, time]).any()):
        note(f"{path}: several rows of a demonstration have the same {time!r}")
    if episode is None:
        note(f"{path}: no column {EPISODE[0]!r}, so all rows are a single demonstration")
    numeric = [name for name in table.columns if name not in (episode, time, concept) and table[name].dtype.kind in "fiub"]
    require(numeric, "columns", "columns of numbers, the columns of a state", short(", ".join(map(str, columns))))
    for name in table.columns:
        if name not in (episode, time, concept, *numeric):
            note(f"{path}: column {short(str(name))!r} is not read, as it holds no numbers")
    if time is not None:
        table = table.sort_values(time, kind="stable")
    numbered = episode is not None and table[episode].dtype.kind in "iuf"
    groups = [] if episode is None else [part for _, part in table.groupby(episode, sort=numbered)]
    parts = groups if numbered else sorted(groups or [table], key=lambda part: part.index.min())
    texts = ["" if concept is None else _only(part[concept], path) for part in parts]
    states, lengths = padded([torch.from_numpy(part[numeric].to_numpy(dtype=np.float64, copy=True)) for part in parts])
    arrays = {"states": states.numpy(), "lengths": lengths.numpy(), "state_names": np.array([str(name) for name in numeric])}
    return arrays | ({} if concept is None else {"concepts": np.array(texts)})


def _only(texts: Any, path: Path) -> str:
    """The text of a demonstration's rows."""
    different = [str(text) for text in texts.unique()]
    require(len(different) == 1, "column of concepts", "a text for each demonstration", short(", ".join(different)))
    return different[0]


def _not_written(demonstrations: Demonstrations, name: str) -> None:
    raise UserError(f"{name}: expected the name of an .npz or .safetensors file, found a format that is only read")


FORMATS |= {
    ".npz": Format(partial(_read, kind="an .npz of plain arrays", load=_npz), write_npz),
    ".npy": Format(partial(_read, kind="an array of NumPy", load=_npy), _not_written),
    ".json": Format(partial(_read, kind="arrays in JSON", load=_json), _not_written),
    ".mat": Format(partial(_read, kind="variables of MATLAB up to version 7", load=_mat), _not_written),
    ".csv": Format(partial(_read, kind="a table", load=_csv), _not_written),
    ".parquet": Format(partial(_read, kind="a Parquet table", load=_parquet), _not_written),
    **dict.fromkeys((".h5", ".hdf5"), Format(partial(_read, kind="an HDF5 file", load=_hdf5), _not_written)),
    **dict.fromkeys((".pt", ".pth"), Format(partial(_read, kind="tensors of torch", load=_torch), _not_written)),
}
