"""Files of measurements other than results files: accuracy over learning time, and accuracy over coverage.

The files are JSON, since their columns differ from those of results files, which are all ``.csv`` files of a folder.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from ftl_lightning.domains.comparison import PAPERS_METHOD
from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.results import label
from ftl_lightning.reporting.table import MISSING, Table, make_table, of_method, select
from ftl_lightning.services.errors import UserError, shown
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.services.validation import from_mapping, read_json

T = TypeVar("T")
SPEED = "speed.json"  # file of accuracy over learning time in a folder of results; ``benchmarks/speed/speed.py`` writes it
PUBLISHED, ONE, TEN = "published procedure, one concept", "ours, one concept", "ours, ten concepts together"
"""Names of the curves."""
WITHIN = 0.02  # tolerance below the final accuracy that counts as reached
FRONTIER = "frontier.json"
"""File of accuracy over coverage in a folder of results; ``benchmarks/experiments/frontier.py`` writes it."""
NOISY = "demonstrations with noise"
"""Reference without learning; its temperature is the noise, as a share of the demonstrations' standard deviation."""


def _read(path: str | Path, name: str, key: str, kind: Callable[..., T], expected: str) -> list[T]:
    """Rows of a file, or of the file ``name`` in a folder, under ``key``; empty if there is none, and ``null`` counts as missing.
    Raise UserError for a file without the expected content, naming file and row.
    """
    path = Path(path)
    path = path / name if path.is_dir() else path
    if not path.is_file() or path.suffix != ".json":
        return []
    try:
        content = read_json(path)
        rows = content.get(key) if isinstance(content, dict) else None
        if not isinstance(rows, list):
            raise UserError(f"key {key!r}: expected a list, found {shown(rows)}")
        known = [{name: row[name] for name in row if row[name] is not None} if isinstance(row, dict) else row for row in rows]
        return [from_mapping(kind, row, f"{key}[{number}]") for number, row in enumerate(known)]
    except UserError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise UserError(f"{path}: expected {expected}, found something else ({reason})") from error


@dataclass(frozen=True)
class Measured:
    """A point of a curve: gradient steps (mean over concepts), seconds of learning, and the share of right plans (mean over
    concepts).
    """

    curve: str
    steps: float
    seconds: float
    accuracy: float


def read_speed(path: str | Path) -> dict[str, list[Measured]]:
    """Read the curves of :data:`SPEED` by name; arguments and errors as in :func:`_read`."""
    curves: dict[str, list[Measured]] = {}
    for measured in _read(path, SPEED, "curves", Measured, "curves of steps, seconds and accuracy"):
        curves.setdefault(measured.curve, []).append(measured)
    return curves


def reached(curves: Mapping[str, Sequence[Measured]]) -> float:
    """The accuracy that every curve reaches: minimum of final accuracies, minus :data:`WITHIN`."""
    return min(curve[-1].accuracy for curve in curves.values()) - WITHIN


@dataclass(frozen=True, kw_only=True)
class _FrontierRow:
    """A row of :data:`FRONTIER`."""

    domain: str
    suite: str
    setting: str
    task: str
    method: str
    form: str = ""
    variant: str = ""
    temperature: float = math.nan  # missing for references and methods without temperature
    seed: int
    n: int
    accuracy: float = math.nan  # the domain's main metric
    novelty: float = math.nan
    coverage: float = math.nan


COLUMNS = [field.name for field in fields(_FrontierRow)]
_MEASURES = ["accuracy", "novelty", "coverage"]  # missing if not measured
SUBJECT = [name for name in COLUMNS if name not in _MEASURES]  # columns that identify a measurement


def read_frontier(path: str | Path) -> pd.DataFrame:
    """Read the measurements of :data:`FRONTIER`; arguments and errors as in :func:`_read`."""
    rows = _read(path, FRONTIER, "rows", _FrontierRow, f"rows of {', '.join(COLUMNS)}")
    table = pd.DataFrame(map(asdict, rows), columns=COLUMNS)
    return table.astype(dict.fromkeys(["temperature", *_MEASURES], float)) if rows else table


def write_frontier(path: str | Path, rows: Sequence[dict[str, Any]]) -> None:
    """Add measurements, values by :data:`COLUMNS`, to a file atomically; equal subjects are replaced."""
    known = read_frontier(path)
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = pd.concat([known, table], ignore_index=True) if len(known) else table
    table = table.drop_duplicates(SUBJECT, keep="last")
    records = table.astype(object).where(table.notna(), None).to_dict("records")
    lines = ",\n".join(json.dumps(record) for record in records)
    write_text(Path(path), f'{{"rows": [\n{lines}\n]}}\n')


def accuracy_at(rows: pd.DataFrame, coverage: float) -> float | None:
    """Interpolate the mean accuracy of a method at a coverage, between temperatures; ``None`` outside the measured coverage."""
    means = rows.groupby("temperature")[["coverage", "accuracy"]].mean().sort_values("coverage")
    if means.empty or not means["coverage"].iloc[0] <= coverage <= means["coverage"].iloc[-1]:
        return None
    return float(np.interp(coverage, means["coverage"], means["accuracy"]))


def frontier_table(domain: Domain, rows: pd.DataFrame) -> Table:
    """Accuracy, novelty and coverage of each method at every temperature, and accuracy at the coverage of the paper's form at 1."""
    lines = []
    rows = rows[rows["domain"] == domain.name].dropna(subset=["coverage"])
    for (suite, setting), setting_rows in rows.groupby(["suite", "setting"], sort=False):
        covered = select(of_method(setting_rows, PAPERS_METHOD), temperature=1.0)["coverage"].mean()
        for method, method_rows in setting_rows.groupby(["method", "form"], sort=False):
            equal = accuracy_at(method_rows, covered)
            means = method_rows.groupby("temperature", dropna=False)[_MEASURES].mean().reset_index()
            for temperature, *values in means.to_numpy():
                numbers = [*(f"{value:.2f}" for value in values), "" if equal is None else f"{equal:.2f}"]
                cells = [suite, setting, label(*map(str, method)), f"{temperature:g}", *numbers]
                lines.append([MISSING if cell in ("nan", "") else str(cell) for cell in cells])
    columns = ["suite", "setting", "method", "temperature", *_MEASURES, "accuracy at equal coverage"]
    return make_table(domain, "frontier", f"{domain.name}: accuracy, novelty and coverage (less is better)", lines, columns)
