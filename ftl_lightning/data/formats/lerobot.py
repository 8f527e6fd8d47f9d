"""Demonstrations from LeRobot data sets (LeRobotDataset v3.0, v2.1 and v2.0). Needs the extra ``lerobot``.

A data set is a folder. ``meta/info.json`` describes the features of a frame, ``data/`` holds the frames of all episodes as Parquet
files, and ``meta`` holds tasks and episodes. An episode is a demonstration. Its states are ``observation.state``, other vectors
named ``observation.NAME`` are observed features that are known at every time, and the task text of its first frame is the concept.
Actions, images and videos are not read.

The file ``meta/ftl_lightning.json``, ignored by other programs, holds what the format cannot: the domain, units of columns, names
of features that are known only at the start, and provenance.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.formats.episodes import Beside, Episode, contents
from ftl_lightning.data.formats.file_format import Contents
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.files import INFO, MOST_TENSORS, MOST_TEXT, check_readable, check_unpacked, read_text
from ftl_lightning.services.tensor_file import visible
from ftl_lightning.services.text import line, say
from ftl_lightning.services.validation import check_type, from_mapping, parse_json, read_json

STATE = "observation.state"
"""Feature that holds the states."""
OBSERVED = "observation."
"""Prefix of observed features."""
ACTION, SCENE = "action", "scene"
VERSIONS = ("v2.0", "v2.1", "v3.0")
"""Versions that are read; the last is written."""
BESIDE = Path("meta") / "ftl_lightning.json"
"""File of attributes that only :func:`~ftl_lightning.data.formats.lerobot_writing.write_lerobot` knows."""
EPISODE, TASK, LENGTH = "episode_index", "task_index", "length"
_DEFAULT = {"timestamp": "float32", "frame_index": "int64", EPISODE: "int64", "index": "int64", TASK: "int64"}
"""Features that LeRobot adds to every frame, with their types."""
_DAMAGED = (pa.ArrowException, OSError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError)
"""Exceptions of pyarrow for damaged or foreign files."""


@dataclass(frozen=True)
class _Feature:
    """Feature in info.json; ``names`` are the columns of a vector, ``None`` if not given."""

    dtype: str
    shape: tuple[int, ...] = (1,)
    names: tuple[str, ...] | None = None

    @property
    def numeric(self) -> bool:
        return self.dtype == "bool" or self.dtype.startswith(("float", "int", "uint"))

    @property
    def size(self) -> int:
        return prod(self.shape)


@dataclass(frozen=True)
class _Info:
    version: str
    episodes: int
    features: Mapping[str, _Feature]

    @property
    def old(self) -> bool:
        return not self.version.startswith("v3")


def read_lerobot(folder: str | Path, part: str = "", observed: Sequence[str] | None = None) -> Demonstrations:
    """Read demonstrations of a local data set; nothing is downloaded.

    Args:
        folder: folder of the data set, with ``meta`` and ``data``.
        part: feature that holds the states, such as ``'action'``; empty for ``'observation.state'`` or the only observed vector.
        observed: names of observed features, without ``observation.``; ``None`` for all vectors.

    Returns:
        Demonstrations, padded to the longest episode with the last state.

    Raises:
        UserError: naming the file, if it is missing, damaged or of another version; naming the data set, if it lacks the feature or
            is incomplete.
    """
    with about(folder):
        return Demonstrations(**read_contents(folder, part, observed))


def read_contents(folder: str | Path, part: str = "", observed: Sequence[str] | None = None) -> Contents:
    """Read the attributes of demonstrations without validating them. Arguments as in :func:`read_lerobot`.

    Raises:
        UserError: naming the file, if it is foreign, damaged or has other parts.
    """
    root = Path(folder)
    info = _info(root)
    written = (root / BESIDE).is_file()
    extra = Beside()
    if written:
        content = read_json(root / BESIDE)
        with about(root / BESIDE):
            extra = from_mapping(Beside, content, "")
    with about(root):
        part = _part(info.features, part)
        names = _observed(info.features, part, observed)
    if observed is not None or part != STATE:
        extra = extra.of([name.removeprefix(OBSERVED) for name in names], part == STATE)
    if left := [key for key, feature in info.features.items() if feature.dtype in ("image", "video")]:
        say(line(f"{root}: left out {short(', '.join(left), 150)}: images and videos are not read"), error=True)
    scene = [SCENE] if written and SCENE in info.features else []
    wanted = {key: info.features[key] for key in (part, *names, *scene)}
    frames = _frames(root, wanted)
    texts = _tasks(root, info)
    read = []
    for start, stop in _ranges(root, info, frames[EPISODE]):
        if (task := int(frames[TASK][start])) not in texts:
            raise UserError(f"{root}: key {TASK!r}: expected one of the tasks in meta, found {task}")
        read.append(
            Episode(
                frames[part][start:stop].reshape(stop - start, -1).astype(np.float32),
                {name.removeprefix(OBSERVED): _measured(frames[name][start:stop]) for name in names},
                texts[task],
                _measured(frames[SCENE][start]) if scene else None,
            )
        )
    if extra.state_names is None:
        extra = replace(extra, state_names=info.features[part].names)
    with about(root):
        attributes = contents(read, extra)
    return {**attributes, "provenance": attributes["provenance"] or {"lerobot": root.resolve().name}}


def _measured(values: NDArray[Any]) -> NDArray[Any]:
    """Convert measurements to float32; images stay uint8."""
    with np.errstate(over="ignore"):  # overflow is reported later as a number that is not finite
        return values if values.dtype == np.uint8 else values.astype(np.float32)


def _info(root: Path) -> _Info:
    path = root / INFO
    content = read_json(path, "a LeRobot info file")
    with about(path):
        content = check_type(content, Mapping[str, Any], "")
        version = check_type(content.get("codebase_version"), str, "codebase_version")
        if version not in VERSIONS:
            advice = "convert it with LeRobot's own tools"
            raise UserError(f"key 'codebase_version': expected {' or '.join(VERSIONS)}, found {shown(version)}; {advice}")
        data = check_type(content.get("data_path"), str, "data_path")
        if not data.startswith("data/") or ".." in Path(data).parts:
            raise UserError(f"key 'data_path': expected files in the folder 'data', found {shown(data)}")
        features = {
            key: _feature(key, value) for key, value in check_type(content.get("features"), Mapping[str, Any], "features").items()
        }
        return _Info(version, check_type(content.get("total_episodes"), int, "total_episodes"), features)


def _feature(key: str, content: object) -> _Feature:
    fields = check_type(content, Mapping[str, Any], f"features.{short(key)}")
    dtype = check_type(fields.get("dtype"), str, f"features.{short(key)}.dtype")
    # Features that are not read, such as images, may have any shape.
    if not (feature := _Feature(dtype)).numeric:
        return feature
    shape = check_type(fields.get("shape"), tuple[int, ...], f"features.{short(key)}.shape")
    names = fields.get("names")
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}, as in older data sets
        (names,) = names.values()
    named = isinstance(names, list) and len(names) == prod(shape) and all(isinstance(name, str) for name in names)
    return _Feature(dtype, shape, tuple(names) if named else None)


def _part(features: Mapping[str, _Feature], part: str) -> str:
    """Feature that holds the states."""
    vectors = [key for key, feature in features.items() if feature.numeric and feature.dtype != "uint8" and key not in _DEFAULT]
    observed = [key for key in vectors if key.startswith(OBSERVED)]
    if not part and (STATE in vectors or len(observed) == 1):
        return STATE if STATE in vectors else observed[0]
    if not part or part not in vectors:
        known = ", ".join(vectors) or "none"
        expected = f"the feature {STATE!r}, a single observed vector, or read_lerobot(folder, part) with one of {short(known, 120)}"
        raise UserError(f"features: expected {expected}, found {repr(short(part)) if part else 'none that is clear'}")
    return part


def _observed(features: Mapping[str, _Feature], part: str, observed: Sequence[str] | None) -> list[str]:
    """Keys of the observed features."""
    known = [key for key, feature in features.items() if key.startswith(OBSERVED) and feature.numeric]
    if observed is None:
        return [key for key in known if key != part]
    for name in observed:
        if OBSERVED + name not in known:
            available = short(", ".join(key.removeprefix(OBSERVED) for key in known), 120) or "none"
            raise UserError(f"observed: expected some of {available}, found {short(name)!r}")
    return [OBSERVED + name for name in observed]


def _frames(root: Path, wanted: Mapping[str, _Feature]) -> dict[str, NDArray[Any]]:
    """Columns of all frames by name ``(frame, *shape)``, ordered by episode."""
    columns = {**wanted, EPISODE: _Feature("int64"), TASK: _Feature("int64")}
    frames = _columns(root, "data/*/*.parquet", columns)
    order = np.argsort(frames[EPISODE], kind="stable")  # copied files may be in another order
    return frames if (np.diff(order) == 1).all() else {key: values[order] for key, values in frames.items()}


def _ranges(root: Path, info: _Info, index: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First frame and end of each episode, checked against meta."""
    numbers, starts, counts = np.unique(index, return_index=True, return_counts=True)
    counted = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    lengths = _lengths(root, info)
    if info.episodes != len(lengths):
        raise UserError(f"{root / INFO}: key 'total_episodes': expected {len(lengths)}, as in meta, found {info.episodes}")
    for number in {**lengths, **counted}:
        if lengths.get(number) != counted.get(number):
            message = f"{lengths.get(number, 0)} frames, as in meta, found {counted.get(number, 0)} in data"
            raise UserError(f"{root}: episode {number}: expected {message}; take another, whole copy")
    return [(start, start + count) for start, count in zip(starts.tolist(), counts.tolist(), strict=True)]


def _lengths(root: Path, info: _Info) -> dict[int, int]:
    if not info.old:
        columns = _columns(root, "meta/episodes/*/*.parquet", {EPISODE: _Feature("int64"), LENGTH: _Feature("int64")})
        return dict(zip(columns[EPISODE].tolist(), columns[LENGTH].tolist(), strict=True))
    return {
        check_type(row.get(EPISODE), int, EPISODE): check_type(row.get(LENGTH), int, LENGTH)
        for row in _lines(root / "meta" / "episodes.jsonl")
    }


def _tasks(root: Path, info: _Info) -> dict[int, str]:
    """Task texts by number."""
    if info.old:
        return {
            check_type(row.get(TASK), int, TASK): check_type(row.get("task"), str, "task")
            for row in _lines(root / "meta" / "tasks.jsonl")
        }
    path = root / "meta" / "tasks.parquet"
    check_readable(path, "tasks", MOST_TEXT)
    with _reading(path), pq.ParquetFile(path) as file:
        unpacked = sum(file.metadata.row_group(group).total_byte_size for group in range(file.num_row_groups))
        if max(unpacked, file.metadata.num_rows) > MOST_TEXT:
            raise UserError(f"{path}: expected texts of at most {MOST_TEXT} bytes, found {unpacked}")
        schema = file.schema_arrow
        # The texts are pandas' index, named 'task' or by pandas' default.
        texts = [field.name for field in schema if pa.types.is_string(field.type) or pa.types.is_large_string(field.type)]
        if TASK not in schema.names or not texts or not pa.types.is_integer(schema.field(TASK).type):
            raise UserError(f"{path}: expected the columns {TASK!r} and 'task', found {short(', '.join(schema.names))}")
        table = file.read(columns=[TASK, "task" if "task" in texts else texts[0]])
        numbers, tasks = (column.to_pylist() for column in (table.column(0), table.column(1)))
    return {number: text for number, text in zip(numbers, tasks, strict=True) if isinstance(text, str)}


def _lines(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the JSON object of each line."""
    for number, text in enumerate(read_text(path, "LeRobot").splitlines()):
        if text.strip():
            with about(path):
                yield check_type(parse_json(text), Mapping[str, Any], f"line {number + 1}")


def _columns(root: Path, pattern: str, wanted: Mapping[str, _Feature]) -> dict[str, NDArray[Any]]:
    """Concatenate columns of Parquet files, by name ``(row, *shape)``.

    Raises:
        UserError: naming the file, if it is missing, damaged, much larger than its bytes, or has other columns.
    """
    paths = visible(root, pattern)
    if not 1 <= len(paths) <= MOST_TENSORS:
        raise UserError(f"{root}: expected Parquet files {pattern}, at most {MOST_TENSORS}, found {len(paths)}")
    packed = sum(check_readable(path, "Parquet") for path in paths)
    rows = 0
    for path in paths:
        with _reading(path), pq.ParquetFile(path) as file:
            _expect_columns(path, file, wanted)
            rows += file.metadata.num_rows
    with about(root):
        check_unpacked(rows * sum(spec.size * (1 if spec.dtype == "uint8" else 8) for spec in wanted.values()), packed, "frames")
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in wanted}
    for path in paths:
        with _reading(path), pq.ParquetFile(path) as file:
            table = file.read(columns=list(wanted))
            for name, feature in wanted.items():
                parts[name].append(_numbers(path, name, table.column(name), feature))
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGED as error:
        raise UserError(f"{path}: expected a Parquet file, found a damaged one ({short(str(error), 100)})") from error


def _expect_columns(path: Path, file: pq.ParquetFile, wanted: Mapping[str, _Feature]) -> None:
    """Refuse a file that lacks a column or holds more numbers than its shape, which could exhaust memory."""
    schema, leaf = file.schema_arrow, 0
    leaves: dict[str, int] = {}
    for field in schema:
        leaves[field.name] = -1 if field.name in leaves else leaf
        leaf += _leaves(field.type)
    for name, feature in wanted.items():
        if leaves.get(name, -1) < 0:
            names = short(", ".join(schema.names), 120)
            raise UserError(f"{path}: expected the column {name!r} once, found {names}")
        for group in range(file.num_row_groups):
            rows = file.metadata.row_group(group)
            if (count := rows.column(leaves[name]).num_values) != rows.num_rows * max(1, feature.size):
                expected = f"{rows.num_rows} times {feature.size} numbers"
                raise UserError(f"{path}: column {name!r}: expected {expected}, as info.json says, found {count}")


def _leaves(kind: pa.DataType) -> int:
    """Number of Parquet columns of an Arrow column."""
    if _is_list(kind):
        return _leaves(kind.value_type)
    if pa.types.is_struct(kind):
        return sum(_leaves(kind.field(index).type) for index in range(kind.num_fields))
    if pa.types.is_map(kind):
        return _leaves(kind.key_type) + _leaves(kind.item_type)
    return 1


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _numbers(path: Path, name: str, column: pa.ChunkedArray, feature: _Feature) -> NDArray[Any]:
    """Values ``(row, *shape)`` of a column; missing numbers are NaN."""
    values, rows = column.combine_chunks(), len(column)
    if isinstance(values, pa.ChunkedArray):
        values = pa.concat_arrays(values.chunks) if values.num_chunks else pa.array([], values.type)
    for size in feature.shape:
        if isinstance(values, pa.ExtensionArray):
            values = values.storage
        if not _is_list(values.type):
            break  # a vector of one number is the number itself
        if len(values) and pc.unique(pc.list_value_length(values)).to_pylist() != [size]:
            raise UserError(f"{path}: column {name!r}: expected {size} numbers in each list, found other lists")
        values = values.flatten()
    kind = values.type
    if len(values) != rows * feature.size or not (
        pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)
    ):
        raise UserError(f"{path}: column {name!r}: expected numbers of shape {feature.shape}, found {short(str(column.type))}")
    whole = name in (EPISODE, TASK, LENGTH)
    if whole and (values.null_count or not pa.types.is_integer(kind)):
        raise UserError(f"{path}: column {name!r}: expected whole numbers, found {short(str(kind))} or missing ones")
    if pa.types.is_boolean(kind):
        values = values.cast(pa.uint8()).cast(pa.float32())
    numbers: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    if whole:
        return numbers.astype(np.int64)
    return numbers.reshape(rows, *feature.shape)
