"""Recording an evaluation: rows in a results file and a table in the terminal."""

from collections.abc import Sequence
from pathlib import Path

from ftl_lightning.evaluation.generation import OWN
from ftl_lightning.evaluation.row import Row
from ftl_lightning.evaluation.summary import show, summary_table
from ftl_lightning.services.text import say


def record(rows: Sequence[Row], results: str | None, folder: str | Path) -> None:
    """Add rows to the results file and show their summary.

    Args:
        rows: rows of an evaluation; if empty, nothing is written or shown.
        results: results file; ``None`` for ``results.csv`` in ``folder``, whose path is then printed.
        folder: log folder of the run.

    Raises:
        UserError: for an invalid results file or a write error.
    """
    if not rows:
        return
    from ftl_lightning.evaluation.results import append_rows  # lazy import of pandas

    path = results or Path(folder) / "results.csv"
    append_rows(path, list(rows))
    show(summary_table(rows, [row.task for row in rows if row.setting == OWN]))
    if results is None:
        say(f"{path}: {len(rows)} rows")
