"""Demonstrations as LeRobot data sets (LeRobotDataset v3.0), and back. Needs the extra ``lerobot``; v2.0 and v2.1 are read too.

A data set is a folder: ``meta/info.json`` says what a frame holds, ``data/`` has the frames of all episodes as Parquet files, and
``meta`` has the tasks and the episodes. An episode is a demonstration. Its states are ``observation.state``, other vectors named
``observation.NAME`` are observed features that are known at every time, and the text of its first frame's task is its concept.
Actions are not read, and neither are images and videos.

What the format has no place for stands in a file that other programs ignore, ``meta/ftl_lightning.json``: the domain, units of the
columns, which features are known at the start alone, and where the demonstrations come from.
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

from ftl_lightning.data_names import INFO
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.episodes import Beside, Episode, contents
from ftl_lightning.demonstrations.file_format import Contents
from ftl_lightning.errors import UserError, about, short, shown
from ftl_lightning.limits import MOST_TENSORS, MOST_TEXT, expect_readable, expect_unpacked, read_text
from ftl_lightning.printing import line, say
from ftl_lightning.schema import expect_type, from_mapping, parse_json, read_json
from ftl_lightning.tensor_file import visible

STATE = "observation.state"
"""Feature that is the states."""
OBSERVED = "observation."
"""Before the names of what is observed."""
ACTION, SCENE = "action", "scene"
VERSIONS = ("v2.0", "v2.1", "v3.0")
"""That are read; the last is written."""
BESIDE = Path("meta") / "ftl_lightning.json"
"""For what only :func:`~ftl_lightning.demonstrations.lerobot_writing.write_lerobot` knows."""
EPISODE, TASK, LENGTH = "episode_index", "task_index", "length"
_DEFAULT = {"timestamp": "float32", "frame_index": "int64", EPISODE: "int64", "index": "int64", TASK: "int64"}
"""Features of every frame that LeRobot itself keeps, with their types."""
_DAMAGED = (pa.ArrowException, OSError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError)
"""What pyarrow raises for files that are damaged or none of its own."""


@dataclass(frozen=True)
class _Feature:
    """What info.json says of one: ``names`` of a vector's columns, or ``None`` where it does not."""

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
    """Demonstrations of a data set; nothing is downloaded.

    Args:
        folder: of the data set, with ``meta`` and ``data``.
        part: feature that is the states, such as ``'action'``; empty for ``'observation.state'`` or the only vector that is
            observed.
        observed: names of the observed features, without ``observation.``; ``None`` for all vectors.

    Returns:
        Padded to the longest episode with the last state.

    Raises:
        UserError: naming the file, if it is missing, damaged or of another version; or the data set, where it has no such feature
            or is not whole.
    """
    with about(folder):
        return Demonstrations(**read_contents(folder, part, observed))


def read_contents(folder: str | Path, part: str = "", observed: Sequence[str] | None = None) -> Contents:
    """The same before it is looked at whether values fit each other, see :func:`read_lerobot`, with the same arguments.

    Raises:
        UserError: naming the file, if it is none, is damaged or has other parts.
    """
    root = Path(folder)
    info = _info(root)
    own = (root / BESIDE).is_file()
    told = Beside()
    if own:
        content = read_json(root / BESIDE)
        with about(root / BESIDE):
            told = from_mapping(Beside, content, "")
    with about(root):
        part = _part(info.features, part)
        names = _observed(info.features, part, observed)
    if observed is not None or part != STATE:
        told = told.of([name.removeprefix(OBSERVED) for name in names], part == STATE)
    if left := [key for key, one in info.features.items() if one.dtype in ("image", "video")]:
        say(line(f"{root}: left out {short(', '.join(left), 150)}: images and videos are not read"), error=True)
    scene = [SCENE] if own and SCENE in info.features else []
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
    if told.state_names is None:
        told = replace(told, state_names=info.features[part].names)
    with about(root):
        made = contents(read, told)
    return {**made, "provenance": made["provenance"] or {"lerobot": root.resolve().name}}


def _measured(values: NDArray[Any]) -> NDArray[Any]:
    """Images stay bytes; everything else that is measured is float32."""
    with np.errstate(over="ignore"):  # what is too large for float32 is told as no finite number
        return values if values.dtype == np.uint8 else values.astype(np.float32)


def _info(root: Path) -> _Info:
    path = root / INFO
    found = read_json(path, "a LeRobot info file")
    with about(path):
        found = expect_type(found, Mapping[str, Any], "")
        version = expect_type(found.get("codebase_version"), str, "codebase_version")
        if version not in VERSIONS:
            advice = "convert it with LeRobot's own tools"
            raise UserError(f"key 'codebase_version': expected {' or '.join(VERSIONS)}, found {shown(version)}; {advice}")
        data = expect_type(found.get("data_path"), str, "data_path")
        if not data.startswith("data/") or ".." in Path(data).parts:
            raise UserError(f"key 'data_path': expected files in the folder 'data', found {shown(data)}")
        features = {
            key: _feature(key, one) for key, one in expect_type(found.get("features"), Mapping[str, Any], "features").items()
        }
        return _Info(version, expect_type(found.get("total_episodes"), int, "total_episodes"), features)


def _feature(key: str, content: object) -> _Feature:
    found = expect_type(content, Mapping[str, Any], f"features.{short(key)}")
    dtype = expect_type(found.get("dtype"), str, f"features.{short(key)}.dtype")
    # Images and other things that are not read may have shapes of any kind.
    if not (feature := _Feature(dtype)).numeric:
        return feature
    shape = expect_type(found.get("shape"), tuple[int, ...], f"features.{short(key)}.shape")
    names = found.get("names")
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}, as in older data sets
        (names,) = names.values()
    told = isinstance(names, list) and len(names) == prod(shape) and all(isinstance(one, str) for one in names)
    return _Feature(dtype, shape, tuple(names) if told else None)


def _part(features: Mapping[str, _Feature], part: str) -> str:
    """The feature that is the states."""
    vectors = [key for key, one in features.items() if one.numeric and one.dtype != "uint8" and key not in _DEFAULT]
    observed = [key for key in vectors if key.startswith(OBSERVED)]
    if not part and (STATE in vectors or len(observed) == 1):
        return STATE if STATE in vectors else observed[0]
    if not part or part not in vectors:
        known = ", ".join(vectors) or "none"
        expected = f"the feature {STATE!r}, a single observed vector, or read_lerobot(folder, part) with one of {short(known, 120)}"
        raise UserError(f"features: expected {expected}, found {repr(short(part)) if part else 'none that is clear'}")
    return part


def _observed(features: Mapping[str, _Feature], part: str, observed: Sequence[str] | None) -> list[str]:
    """Features that are observed, by their keys."""
    known = [key for key, one in features.items() if key.startswith(OBSERVED) and one.numeric]
    if observed is None:
        return [key for key in known if key != part]
    for name in observed:
        if OBSERVED + name not in known:
            told = short(", ".join(key.removeprefix(OBSERVED) for key in known), 120) or "none"
            raise UserError(f"observed: expected some of {told}, found {short(name)!r}")
    return [OBSERVED + name for name in observed]


def _frames(root: Path, wanted: Mapping[str, _Feature]) -> dict[str, NDArray[Any]]:
    """Columns of all frames by name ``(frame, *shape)``, ordered by episode."""
    columns = {**wanted, EPISODE: _Feature("int64"), TASK: _Feature("int64")}
    frames = _columns(root, "data/*/*.parquet", columns)
    order = np.argsort(frames[EPISODE], kind="stable")  # files of a copy may be in another order
    return frames if (np.diff(order) == 1).all() else {key: values[order] for key, values in frames.items()}


def _ranges(root: Path, info: _Info, index: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First frame and end of each episode, which must be what meta says."""
    numbers, starts, counts = np.unique(index, return_index=True, return_counts=True)
    found = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    lengths = _lengths(root, info)
    if info.episodes != len(lengths):
        raise UserError(f"{root / INFO}: key 'total_episodes': expected {len(lengths)}, as in meta, found {info.episodes}")
    for number in {**lengths, **found}:
        if lengths.get(number) != found.get(number):
            told = f"{lengths.get(number, 0)} frames, as in meta, found {found.get(number, 0)} in data"
            raise UserError(f"{root}: episode {number}: expected {told}; take another, whole copy")
    return [(start, start + count) for start, count in zip(starts.tolist(), counts.tolist(), strict=True)]


def _lengths(root: Path, info: _Info) -> dict[int, int]:
    if not info.old:
        columns = _columns(root, "meta/episodes/*/*.parquet", {EPISODE: _Feature("int64"), LENGTH: _Feature("int64")})
        return dict(zip(columns[EPISODE].tolist(), columns[LENGTH].tolist(), strict=True))
    return {
        expect_type(one.get(EPISODE), int, EPISODE): expect_type(one.get(LENGTH), int, LENGTH)
        for one in _lines(root / "meta" / "episodes.jsonl")
    }


def _tasks(root: Path, info: _Info) -> dict[int, str]:
    """Texts by their numbers."""
    if info.old:
        return {
            expect_type(one.get(TASK), int, TASK): expect_type(one.get("task"), str, "task")
            for one in _lines(root / "meta" / "tasks.jsonl")
        }
    path = root / "meta" / "tasks.parquet"
    expect_readable(path, "tasks", MOST_TEXT)
    with _reading(path), pq.ParquetFile(path) as file:
        unpacked = sum(file.metadata.row_group(group).total_byte_size for group in range(file.num_row_groups))
        if max(unpacked, file.metadata.num_rows) > MOST_TEXT:
            raise UserError(f"{path}: expected texts of at most {MOST_TEXT} bytes, found {unpacked}")
        schema = file.schema_arrow
        # The texts are pandas' index: its name is 'task', or one of pandas' own where it was not named.
        texts = [one.name for one in schema if pa.types.is_string(one.type) or pa.types.is_large_string(one.type)]
        if TASK not in schema.names or not texts or not pa.types.is_integer(schema.field(TASK).type):
            raise UserError(f"{path}: expected the columns {TASK!r} and 'task', found {short(', '.join(schema.names))}")
        table = file.read(columns=[TASK, "task" if "task" in texts else texts[0]])
        numbers, found = (column.to_pylist() for column in (table.column(0), table.column(1)))
    return {number: text for number, text in zip(numbers, found, strict=True) if isinstance(text, str)}


def _lines(path: Path) -> Iterator[Mapping[str, Any]]:
    """Objects of a file with one in each line."""
    for number, text in enumerate(read_text(path, "LeRobot").splitlines()):
        if text.strip():
            with about(path):
                yield expect_type(parse_json(text), Mapping[str, Any], f"line {number + 1}")


def _columns(root: Path, pattern: str, wanted: Mapping[str, _Feature]) -> dict[str, NDArray[Any]]:
    """Columns of Parquet files one after another, by name ``(row, *shape)``.

    Raises:
        UserError: naming the file, if there is none, or it is damaged, much larger than its bytes, or has other columns.
    """
    paths = visible(root, pattern)
    if not 1 <= len(paths) <= MOST_TENSORS:
        raise UserError(f"{root}: expected Parquet files {pattern}, at most {MOST_TENSORS}, found {len(paths)}")
    packed = sum(expect_readable(path, "Parquet") for path in paths)
    rows = 0
    for path in paths:
        with _reading(path), pq.ParquetFile(path) as file:
            _expect_columns(path, file, wanted)
            rows += file.metadata.num_rows
    with about(root):
        expect_unpacked(rows * sum(one.size * (1 if one.dtype == "uint8" else 8) for one in wanted.values()), packed, "frames")
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
    """Refuse a file without the columns, or with more numbers in them than their shapes say, which could take all memory."""
    schema, leaf = file.schema_arrow, 0
    leaves: dict[str, int] = {}
    for field in schema:
        leaves[field.name] = -1 if field.name in leaves else leaf
        leaf += _leaves(field.type)
    for name, feature in wanted.items():
        if leaves.get(name, -1) < 0:
            told = short(", ".join(schema.names), 120)
            raise UserError(f"{path}: expected the column {name!r} once, found {told}")
        for group in range(file.num_row_groups):
            rows = file.metadata.row_group(group)
            if (found := rows.column(leaves[name]).num_values) != rows.num_rows * max(1, feature.size):
                expected = f"{rows.num_rows} times {feature.size} numbers"
                raise UserError(f"{path}: column {name!r}: expected {expected}, as info.json says, found {found}")


def _leaves(kind: pa.DataType) -> int:
    """Parquet columns of an Arrow column."""
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
    """``(row, *shape)``; numbers that are missing are no numbers (NaN)."""
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
    found: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    if whole:
        return found.astype(np.int64)
    return found.reshape(rows, *feature.shape)
