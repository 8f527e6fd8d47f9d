"""Arrays by name as demonstrations, and readers of other programs' files of arrays and tables.

The names are those of an ``.npz`` file, see :meth:`~ftl_lightning.data.demonstrations.Demonstrations.load`:

=====================  ==========================================================================================================
file                   content
=====================  ==========================================================================================================
``.npy``               states ``(demo, time, state)``
``.json``              an object of nested lists, ``observed`` may be an object; states may be lists of different lengths
``.mat``               MATLAB variables up to version 7, ``observed`` as a struct; states may be a cell array
``.h5``, ``.hdf5``     data sets, ``observed/NAME`` in a group; needs the extra ``hdf5``
``.pt``, ``.pth``      tensors by name, or states alone, or a list of states; read without unpickling objects
``.csv``               a table with a row for each time: ``demonstration``, ``concept``, optionally ``time``; columns of numbers
                       whose names begin with ``action`` are actions, all others are the columns of a state
``.parquet``           the same; needs the extra ``lerobot``
=====================  ==========================================================================================================
"""

import difflib
import math
import re
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ftl_lightning.data.actions import action_columns, held_actions
from ftl_lightning.data.demonstrations import FORMATS, OBSERVED, Contents, Format, gathered, stacked
from ftl_lightning.data.features import check_single, check_whole, precise
from ftl_lightning.data.formats.files import (
    DAMAGED,
    MOST_ARRAYS,
    TEXTS,
    check_array,
    check_arrays,
    check_matlab,
    contents_of,
    write_npz,
)
from ftl_lightning.services.errors import UserError, about, note, require, short
from ftl_lightning.services.files import MOST_HEADER, MOST_TENSORS, check_readable, check_unpacked, raised
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.validation import MOST_LISTS, MOST_VALUES, read_json

if TYPE_CHECKING:
    import pandas as pd

Arrays = dict[str, NDArray[Any]]
ACTIONS = "actions"
"""Key of actions ``(demo, time, action)``, or ``(demo, time - 1, action)``."""
NUMBERS = ("states", "lengths", "scenes", ACTIONS)
"""Keys of arrays of numbers, besides observed features."""
EPISODE, CONCEPT = ("demonstration", "demo", "episode", "episode_index"), ("concept", "task")
TIME = ("time", "step", "frame_index", "timestamp", "t")
ROLES = (*EPISODE, *TIME, *CONCEPT)
"""Names of the columns of a table that are no columns of a state."""
INDEX = ("unnamed:", "__index_level_")
"""Prefixes of columns that pandas adds for the number of a row."""
UNREAD = np.zeros(0)
"""In place of an array whose name is unknown."""
MOST_NOTES = 5
"""Maximum number of arrays or columns that are noted by name."""
MOST_COLUMNS = 2000
"""Maximum number of columns of a table."""
MOST_TEXTS = 100_000
"""Maximum number of texts of a table in which numbers are looked for."""
CELL = 1000
"""Bytes of a cell of MATLAB in memory."""
_LABELS = re.compile(r"(per_step|observed|observations?|obs)([/_.].*)?[/_.](names|units|kinds)([/_.].*)?", re.IGNORECASE)
"""Keys of names and units of observed features."""
CHANNELS, LEAST_SIDE = (1, 3, 4), 8
"""Numbers of channels of an image, and minimum side for numbers to be an image."""


def contents_of_arrays(arrays: Mapping[str, NDArray[Any]], place: str) -> Contents:
    """Attributes of demonstrations from arrays by name; what is not read or is converted is noted.

    Args:
        arrays: see this module. Arrays of objects are texts, or states and features at every time of different lengths.
        place: file, for messages.

    Raises:
        UserError: for an array of another type than its key requires.
    """
    require("states" in arrays, "key 'states'", "(demo, time, state)", f"only {short(', '.join(arrays), 120) or 'nothing'}")
    tensors: dict[str, torch.Tensor] = {}
    header: dict[str, Any] = {}
    per_step = [OBSERVED + name for name in _texts("per_step", arrays.get("per_step"))]
    arrays = {**arrays}
    for key, array in arrays.items():
        labels = _LABELS.fullmatch(key) and (not _is_numeric(key) or array.dtype.kind in "USO")
        found = "names or units, which are not compared; give the columns in the model's order and units, and leave this array out"
        require(not labels, f"key {short(key)!r}", "no names and units of observed features", found)
    for key in ("states", ACTIONS, *per_step):
        if key in arrays and arrays[key].dtype.kind == "O":
            with about(f"key {short(key)!r}"):
                try:
                    whole, lengths = stacked([array_of(part) for part in np.atleast_1d(arrays[key])[: MOST_TENSORS + 1]])
                except UserError:
                    _check_null(arrays[key], timed=True)
                    raise
            given = arrays.setdefault("lengths", lengths.numpy())
            if key == ACTIONS and np.array_equal(given, lengths + 1):
                lengths = lengths + 1  # the last state has no action
            require(np.array_equal(given, lengths), "key 'lengths'", f"the lengths of {short(key)!r}", "others")
            arrays[key] = whole.numpy()
    states = np.atleast_1d(arrays["states"])
    for key, array in arrays.items():
        kind = short(str(array.dtype)) if array.dtype.kind != "O" else "other values, or lists of different lengths"
        if _is_numeric(key):
            if array.dtype.kind == "O":
                with about(f"key {short(key)!r}"):
                    _check_null(array, timed=False)
            require(array.dtype.kind in "fiub", f"key {short(key)!r}", "an array of numbers", f"one of {kind}")
            feature = key.startswith(OBSERVED)
            values = _image(place, key, array, 2 if key in per_step else 1) if feature else array
            tensors[key] = tensor_of(key, values, arrays.get("lengths"))
        elif _is_known(key):
            texts = _texts(key, array)
            require(texts or not array.size, f"key {key!r}", "an array of texts", f"one of {kind}")
            repeated = len(states) if key == "concepts" and not array.ndim else 1
            header[key] = texts[0] if key == "domain" and len(texts) == 1 else texts * repeated
    contents = contents_of(tensors, header)
    if contents["actions"] is not None:
        contents["actions"] = held_actions(contents["actions"], contents["lengths"], states.shape[1] if states.ndim > 1 else 0)
    _note_unread(place, {f"array {short(key)!r} is not read; {_nearest(key)}" for key in arrays if not _is_known(key)})
    return contents


def tensor_of(key: str, array: NDArray[Any], lengths: NDArray[Any] | None = None) -> torch.Tensor:
    """Convert an array: images stay uint8, whole lengths int64, states float64 where float32 loses steps; others float32."""
    if key == "states":
        each: list[Any] | None = None
        if lengths is not None and lengths.dtype.kind in "fiu" and bool(np.isfinite(lengths).all()):
            each = np.ravel(lengths).tolist()
        parts = zip(array, each, strict=False) if each and array.ndim else [(array, None)]
        for part, length in parts if array.dtype.kind in "iu" else ():  # padding may be any number
            check_whole("key 'states'", part[: None if length is None else int(length)])
        return torch.from_numpy(np.array(precise(array, each), order="C", ndmin=array.ndim))
    if key.startswith(OBSERVED):
        check_whole(f"key {short(key)!r}", array)
        check_single(key, array)
    image = array.dtype == np.uint8 and key.startswith(OBSERVED)
    whole = key == "lengths" and (array.dtype.kind in "iu" or (array.dtype.kind == "f" and bool((array == np.round(array)).all())))
    kind = np.uint8 if image else np.int64 if whole else np.float32
    with np.errstate(over="ignore"):  # overflow is reported later as a number that is not finite
        return torch.from_numpy(np.array(array, dtype=kind, order="C", ndmin=array.ndim))


def _check_null(array: NDArray[Any], timed: bool) -> None:
    """Refuse an array of objects with a missing value, such as ``null`` in JSON; ``UserError`` with its place."""
    if (index := _null(np.atleast_1d(array))) is not None:
        words = ("demonstration {}", " at time {}", ", column {}") if timed else ()
        numbers = (index[0] + 1, *index[1:]) if index else ()
        place = "".join(map(str.format, words, numbers)) or f"index {list(index)}"
        raise UserError(f"expected numbers, found none (null) in {place}; fill it or leave its time out")


def _null(value: Any) -> tuple[int, ...] | None:
    """Index of the first missing value in nested lists."""
    if isinstance(value, np.ndarray):
        return _null(value.tolist()) if value.dtype.kind == "O" else None
    if isinstance(value, list):
        return next(((index, *found) for index, part in enumerate(value) if (found := _null(part)) is not None), None)
    return () if value is None else None


def _is_numeric(key: str) -> bool:
    return key in NUMBERS or (key.startswith(OBSERVED) and key != OBSERVED)


def _is_known(key: str) -> bool:
    return _is_numeric(key) or key in (*TEXTS, "domain")


def _note_unread(place: str, notes: Collection[str]) -> None:
    """Note what is not read: a line for each of the first :data:`MOST_NOTES`, and a line for the number of others."""
    for text in sorted(notes)[:MOST_NOTES]:
        note(f"{place}: {text}")
    if len(notes) > MOST_NOTES:
        note(f"{place}: {len(notes) - MOST_NOTES} more are not read")


def array_of(value: Any) -> NDArray[Any]:
    """Numbers of nested lists; objects for texts, other values, and lists or tensors of different lengths.

    Texts remain objects: an array of texts takes the length of the longest for each.
    """
    if isinstance(value, torch.Tensor):
        return value.detach().to(torch.float32 if value.dtype == torch.bfloat16 else value.dtype).numpy()
    if isinstance(value, np.ndarray) and value.dtype.kind != "O":
        return value
    if isinstance(value, list | tuple) and any(isinstance(part, torch.Tensor) for part in value):
        parts = [array_of(part) for part in value]
        objects = np.empty(len(parts), dtype=object)
        for index, part in enumerate(parts):
            objects[index] = part
        return objects if len({part.shape for part in parts}) > 1 else np.stack(parts)
    objects = np.array(value, dtype=object)
    kinds = set(map(type, objects.ravel()))
    try:
        return objects.astype(np.float64 if float in kinds else np.int64) if kinds <= {int, float, bool} else objects
    except OverflowError:
        return objects


def _by_name(content: Any) -> Arrays:
    """Arrays of nested lists or tensors by name, with those of a mapping ``observed``, or of states alone."""
    content = {"states": content} if isinstance(content, list | tuple | torch.Tensor) else content
    require(isinstance(content, dict), "content", "arrays by name", type(content).__name__)
    content = {str(key): value for key, value in content.items()}
    if isinstance(content.get("observed"), dict):
        content |= {f"{OBSERVED}{name}": value for name, value in content.pop("observed").items()}
    return {key: array_of(value) if _is_known(key) else UNREAD for key, value in content.items()}


def _texts(key: str, array: NDArray[Any] | None) -> list[str]:
    """Texts of an array of texts, or of bytes in UTF-8; empty for other arrays."""
    if array is None or array.dtype.kind not in "USO":
        return []
    most, size = raised(MOST_HEADER), 0
    require(array.size <= most, f"key {key!r}", f"at most {most} texts", str(array.size))
    flat = np.atleast_1d(array).ravel().tolist()
    if not all(isinstance(part, str | bytes) for part in flat):
        return []
    for part in flat:
        size += len(part)
        require(size <= most, f"key {key!r}", f"at most {most} characters", "more; give each concept a short text")
    try:
        texts = [part.decode() if isinstance(part, bytes) else part for part in flat]
        "".join(texts).encode()
    except UnicodeError as error:
        raise UserError(f"key {key!r}: expected texts in UTF-8, found others ({short(ascii(str(error)))})") from error
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
    except (*DAMAGED, ArithmeticError, AssertionError, ImportError) as error:
        if "Object arrays" in str(error):
            advice = "pad recordings to one length, and give 'lengths'"
            raise UserError(f"{path}: expected {kind}, found Python objects; {advice}") from error
        raise UserError(f"{path}: expected {kind}, found a damaged or foreign file ({short(str(error), 100)})") from error
    with about(path):
        return contents_of_arrays(arrays, name)


def _npz(path: Path, size: int) -> Arrays:
    check_arrays(path, size)
    with np.load(path, allow_pickle=False) as archive:
        return {key: np.asarray(archive[key]) if _is_known(key) else UNREAD for key in archive.files}


def _npy(path: Path, size: int) -> Arrays:
    with path.open("rb") as file:
        check_array(path.name, file, size)
        file.seek(0)
        return {"states": np.lib.format.read_array(file, allow_pickle=False)}


def _json(path: Path, size: int) -> Arrays:
    return _by_name(read_json(path))


def _mat(path: Path, size: int) -> Arrays:
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError, matfile_version

    try:
        version = matfile_version(path)[0]
    except MatReadError as error:
        raise ValueError(str(error)) from error
    require(version < 2, "version", "MATLAB up to version 7", "7.3; save it with save('FILE', ..., '-v7')")
    if version:
        check_matlab(path, size, lambda name: _is_known(name) or name == "observed")
    variables = whosmat(path)
    sizes = (math.prod(shape) * (CELL if kind in ("cell", "struct") else 8) for _, shape, kind in variables)
    check_unpacked(sum(sizes), size, "variables")
    known = [name for name, _, _ in variables if _is_known(name) or name == "observed"]
    content = loadmat(path, variable_names=known) if known else {}
    arrays: Arrays = {name: content[name] if _is_known(name) else UNREAD for name, _, _ in variables}
    for name, array in content.items():
        require(name.startswith("__") or isinstance(array, np.ndarray), f"key {short(name)!r}", "an array", "a sparse matrix")
    record = content.get("observed", UNREAD)
    if record.dtype.names and record.size == 1:
        del arrays["observed"]
        arrays |= {f"{OBSERVED}{name}": record[name].item() for name in record.dtype.names}
    for name, array in arrays.items():
        if name in (*TEXTS, "domain"):
            arrays[name] = np.array([_of_matlab(part) for part in np.ravel(array)], dtype=object)
        elif name == "lengths" or array.dtype.kind == "O":
            arrays[name] = array.reshape(-1)
    return arrays


def _of_matlab(value: Any) -> Any:
    """Text of a cell, or of a row of characters."""
    value = np.ravel(value)[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return "" if isinstance(value, np.ndarray) and not value.size else value.strip() if isinstance(value, str) else value


def _hdf5(path: Path, size: int) -> Arrays:
    check_extra("hdf5", f"{path}: an HDF5 file")
    from h5py import Dataset

    from ftl_lightning.data.formats.hdf5_file import opened, read_array

    names: list[str] = []
    with opened(path, MOST_ARRAYS) as file:
        file.visit(names.append)
        items = {name: file[name] for name in names}
        return {
            name: read_array(item, size) if _is_known(name) else UNREAD for name, item in items.items() if isinstance(item, Dataset)
        }


def _torch(path: Path, size: int) -> Arrays:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        require(sum(member.file_size for member in members) <= size, "content", "no compression, as torch.save writes", "some")
        damaged = archive.testzip()  # torch does not verify checksums
    require(damaged is None, short(str(damaged)), "its checksum", "another; the file is damaged")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        raise UserError("expected tensors, numbers and texts, found other objects, which are never read; save tensors") from error
    _check_listed(content)
    check_unpacked(sum(tensor.numel() * tensor.element_size() for tensor in _tensors(content)), size, "tensors")
    return _by_name(content)


def _check_listed(content: Any) -> None:
    """Refuse more mappings, lists and values than a JSON text may hold; a list that is stored once may stand for many."""
    lists, values, rest = 0, 0, [content] if isinstance(content, dict | list | tuple) else []
    while rest:
        part = rest.pop()
        lists, values = lists + 1, values + len(part)
        require(lists <= MOST_LISTS, "content", f"at most {MOST_LISTS} lists and mappings", "more")
        require(values <= MOST_VALUES, "content", f"at most {MOST_VALUES} values", "more")
        rest += [value for value in (part.values() if isinstance(part, dict) else part) if isinstance(value, dict | list | tuple)]


def _tensors(content: Any) -> Iterator[torch.Tensor]:
    """Tensors of mappings and lists."""
    if isinstance(content, torch.Tensor):
        yield content
    elif isinstance(content, dict | list | tuple):
        for part in content.values() if isinstance(content, dict) else content:
            yield from _tensors(part)


def _csv(path: Path, size: int) -> Arrays:
    import pandas as pd

    with path.open("rb") as file:
        names = file.readline(MOST_HEADER)
        other = next((mark for mark in (";", "\t") if mark.encode() in names and b"," not in names), None)
        found = f"{other!r}; convert it in Python: pandas.read_csv(FILE, sep={other!r}).to_csv(NEW, index=False)"
        require(other is None, "line 1", "commas between names", found)
        file.seek(0)
        most = 0
        for line in iter(partial(file.readline, MOST_HEADER), b""):
            require(len(line) < MOST_HEADER, "lines", f"less than {MOST_HEADER} bytes in each", "more")
            most = max(most, line.count(b","))
    require(most < MOST_COLUMNS, "columns", f"at most {MOST_COLUMNS}", str(most + 1))
    table = pd.read_csv(path.absolute(), compression=None, low_memory=False)
    require(
        isinstance(table.index, pd.RangeIndex), "line 2", f"{len(table.columns)} values between commas, as many as names", "more"
    )
    number = next((name for name in table.columns if not name.isdigit() and _is_number(name)), None)
    require(number is None, "line 1", "names of columns", f"the number {short(str(number))}; add a line of names")
    return _of_table(table, path)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _parquet(path: Path, size: int) -> Arrays:
    check_extra("lerobot", f"{path}: a Parquet file")
    from ftl_lightning.data.formats.parquet import read_table

    table, others = read_table(path, ROLES)
    arrays = _of_table(table, path)
    _note_unread(str(path), {f"column {short(name)!r} is not read, as it holds no numbers" for name in others})
    return arrays


def _of_table(table: "pd.DataFrame", path: Path) -> Arrays:
    """Arrays of a table with a row for each time of each demonstration."""
    import pandas as pd

    require(len(table.columns) <= MOST_COLUMNS, "columns", f"at most {MOST_COLUMNS}", str(len(table.columns)))
    if len(table.columns) > 1 and (empty := int(table.isna().all(axis=1).sum())):
        note(f"{path}: {empty} empty rows are left out")
        table = table.dropna(how="all")
    require(len(table) or not len(table.columns), "rows", "one for each time", "none")
    rows = table.index.to_numpy() + 1
    columns = {str(name).strip().lower(): name for name in reversed(table.columns)}
    episode, time, concept = (
        next((columns[name] for name in names if name in columns), None) for names in (EPISODE, TIME, CONCEPT)
    )
    numeric, notes, dtypes = [], set(), dict(table.dtypes)
    look = MOST_TEXTS // max(sum(dtype.kind == "O" for dtype in dtypes.values()), 1) + 1
    for name in table.columns:
        plain = str(name).strip().lower()
        if name in (episode, time, concept):
            continue
        if plain in ROLES or plain.startswith(INDEX) or plain in ("", "index"):
            notes.add(f"column {short(str(name))!r} is not read, as an index has this name; rename it if it is of a state")
        elif dtypes[name].kind in "fiub":
            numeric.append(name)
        else:
            _check_texts(table[name], rows, look)
            notes.add(f"column {short(str(name))!r} is not read, as it holds no numbers")
    require(numeric, "columns", "columns of numbers, the columns of a state", short(", ".join(map(str, columns))))
    for name in numeric:
        check_whole(f"column {short(str(name))!r}", table[name].to_numpy())
    numbers = table[numeric].to_numpy(dtype=np.float64)
    table = table[[name for name in table.columns if name in (episode, time, concept)]]
    for row, column in np.argwhere(~np.isfinite(numbers))[:1]:
        place = f"column {short(str(numeric[column]))!r}"
        raise UserError(f"{place}: expected finite numbers, found {numbers[row, column]} in row {rows[row]}")
    codes: NDArray[Any] = np.zeros(len(table), dtype=np.int64)
    times: NDArray[Any] = np.arange(len(table))
    if episode is None:
        note(f"{path}: no column {EPISODE[0]!r}, so all rows are a single demonstration")
    else:
        codes = pd.factorize(table[episode], sort=table[episode].dtype.kind in "iuf")[0]
        require(codes.min() >= 0, f"column {episode!r}", "a value in each row", f"none in row {rows[codes.argmin()]}")
    if time is None:
        note(f"{path}: no column {TIME[0]!r}, so the rows of a demonstration are in order")
    else:
        stamps = table[time] if table[time].dtype.kind in "iufM" else pd.to_datetime(table[time], format="ISO8601")
        require(
            stamps.notna().all(),
            f"column {time!r}",
            "a value in each row",
            f"none in row {rows[stamps.isna().to_numpy().argmax()]}",
        )
        times = stamps.to_numpy()
    order = np.lexsort((times, codes))
    twice = (np.diff(codes[order]) == 0) & (times[order][1:] == times[order][:-1])
    found = f"two rows of {times[order][1:][twice.argmax()]}" if twice.any() else ""
    require(not found, f"column {time!r}", "another time in each row of a demonstration", f"{found}; is {EPISODE[0]!r} missing?")
    lengths = np.bincount(codes)
    firsts = order[np.cumsum(lengths) - lengths]
    if (np.diff(order) < 0).any():
        numbers = numbers[order]
    names = tuple(map(str, numeric))
    acts = action_columns(names)
    require(len(acts) < len(names), "columns", "columns of a state beside those of actions", short(", ".join(names)))
    arrays: Arrays = {"lengths": lengths}
    for key, chosen in (("state", [c for c in range(len(names)) if c not in acts]), ("action", list(acts))):
        if chosen:
            arrays[f"{key}s"] = gathered(numbers[:, chosen], lengths)
            arrays[f"{key}_names"] = np.array([names[column] for column in chosen], dtype=object)
    if concept is not None:
        kinds, different = pd.factorize(table[concept])
        texts = [*map(str, different), ""]  # the last for -1, a missing one
        other = kinds != kinds[firsts][codes]
        row = rows[other.argmax()]
        require(not other.any(), f"column {concept!r}", "a single text for each demonstration", f"another in row {row}")
        arrays["concepts"] = np.array([texts[kind] for kind in kinds[firsts]], dtype=object)
    _note_unread(str(path), notes)
    return arrays


def _check_texts(column: "pd.Series", rows: NDArray[Any], look: int) -> None:
    """Refuse a column of numbers and texts, or of numbers with commas; ``UserError`` with its name and the first such row.

    Args:
        column: texts, or values of several types.
        rows: number of each row, for messages.
        look: number of values to examine.
    """
    place, first = f"column {short(str(column.name))!r}", [str(value) for value in column.dropna().iloc[:look]]
    if any(map(_is_number, first)):
        row = next((row for row, value in enumerate(column) if not _is_number(str(value))), 0)
        raise UserError(f"{place}: expected numbers, found {short(str(column.iloc[row]))!r} in row {rows[row]}")
    if first and all(_is_number(text.replace(",", "")) for text in first):
        found = f"{short(first[0])!r}; write a point before decimals, no other marks"
        raise UserError(f"{place}: expected numbers such as 1234.5, found {found}")


FORMATS |= {
    ".npz": Format(partial(_read, kind="an .npz of plain arrays", load=_npz), write_npz),
    ".npy": Format(partial(_read, kind="an array of NumPy", load=_npy)),
    ".json": Format(partial(_read, kind="arrays in JSON", load=_json)),
    ".mat": Format(partial(_read, kind="variables of MATLAB up to version 7", load=_mat)),
    ".csv": Format(partial(_read, kind="a table", load=_csv)),
    ".parquet": Format(partial(_read, kind="a Parquet table", load=_parquet)),
    **dict.fromkeys((".h5", ".hdf5"), Format(partial(_read, kind="an HDF5 file", load=_hdf5))),
    **dict.fromkeys((".pt", ".pth"), Format(partial(_read, kind="tensors of torch", load=_torch))),
}
