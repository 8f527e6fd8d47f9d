"""Results files: a row for every measured value, with a hash that identifies the evaluated configuration."""

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.generation import Evaluable, TaskResult, demonstrations_of, paired, share
from ftl_lightning.services.errors import UserError, about, require, short, shown
from ftl_lightning.services.files import MOST_TEXT, check_readable
from ftl_lightning.services.tensor_file import alone, atomic, content_hash, file_hash, visible
from ftl_lightning.version import __version__

if TYPE_CHECKING:
    import lightning.pytorch as pl
    import pandas as pd

METHOD, REFERENCE = "method", "reference"
"""Roles: methods, and references (chance, trivial policies, oracles)."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A measured value.

    Attributes:
        domain, setting, task: evaluated task.
        method: name of the method, for example ``'FTL-IGM'`` or ``'BC'``, or of the reference.
        form: form of the method, see :class:`~ftl_lightning.domains.comparison.Compared`; empty for the paper's.
        variant: label of settings of the same method and form, for example ``'entities, free'``; may be empty.
        role: :data:`METHOD` or :data:`REFERENCE`.
        K: number of concept components in the settings, also for training concepts; 0 without components.
        omega: fixed guidance weight as text, ``'learned'``, or ``'none'`` for a method without; empty for a reference.
        demonstrations: number of demonstrations of the task's concept; 0 without learning.
        seed: seed of pretraining and inversion.
        n: number of samples or episodes behind the value.
        metric: name of the metric, for example ``'accuracy'``.
        value: measured value.
        model_hash: hash of the pretrained model.
        config_hash: :func:`config_hash` of the configuration; equal hashes imply equal values.
        version: version of this package.
    """

    domain: str
    setting: str
    task: str
    method: str
    form: str = ""
    variant: str = ""
    role: str = METHOD
    K: int
    omega: str
    demonstrations: int
    seed: int
    n: int
    metric: str
    value: float
    model_hash: str
    config_hash: str
    version: str = __version__


def label(method: str, form: str = "", variant: str = "") -> str:
    """Label in tables and legends: name and form of the method, and its variant in brackets."""
    name = f"{method} {form}".strip()
    return f"{name} ({variant})" if variant else name


HASH_VERSION = 2
"""Version of :func:`configuration`. Raise it with every change of the description, and rewrite committed results by
``benchmarks/making/rehash.py``."""


NEWER = {"discount": 1.0}
"""Options that are younger than the first results, with the value that has no effect and is not part of a configuration."""


def public(hparams: Mapping[str, Any]) -> dict[str, Any]:
    """Hyper-parameters without the private keys of Lightning's command line."""
    return {key: value for key, value in hparams.items() if not key.startswith("_")}


def configuration(
    module: Evaluable, data: "pl.LightningDataModule", settings: Mapping[str, Any], trainer: "pl.Trainer | None" = None
) -> dict[str, Any]:
    """Description of an evaluated configuration: every option that values depend on, defaults included.

    Folders and reports are not part of it; the pretrained model and files of demonstrations are given by their hash.

    Args:
        module: evaluated module.
        data: training data.
        settings: settings of the evaluator.
        trainer: trainer; its :attr:`~ftl_lightning.training.trainer.Trainer.unusual` options affect learned concepts. They are
            excluded for pretraining, whose result the model's hash identifies.
    """
    domain, model, options = module.model.domain, public(module.hparams), public(data.hparams)
    files = {key: options[key] and _identity(options[key]) for key in ("demonstrations", "more") if key in options}
    groups: dict[str, Mapping[str, Any]] = {
        "model": {key: value for key, value in model.items() if key not in ("pretrained", "output") and NEWER.get(key) != value},
        "data": {key: value for key, value in options.items() if key not in ("domain", "root", "check")} | files,
        "evaluation": settings,
        "trainer": getattr(trainer, "unusual", {}) if "pretrained" in model else {},
        # Values of trained metrics depend on their weights.
        "metric": {name: metric.identity for name, metric in domain.metrics.items() if metric.identity},
    }
    loop = domain.closed_loop
    return {
        "domain": domain.name,
        "method": module.method,
        **{f"{group}/{key}": value for group, values in groups.items() for key, value in values.items()},
        "model/pretrained": module.model.hash,
        "environment": loop.identity if loop and settings.get("replan") else "",
    }


def _identity(demonstrations: str) -> str:
    """Hash of a file; the name of an installed data set includes its version."""
    return file_hash(demonstrations) if Path(demonstrations).is_file() else demonstrations


def config_hash(described: Mapping[str, Any]) -> str:
    """Versioned hash of a description, such as ``'2:0123456789abcdef'``."""
    return f"{HASH_VERSION}:{content_hash({**described, 'version': __version__})}"


def rows(
    module: Evaluable,
    domain: Domain,
    judged: Sequence[TaskResult],
    references: Mapping[str, Sequence[TaskResult]],
    configured: Mapping[str, Any],
    variant: str | None = None,
) -> list[Row]:
    """Rows of an evaluation: the method, its paired comparison with policies, and the references.

    Args:
        module: evaluated module.
        domain: domain of the tasks.
        judged: behaviour of the method.
        references: behaviour of the references, by name.
        configured: see :func:`configuration`.
        variant: label of the run in tables; ``None`` for the module's label.
    """
    hparams = module.hparams
    learned = {
        "method": module.method,
        "form": module.form,
        "variant": module.variant if variant is None else variant,
        "K": hparams.get("components", 0),
        "omega": str(hparams.get("omega", hparams.get("guidance", "none"))),
        "model_hash": module.model.hash,
        "config_hash": config_hash(configured),
    }
    unlearned = {"role": REFERENCE, "K": 0, "omega": "", "model_hash": "", "config_hash": reference_hash(configured)}

    def task_rows(behaviour: TaskResult, source: Mapping[str, Any], values: Mapping[str, float]) -> Iterator[Row]:
        task = behaviour.task
        subject = {"domain": domain.name, "setting": task.setting, "task": task.name, "seed": hparams["seed"]}
        # Reference policies use demonstrations, reference plans do not.
        learns = source["method"] not in domain.comparison.references
        demonstrations = demonstrations_of(task, module.demonstrated) if learns else None
        subject["demonstrations"] = 0 if demonstrations is None else len(demonstrations)
        for name, value in values.items():
            yield Row(**subject, **source, n=len(behaviour.states), metric=name, value=round(value, 6))

    measured = [row for behaviour in judged for row in task_rows(behaviour, learned, behaviour.values)]
    for policy in domain.closed_loop.policies if domain.closed_loop else ():
        for reference in references.get(policy, ()):
            for behaviour in judged:
                if behaviour.task == reference.task:
                    compared = paired(behaviour, reference, policy, domain)
                    measured += task_rows(behaviour, learned, {metric: share(episodes) for metric, episodes in compared.items()})
    for name, behaviours in references.items():
        for behaviour in behaviours:
            measured += task_rows(behaviour, unlearned | {"method": name}, behaviour.values)
    return measured


def reference_hash(configured: Mapping[str, Any]) -> str:
    """Hash of what the values of references depend on, besides task and seed of the row."""
    keys = ("domain", "environment", "evaluation/samples", "evaluation/sample_seed")
    return config_hash({key: value for key, value in configured.items() if key in keys or key.startswith("metric/")})


FOLDER = r"\w[\w .+-]{0,99}"
"""Pattern of domain names, which are folder names in a report."""
MOST_CELLS = 10_000
"""Maximum number of cells in a row of a results file, for a fast refusal of other files."""
LARGEST_WHOLE = 2**53
"""Maximum integer, including seeds."""
COLUMNS = [field.name for field in fields(Row)]
_WHOLE = [field.name for field in fields(Row) if field.type is int]
_MAYBE_EMPTY = ("setting", "task", "form", "variant", "omega", "model_hash")
_TEXT = {field.name: object for field in fields(Row) if field.type is str}  # faster selection than pandas's strings
_SUBJECT = ["domain", "setting", "task", "method", "form", "variant", "role", "K", "omega", "demonstrations", "seed", "metric"]
_KEY = [*_SUBJECT, "n", "config_hash"]
"""Columns that identify a measurement; a newer row with equal values replaces an older row."""
COMPARISON, CURVES, CHANGES, PAPER_SIZE = "comparison", "curves", "changes", "paper_size"
"""Names of results files that are not ablations: all methods; numbers of demonstrations and components; our method without each of
its changes to the paper's form; models of the paper's size, which have no separate table."""


def append_rows(path: str | Path, rows: Sequence[Row]) -> None:
    """Add rows to a results file atomically, creating it if missing and replacing equal measurements."""
    import pandas as pd  # slow to import

    add_rows(path, pd.DataFrame([asdict(row) for row in rows], columns=COLUMNS))


def add_rows(path: str | Path, table: "pd.DataFrame") -> None:
    """Add rows of a table with :data:`COLUMNS` atomically, replacing equal measurements.

    A lock serialises processes that write to the same folder.
    """
    import pandas as pd

    path = Path(path)
    with alone(path.parent):
        if path.is_file():
            existing = read_rows(path)
            table = existing if table.empty else pd.concat([existing, table])
        with atomic(path) as temporary:
            table.drop_duplicates(_KEY, keep="last").to_csv(temporary, index=False)


def labels(rows: "pd.DataFrame") -> "pd.Series":
    """:func:`label` of each row."""
    import pandas as pd

    names = zip(rows["method"], rows["form"], rows["variant"], strict=True)
    return pd.Series([label(*row_names) for row_names in names], rows.index, dtype=str)


def latest(rows: "pd.DataFrame") -> "pd.DataFrame":
    """Keep the last of the rows that differ only in the number of samples and the configuration."""
    return rows.drop_duplicates(_SUBJECT, keep="last")


def replaced(rows: "pd.DataFrame") -> int:
    """Number of rows that :func:`latest` removes: subjects measured again later in another configuration."""
    return len(rows) - len(latest(rows))


def read_rows(path: str | Path) -> "pd.DataFrame":
    """Read a results file, or all ``.csv`` files of a folder.

    Raises:
        UserError: for a missing file, or a file with wrong columns or an invalid cell.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: expected a results file or a folder of them, found nothing; invert writes one to its log folder")
    if not (files := _files(path)):
        raise UserError(f"{path}: expected results (.csv files), found none; run: make run")
    return _read_all(files)


def read_study(path: str | Path, name: str = "") -> "pd.DataFrame":
    """Read the files named ``name`` in a folder, or without a name all ablations. The table may be empty.

    Raises:
        UserError: for a missing file, or a file with wrong columns or an invalid cell.
    """
    others = (COMPARISON, CURVES, CHANGES, PAPER_SIZE)
    return _read_all([file for file in _files(Path(path)) if (file.stem == name if name else file.stem not in others)])


def _files(path: Path) -> list[Path]:
    """The file, or the results files below a folder, ``invert_2`` before ``invert_10``."""
    if not path.is_dir():
        return [path]
    # Every second part is a number, so numbers are only compared with numbers.
    parts = {file: re.split(r"(\d+)", file.as_posix()) for file in visible(path, "**/*.csv")}
    return sorted(parts, key=lambda file: [int(part) if part.isdigit() else part for part in parts[file]])


def _read_all(files: Sequence[Path]) -> "pd.DataFrame":
    import pandas as pd

    tables = []
    for file in files:
        with about(file):
            tables.append(_read(file))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=COLUMNS)


def _read(file: Path) -> "pd.DataFrame":
    import pandas as pd

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


def _table(file: Path, kinds: Any) -> "pd.DataFrame":
    import pandas as pd

    check_readable(file, "results", MOST_TEXT)
    with file.open("rb") as lines:
        most = max((line.count(b",") + 1 for line in lines), default=0)
    require(most <= MOST_CELLS, "rows", f"at most {MOST_CELLS} cells in each", str(most))
    try:
        return pd.read_csv(file.absolute(), dtype=kinds, keep_default_na=False, compression=None)
    except (OSError, ValueError, OverflowError, MemoryError, csv.Error) as error:
        raise UserError(f"expected a results file, found something else ({short(str(error), 100)})") from error


def _bad_cell(table: "pd.DataFrame") -> tuple[int, str, str] | None:
    """Row, column and expected content of the first invalid cell; ``None`` if all are valid."""
    import pandas as pd

    for name, values in table.items():
        numbers = pd.to_numeric(values.astype(str), errors="coerce") if name not in _TEXT else pd.Series(dtype=float)
        if name == "role":
            good, expected = values.isin((METHOD, REFERENCE)), f"{METHOD} or {REFERENCE}"
        elif name == "domain":
            good, expected = values.str.fullmatch(FOLDER), "a name of letters, digits and - . +"
        elif name in _TEXT:
            good, expected = values.notna() & ((values != "") | (name in _MAYBE_EMPTY)), "a text"
        elif name in _WHOLE:
            good, expected = numbers.between(0, LARGEST_WHOLE) & (numbers % 1 == 0), f"a whole number up to {LARGEST_WHOLE}"
        else:
            good, expected = numbers.abs() < math.inf, "a finite number"
        if not good.all():
            return int((~good).to_numpy().argmax()), str(name), expected
        if name not in _TEXT and len(values) and values.dtype.kind not in ("iu" if name in _WHOLE else "iuf"):
            return 0, str(name), expected  # numbers in another notation
    return None
