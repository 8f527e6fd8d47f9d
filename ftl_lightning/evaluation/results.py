"""Results files: a :class:`~ftl_lightning.evaluation.row.Row` for every measured value."""

import csv
import math
import re
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pandas as pd

from ftl_lightning.evaluation.row import METHOD, REFERENCE, Row, label
from ftl_lightning.services.errors import UserError, about, short, shown
from ftl_lightning.services.files import MOST_TEXT, check_readable
from ftl_lightning.services.tensor_file import alone, atomic, visible

FOLDER = r"\w[\w .+-]{0,99}"
"""Pattern of domain names, which are folder names in a report."""
LARGEST_WHOLE = 2**53
"""Maximum integer, including seeds."""
COLUMNS = [field.name for field in fields(Row)]
_WHOLE = [field.name for field in fields(Row) if field.type is int]
_MAYBE_EMPTY = ("setting", "task", "form", "variant", "omega", "model_hash")
_TEXT = {field.name: object for field in fields(Row) if field.type is str}  # faster selection than pandas's strings
_SUBJECT = ["domain", "setting", "task", "method", "form", "variant", "role", "K", "omega", "demonstrations", "seed", "metric"]
_KEY = [*_SUBJECT, "n", "config_hash"]
"""Columns that identify a measurement; a newer row with equal values replaces an older row."""


def append_rows(path: str | Path, rows: list[Row]) -> None:
    """Add rows to a results file atomically, creating it if missing and replacing equal measurements."""
    add_rows(path, pd.DataFrame([asdict(row) for row in rows], columns=COLUMNS))


def add_rows(path: str | Path, table: pd.DataFrame) -> None:
    """Add rows of a table with :data:`COLUMNS` atomically, replacing equal measurements.

    A lock serialises processes that write to the same folder.
    """
    path = Path(path)
    with alone(path.parent):
        if path.is_file():
            known = read_rows(path)
            table = known if table.empty else pd.concat([known, table])
        with atomic(path) as temporary:
            table.drop_duplicates(_KEY, keep="last").to_csv(temporary, index=False)


def labels(rows: pd.DataFrame) -> pd.Series:
    """:func:`label` of each row."""
    names = zip(rows["method"], rows["form"], rows["variant"], strict=True)
    return pd.Series([label(*row_names) for row_names in names], rows.index, dtype=str)


def replaced(rows: pd.DataFrame) -> int:
    """Number of rows that :func:`latest` removes: subjects measured again later in another configuration."""
    return len(rows) - len(latest(rows))


def latest(rows: pd.DataFrame) -> pd.DataFrame:
    """Keep the last of the rows that differ only in the number of samples and the configuration."""
    return rows.drop_duplicates(_SUBJECT, keep="last")


COMPARISON, CURVES, CHANGES, PAPER_SIZE = "comparison", "curves", "changes", "paper_size"
"""Names of results files that are not ablations: all methods; numbers of demonstrations and components; our method without each of
its changes to the paper's form; models of the paper's size, which have no separate table."""


def read_study(path: str | Path, name: str = "") -> pd.DataFrame:
    """Read the files named ``name`` in a folder, or without a name all ablations. The table may be empty.

    Raises:
        UserError: for a missing file, or a file with wrong columns or an invalid cell.
    """
    path = Path(path)
    files = _files(path) if path.is_dir() else [path]
    named = [file for file in files if (file.stem == name if name else file.stem not in (COMPARISON, CURVES, CHANGES, PAPER_SIZE))]
    return pd.concat([read_rows(file) for file in named], ignore_index=True) if named else pd.DataFrame(columns=COLUMNS)


def _files(folder: Path) -> list[Path]:
    """Results files below a folder, ``invert_2`` before ``invert_10``."""
    return sorted(visible(folder, "**/*.csv"), key=lambda path: [int(part) if part.isdigit() else part for part in _parts(path)])


def _parts(path: Path) -> list[str]:
    # Every second part is a number, so numbers are only compared with numbers.
    return re.split(r"(\d+)", path.as_posix())


def _read(file: Path) -> pd.DataFrame:
    table = _table(file, _TEXT)
    if not isinstance(table.index, pd.RangeIndex):
        raise UserError(f"expected {len(table.columns)} cells in each row, found more in some; it is damaged")
    if list(table.columns) != COLUMNS:
        columns = short(", ".join(map(str, table.columns)), 80)
        raise UserError(f"expected the columns {short(', '.join(COLUMNS), 140)}, found {columns}")
    if (bad := _bad_cell(table)) is not None:
        row, column, expected = bad
        cell = _table(file, str).fillna("").iloc[row][column]
        raise UserError(f"row {row + 2}, column {column!r}: expected {expected}, found {shown(cell)}; it is damaged")
    return table


def _table(file: Path, kinds: Any) -> pd.DataFrame:
    check_readable(file, "results", MOST_TEXT)
    try:
        return pd.read_csv(file.absolute(), dtype=kinds, keep_default_na=False, compression=None)
    except (OSError, ValueError, OverflowError, MemoryError, csv.Error) as error:
        raise UserError(f"expected a results file, found something else ({short(str(error), 100)})") from error


def _bad_cell(table: pd.DataFrame) -> tuple[int, str, str] | None:
    """Row, column and expected content of the first invalid cell; ``None`` if all are valid."""
    for name, values in table.items():
        numbers = pd.to_numeric(values.astype(str), errors="coerce") if name not in _TEXT else pd.Series(dtype=float)
        if name == "role":
            good, expected = values.isin((METHOD, REFERENCE)), f"{METHOD} or {REFERENCE}"
        elif name == "domain":
            good, expected = values.str.fullmatch(FOLDER), "a name of letters, digits and - . +"
        elif name in _TEXT:
            good = values.notna() & ((values != "") | (name in _MAYBE_EMPTY))
            expected = "a text"
        elif name in _WHOLE:
            good, expected = numbers.between(0, LARGEST_WHOLE) & (numbers % 1 == 0), f"a whole number up to {LARGEST_WHOLE}"
        else:
            good, expected = numbers.abs() < math.inf, "a finite number"
        if not good.all():
            return int((~good).to_numpy().argmax()), str(name), expected
        if name not in _TEXT and len(values) and values.dtype.kind not in ("iu" if name in _WHOLE else "iuf"):
            return 0, str(name), expected  # numbers in another notation
    return None


def read_rows(path: str | Path) -> pd.DataFrame:
    """Read a results file, or all ``.csv`` files of a folder.

    Raises:
        UserError: for a missing file, or a file with wrong columns or an invalid cell.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: expected a results file or a folder of them, found nothing; invert writes one to its log folder")
    files = _files(path) if path.is_dir() else [path]
    tables = []
    for file in files:
        with about(file):
            tables.append(_read(file))
    if not tables:
        raise UserError(f"{path}: expected results (.csv files), found none; run: make run")
    return pd.concat(tables, ignore_index=True)
