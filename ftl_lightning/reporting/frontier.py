"""Accuracy over coverage as the temperature varies: the file that ``benchmarks/experiments/frontier.py`` writes.

The file is JSON, since its columns differ from results files, which are all ``.csv`` files of a folder.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.paper import PAPERS_METHOD
from ftl_lightning.evaluation.results import label
from ftl_lightning.reporting.listed import read_listed
from ftl_lightning.reporting.table import MISSING, Table, make_table, of_method, select
from ftl_lightning.services.tensor_file import write_text

FRONTIER = "frontier.json"
"""Name of the file in a folder of results."""
NOISY = "demonstrations with noise"
"""A line without learning; its temperature is the noise, as a share of the demonstrations' standard deviation."""
SUBJECT = ["domain", "suite", "setting", "task", "method", "form", "variant", "temperature", "seed", "n"]
"""Columns that identify a measurement; ``temperature`` is missing for reference lines and methods without temperature."""
COLUMNS = [*SUBJECT, "accuracy", "novelty", "coverage"]
"""All columns; ``accuracy`` is the domain's main metric; missing if not measured."""


_NUMBERS = ["temperature", "accuracy", "novelty", "coverage"]


@dataclass(frozen=True)
class _Row:
    """A row of the file, for validation."""

    domain: str
    suite: str
    setting: str
    task: str
    method: str
    seed: int
    n: int
    form: str = ""
    variant: str = ""
    temperature: float = math.nan
    accuracy: float = math.nan
    novelty: float = math.nan
    coverage: float = math.nan


def read_frontier(path: str | Path) -> pd.DataFrame:
    """Read the measurements of a file, or of its folder; empty if there is no file.

    Raises:
        UserError: for an invalid file, naming file and row.
    """
    path = Path(path)
    path = path / FRONTIER if path.is_dir() else path
    if not path.is_file() or path.suffix != ".json":
        return pd.DataFrame(columns=COLUMNS)
    rows = [asdict(row) for row in read_listed(path, "rows", _Row, f"rows of {', '.join(COLUMNS)}")]
    return pd.DataFrame(rows, columns=COLUMNS).astype(dict.fromkeys(_NUMBERS, float))


def accuracy_at(rows: pd.DataFrame, coverage: float) -> float | None:
    """Interpolate the accuracy of a method at a coverage, between measured temperatures.

    Args:
        rows: rows of a method and suite; averaged over tasks and seeds.
        coverage: the coverage.

    Returns:
        Accuracy; ``None`` outside the measured coverage.
    """
    means = rows.groupby("temperature")[["coverage", "accuracy"]].mean().sort_values("coverage")
    if means.empty or not means["coverage"].iloc[0] <= coverage <= means["coverage"].iloc[-1]:
        return None
    return float(np.interp(coverage, means["coverage"], means["accuracy"]))


def frontier_table(domain: Domain, rows: pd.DataFrame) -> Table:
    """Accuracy, novelty and coverage of each method at every temperature, and its accuracy at the coverage of ours at temperature 1
    with one set of embeddings.

    Args:
        domain: the domain.
        rows: see :func:`read_frontier`.
    """
    lines = []
    rows = rows[rows["domain"] == domain.name].dropna(subset=["coverage"])
    for (suite, setting), setting_rows in rows.groupby(["suite", "setting"], sort=False):
        covered = select(of_method(setting_rows, PAPERS_METHOD), temperature=1.0)["coverage"].mean()
        for method, method_rows in setting_rows.groupby(["method", "form"], sort=False):
            equal = accuracy_at(method_rows, covered)
            means = method_rows.groupby("temperature", dropna=False)[["accuracy", "novelty", "coverage"]].mean().reset_index()
            for values in means.to_numpy():
                numbers = [*(f"{value:.2f}" for value in values[1:]), "" if equal is None else f"{equal:.2f}"]
                cells = [suite, setting, label(*map(str, method)), f"{values[0]:g}", *numbers]
                lines.append([MISSING if cell in ("nan", "") else str(cell) for cell in cells])
    columns = ["suite", "setting", "method", "temperature", "accuracy", "novelty", "coverage", "accuracy at equal coverage"]
    return make_table(domain, "frontier", f"{domain.name}: accuracy, novelty and coverage (less is better)", lines, columns)


def write_frontier(path: str | Path, rows: Sequence[dict[str, Any]]) -> None:
    """Add measurements to a file atomically; equal subjects are replaced.

    Args:
        path: the file; created if missing.
        rows: values by :data:`COLUMNS`.
    """
    known = read_frontier(path)
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = pd.concat([known, table], ignore_index=True) if len(known) else table
    table = table.drop_duplicates(SUBJECT, keep="last")
    records = table.astype(object).where(table.notna(), None).to_dict("records")
    lines = ",\n".join(json.dumps(record) for record in records)
    write_text(Path(path), f'{{"rows": [\n{lines}\n]}}\n')
