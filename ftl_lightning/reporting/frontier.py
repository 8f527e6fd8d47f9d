"""Accuracy over coverage as the temperature varies: the file that ``benchmarks/frontier.py`` writes.

It is JSON, since it holds other columns than results files, which are all ``.csv`` files of a folder.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import write_text

FRONTIER = "frontier.json"
"""Name of the file in a folder of results."""
SUBJECT = ["domain", "suite", "setting", "task", "method", "variant", "temperature", "seed", "n"]
"""Columns that tell one measurement from another; ``temperature`` is missing for reference lines and for methods without one."""
COLUMNS = [*SUBJECT, "accuracy", "novelty", "coverage"]
"""``accuracy`` is the domain's main metric; what was not measured is missing."""


def read_frontier(path: str | Path) -> pd.DataFrame:
    """The measurements of a file, or of the folder that holds it; none where there is no file.

    Raises:
        UserError: for a file of something else.
    """
    path = Path(path)
    path = path / FRONTIER if path.is_dir() else path
    if not path.is_file() or path.suffix != ".json":
        return pd.DataFrame(columns=COLUMNS)
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
        table = pd.DataFrame(rows, columns=COLUMNS)
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: expected rows of {', '.join(COLUMNS)}, found something else ({error!r})") from error
    numbers = ["temperature", "accuracy", "novelty", "coverage"]
    return table.astype(dict.fromkeys(numbers, float))


def write_frontier(path: str | Path, rows: Sequence[dict[str, Any]]) -> None:
    """Add measurements to a file, made if missing; the same ones are replaced. Whole or not at all.

    Args:
        path: the file.
        rows: by :data:`COLUMNS`.
    """
    known = read_frontier(path)
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = pd.concat([known, table], ignore_index=True) if len(known) else table
    table = table.drop_duplicates(SUBJECT, keep="last")
    records = table.astype(object).where(table.notna(), None).to_dict("records")
    lines = ",\n".join(json.dumps(record) for record in records)
    write_text(Path(path), f'{{"rows": [\n{lines}\n]}}\n')
