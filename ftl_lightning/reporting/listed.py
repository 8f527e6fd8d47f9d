"""Files of measurements other than results files: JSON with a list of rows."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ftl_lightning.services.errors import UserError, shown
from ftl_lightning.services.validation import from_mapping, read_json

T = TypeVar("T")


def read_listed(path: Path, key: str, kind: Callable[..., T], expected: str) -> list[T]:
    """Read the rows of a file.

    Args:
        path: the file.
        key: key of the rows.
        kind: dataclass of a row; ``null`` counts as missing.
        expected: expected content, for messages.

    Raises:
        UserError: for an invalid file, naming file and row.
    """
    try:
        content = read_json(path)
        rows = content.get(key) if isinstance(content, dict) else None
        if not isinstance(rows, list):
            raise UserError(f"key {key!r}: expected a list, found {shown(rows)}")
        return [from_mapping(kind, _given(row), f"{key}[{number}]") for number, row in enumerate(rows)]
    except UserError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise UserError(f"{path}: expected {expected}, found something else ({reason})") from error


def _given(row: object) -> object:
    return {name: value for name, value in row.items() if value is not None} if isinstance(row, dict) else row
