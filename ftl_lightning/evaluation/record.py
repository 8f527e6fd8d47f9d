"""What an evaluation leaves: rows in a results file, and a table in the terminal."""

from collections.abc import Sequence
from pathlib import Path

from ftl_lightning.evaluation.row import Row
from ftl_lightning.evaluation.summary import OWN, show, summary_table
from ftl_lightning.printing import say


def record(rows: Sequence[Row], results: str | None, folder: str | Path) -> None:
    """Add rows to the results file and show their summary.

    Args:
        rows: of one evaluation; without any, nothing is written or shown.
        results: the file; ``None`` for ``results.csv`` in the folder, which is told.
        folder: the run's log folder.

    Raises:
        UserError: for a file that is none of results, or cannot be written.
    """
    if not rows:
        return
    from ftl_lightning.evaluation.results import append_rows  # pandas, which nothing needs before

    path = results or Path(folder) / "results.csv"
    append_rows(path, list(rows))
    show(summary_table(rows, [row.task for row in rows if row.setting == OWN]))
    if results is None:
        say(f"{path}: {len(rows)} rows")
