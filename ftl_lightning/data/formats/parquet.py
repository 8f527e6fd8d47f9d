"""Numbers and texts in Parquet files. Needs ``pyarrow``: import this module only after the check of the extra."""

import codecs
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.json as pj
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ftl_lightning.services.errors import UserError, about, require, short
from ftl_lightning.services.files import MOST_TENSORS, MOST_TEXT, check_readable, check_unpacked
from ftl_lightning.services.tensor_file import visible
from ftl_lightning.services.validation import LARGEST

_DAMAGED = (pa.ArrowException, OSError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError)
"""Exceptions of pyarrow for damaged or foreign files."""
MOST_TASKS = 100_000
"""Maximum number of texts of tasks."""
MOST_TASK_BYTES = 8 * 2**20
"""Maximum bytes of all texts of tasks."""


def read_columns(
    root: Path,
    pattern: str,
    shapes: Mapping[str, tuple[int, ...]],
    whole: Collection[str],
    optional: Collection[str] = (),
    rows: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Read and concatenate columns of the files below ``root`` that match a pattern.

    Args:
        root, pattern: folder, and pattern of its files.
        shapes: shape of a row of each column, by name; a shape of a single number may be stored without a list.
        whole: names of columns of whole numbers (int64).
        optional: names of columns that are left out if the first file lacks them.
        rows: maximum number of rows of all files; ``None`` for the limit of memory.

    Returns:
        Numbers by name, ``(row, *shape)``, or ``(row,)`` if whole; missing numbers are NaN.

    Raises:
        UserError: naming the file, if it is missing, damaged, much larger than its bytes, or has other columns or rows.
    """
    paths = visible(root, pattern)
    require(1 <= len(paths) <= MOST_TENSORS, str(root), f"Parquet files {pattern}, at most {MOST_TENSORS}", str(len(paths)))
    packed, size, actual = sum(check_readable(path, "Parquet") for path in paths), 0, 0
    for path in paths:
        with _opened(path) as file:
            if path == paths[0]:
                shapes = {name: shape for name, shape in shapes.items() if name not in {*optional} - {*file.schema_arrow.names}}
            size += _checked_size(path, file, shapes)
            actual += file.metadata.num_rows
    require(rows is None or actual <= rows, str(root / pattern), f"at most {rows} rows", str(actual))
    with about(root):
        check_unpacked(size, packed, "frames")
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in shapes}
    for path in paths:
        with _opened(path) as file:
            table = file.read(columns=list(shapes))
            for name, shape in shapes.items():
                parts[name].append(_numbers(f"{path}: column {name!r}", table.column(name), shape, name in whole))
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}


def read_texts(path: Path, number: str, name: str) -> dict[int, str]:
    """Read texts by number, from the columns ``number`` and ``name``, or the only texts under any name: pandas names an index.

    Raises:
        UserError: naming the file, if it is missing, damaged, too large, or lacks the columns.
    """
    packed = check_readable(path, "tasks", MOST_TASK_BYTES)
    with _opened(path) as file:
        size = sum(file.metadata.row_group(group).total_byte_size for group in range(file.num_row_groups))
        expected = f"texts of at most {MOST_TASK_BYTES} bytes"
        require(size <= MOST_TASK_BYTES, str(path), expected, str(size))
        require(file.metadata.num_rows <= MOST_TASKS, str(path), f"at most {MOST_TASKS} tasks", str(file.metadata.num_rows))
        schema = file.schema_arrow
        texts = [field.name for field in schema if _is_text(field.type)]
        known = number in schema.names and texts and pa.types.is_integer(schema.field(number).type)
        require(known, str(path), f"the columns {number!r} and {name!r}", short(", ".join(schema.names)))
        columns, decoded = [number, name if name in texts else texts[0]], 0
        named: dict[int, str] = {}
        # A text that is stored once stands for many rows. No row is larger than all that is stored, so batches stay small.
        for batch in file.iter_batches(max(1, MOST_TASK_BYTES // max(size, packed)), columns=columns):
            decoded += batch.nbytes
            require(
                decoded <= MOST_TASK_BYTES, str(path), f"texts of at most {MOST_TASK_BYTES} bytes", "more when they are decoded"
            )
            keys, values = (batch.column(column).to_pylist() for column in columns)
            named |= {key: text for key, text in zip(keys, values, strict=True) if text is not None}
        return named


def read_lines(path: Path, kinds: Mapping[str, Literal["int64", "string"]]) -> dict[str, list[Any]]:
    """Read values by name from a file with a JSON object in each line; other names are ignored, missing values are ``None``.

    Raises:
        UserError: naming the file, if it is missing, damaged, too large, or holds values of another type.
    """
    check_readable(path, "LeRobot", MOST_TEXT)
    content = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    count = content.count(b"{")
    require(count <= LARGEST, str(path), f"at most {LARGEST} JSON objects", str(count))
    schema = pa.schema([pa.field(name, pa.type_for_alias(kind)) for name, kind in kinds.items()])
    parsing = pj.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore")
    reading = pj.ReadOptions(use_threads=False, block_size=len(content) + 1)  # a line may be as long as the file
    try:
        table = pj.read_json(pa.BufferReader(content), reading, parsing) if content.strip() else schema.empty_table()
        return {name: table.column(name).to_pylist() for name in kinds}
    except _DAMAGED as error:
        expected = "a JSON object with " + " and ".join(f"{name!r} ({kind})" for name, kind in kinds.items())
        raise UserError(f"{path}: expected {expected} in each line, found others ({short(str(error), 100)})") from error


def read_table(path: Path, roles: Collection[str]) -> tuple[pd.DataFrame, list[str]]:
    """Read columns of numbers, and of texts and dates with lower-case names in ``roles``; repeated texts are stored once.

    Returns:
        Table, and the names of the columns that are not read.

    Raises:
        UserError: naming the file, if it is missing, damaged, or unpacks to far more than its size.
    """
    packed = check_readable(path, "Parquet")
    with _opened(path) as file:
        schema, texts, columns = file.schema_arrow, [], []
        once = len({*schema.names}) == len(schema.names) <= MOST_TENSORS
        require(once, str(path), f"at most {MOST_TENSORS} columns of different names", f"{len(schema.names)} columns")
        for field in schema:
            kind = field.type.value_type if pa.types.is_dictionary(field.type) else field.type
            role = field.name.strip().lower() in roles
            if role and _is_text(kind):
                texts.append(field.name)
            if _is_number(kind) or (role and (_is_text(kind) or pa.types.is_timestamp(kind))):
                columns.append(field.name)
        stored = sum(file.metadata.row_group(group).total_byte_size for group in range(file.num_row_groups))
        with about(path):
            check_unpacked(max(stored, 8 * file.metadata.num_rows * len(columns)), packed, "columns")
    with _opened(path, texts) as file:
        table = file.read(columns=columns).to_pandas(ignore_metadata=True)
    return table, [name for name in schema.names if name not in columns]


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows of values by column name; types are those of the values."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)


def write_texts(path: Path, number: str, name: str, texts: Mapping[str, int]) -> None:
    """Write numbers by text, with the texts as the index of a pandas table, as LeRobot expects."""
    pd.DataFrame({number: list(texts.values())}, index=pd.Index(list(texts), name=name, dtype=object)).to_parquet(path)


def write_columns(path: Path, groups: list[pa.Table]) -> None:
    """Write tables of :func:`to_table` as the row groups of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, groups[0].schema) as writer:
        for group in groups:
            writer.write_table(group)


def to_table(columns: Mapping[str, NDArray[Any]]) -> pa.Table:
    """Convert columns ``(row, *shape)``: shape (1,) to numbers, vectors to lists of fixed size, others to nested lists."""
    return pa.table({name: _to_arrow(values) for name, values in columns.items()})


def _to_arrow(values: NDArray[Any]) -> pa.Array:
    shape = values.shape[1:]
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    if shape == (1,):
        return flat
    if len(shape) == 1 and shape[0]:
        return pa.FixedSizeListArray.from_arrays(flat, shape[0])
    for axis in reversed(range(1, values.ndim)):
        count = prod(values.shape[:axis])
        flat = pa.ListArray.from_arrays(pa.array(np.arange(count + 1, dtype=np.int32) * values.shape[axis]), flat)
    return flat


@contextmanager
def _opened(path: Path, dictionaries: Sequence[str] = ()) -> Iterator[pq.ParquetFile]:
    try:
        with pq.ParquetFile(path, read_dictionary=list(dictionaries)) as file:
            yield file
    except _DAMAGED as error:
        raise UserError(f"{path}: expected a Parquet file, found a damaged one ({short(str(error), 100)})") from error


def _checked_size(path: Path, file: pq.ParquetFile, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Unpacked bytes of columns, which must exist and hold the numbers of their shapes: more could exhaust memory."""
    names, size = file.schema_arrow.names, 0
    paths = [file.schema.column(index).path for index in range(len(file.schema))]
    for name, shape in shapes.items():
        leaves = [index for index, leaf in enumerate(paths) if leaf == name or leaf.startswith(f"{name}.list.")]
        require(len(leaves) == 1, str(path), f"the column {name!r} once", short(", ".join(names), 120))
        for group in range(file.num_row_groups):
            rows = file.metadata.row_group(group)
            count, expected = rows.column(leaves[0]).num_values, rows.num_rows * max(1, prod(shape))
            message = f"{rows.num_rows} times {prod(shape)} numbers, as info.json says"
            require(count == expected, f"{path}: column {name!r}", message, str(count))
        kind = _innermost(file.schema_arrow.field(name).type)
        require(_is_number(kind), f"{path}: column {name!r}", f"numbers of shape {shape}", short(str(kind)))  # a text has any size
        size += file.metadata.num_rows * prod(shape) * (1 if pa.types.is_uint8(kind) else 8)
    return size


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _innermost(kind: pa.DataType) -> pa.DataType:
    """Type of the items of lists, however nested."""
    while True:
        if isinstance(kind, pa.BaseExtensionType):
            kind = kind.storage_type
        elif _is_list(kind):
            kind = kind.value_type
        else:
            return kind


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)


def _numbers(place: str, column: pa.ChunkedArray, shape: tuple[int, ...], whole: bool) -> NDArray[Any]:
    """Values ``(row, *shape)`` of a column, or ``(row,)`` if whole."""
    values = column.combine_chunks()
    for size in shape:
        if isinstance(values, pa.ExtensionArray):
            values = values.storage
        if not _is_list(values.type):
            break  # a vector of a single number is the number itself
        even = not len(values) or pc.unique(pc.list_value_length(values)).to_pylist() == [size]
        require(even, place, f"{size} numbers in each list", "other lists")
        values = values.flatten()
    kind = values.type
    fits = _is_number(kind) and len(values) == len(column) * prod(shape)
    require(fits, place, f"numbers of shape {shape}", short(str(column.type)))
    if whole:
        valid = pa.types.is_integer(kind) and not values.null_count
        require(valid, place, "whole numbers", f"{short(str(kind))} or missing ones")
        return values.to_numpy(zero_copy_only=False).astype(np.int64)
    if pa.types.is_boolean(kind):
        values = values.cast(pa.uint8()).cast(pa.float32())
    return values.to_numpy(zero_copy_only=False).reshape(len(column), *shape)
