"""Summary of an evaluation for the terminal and TensorBoard."""

import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ftl_lightning.domains.comparison import CHOSEN
from ftl_lightning.domains.domain import COVERAGE, NOVELTY
from ftl_lightning.domains.domain import OWN as OWN_DOMAIN
from ftl_lightning.evaluation.generation import LOST, OWN, WON, Evaluable, standard_error
from ftl_lightning.evaluation.results import METHOD, REFERENCE, Row, append_rows, label, public
from ftl_lightning.services.errors import short
from ftl_lightning.services.text import line, markdown, say

if TYPE_CHECKING:
    import lightning.pytorch as pl

DIVERSITY = (NOVELTY, COVERAGE)
LONGEST_TASKS = 100
"""Maximum length of the list of tasks in the HPARAMS tab."""
NAMED = ("model/components", "model/omega", "model/guidance", "model/seed", "model/form", "data/domain", "data/seed", "data/steps")
"""Options with a named column in the HPARAMS tab."""


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
    path = results or Path(folder) / "results.csv"
    append_rows(path, rows)
    show(summary_table(rows, [row.task for row in rows if row.setting == OWN]))
    if results is None:
        say(f"{path}: {len(rows)} rows")


def hparams_of(
    module: Evaluable, data: "pl.LightningDataModule", settings: Mapping[str, Any], trainer: "pl.Trainer", rows: Sequence[Row]
) -> dict[str, Any]:
    """Columns of the HPARAMS tab, without hashes.

    Columns of other options begin with "with", as TensorBoard shows the first five by name.

    Args:
        module: evaluated module.
        data: training or test data.
        settings: settings of the evaluator.
        trainer: trainer.
        rows: rows of the method; not empty.
    """
    first = rows[0]
    groups = {"model": public(module.hparams), "data": public(data.hparams), "evaluation": settings}
    groups["trainer"] = getattr(trainer, "unusual", {})
    options = {f"{group}/{key}": value for group, values in groups.items() for key, value in values.items()}
    return {
        "domain": first.domain,
        "method": first.method,
        "K": first.K,
        "omega": _number(first.omega),
        "form": first.form or "usual",
        "seed": first.seed,
        "steps": data.hparams.get("steps", trainer.max_steps),
        "tasks": short(", ".join(dict.fromkeys(row.task for row in rows)), LONGEST_TASKS),
        "variant": first.variant,
        **{f"with {name}": value for name, value in options.items() if name not in NAMED},
    }


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def own_rows(rows: Sequence[Row]) -> list[Row]:
    """Rows of the method without references and paired comparisons."""
    return [row for row in rows if row.role == METHOD and not row.metric.startswith((WON, LOST))]


def summary_table(rows: Sequence[Row], single: Sequence[str] = ()) -> Table:
    """Summarise an evaluation: a line for each task in ``single``, then the mean of each setting.

    Lines with a dash are the references of the same tasks. Errors are standard errors over tasks; a single task has none. The
    column n is the number of tasks x samples per task.

    Args:
        rows: rows of an evaluation, see :func:`ftl_lightning.evaluation.results.rows`.
        single: names of tasks with a separate line, for example the concepts of user demonstrations.
    """
    measured = own_rows(rows)
    metrics = list(dict.fromkeys(row.metric for row in measured))
    metrics.sort(key=lambda name: DIVERSITY.index(name) if name in DIVERSITY else -1)  # diversity last
    table = Table(title=literal(_title(measured), "table.title"), box=box.SIMPLE, title_justify="left", padding=0)
    table.add_column("mean ± error over tasks")
    for name in (*metrics, "n"):
        table.add_column(literal(name), justify="right")
    # Single tasks first, in order; they are excluded from their setting's mean.
    order = {name: number for number, name in enumerate(single)}
    task_rows = sorted((row for row in measured if row.task in order), key=lambda row: order[row.task])
    subjects = dict.fromkeys(_subject(row, single) for row in (*task_rows, *(row for row in measured if row.task not in order)))
    for subject in subjects:
        method_rows = [row for row in measured if _subject(row, single) == subject]
        table.add_row(literal(_name(method_rows, single)), *(_mean(method_rows, name) for name in metrics), _samples(method_rows))
        references = [row for row in rows if row.role == REFERENCE and _subject(row, single) == subject]
        for name in dict.fromkeys(row.method for row in references):
            reference_rows = [row for row in references if row.method == name]
            table.add_row(literal(f"- {name}"), *(_mean(reference_rows, metric, False) for metric in metrics), "", style="dim")
    return table


def _subject(row: Row, single: Sequence[str]) -> tuple[str, str]:
    """Setting and single task of a line; the task is empty for a whole setting."""
    return (row.setting, row.task if row.task in single else "")


def _name(rows: Sequence[Row], single: Sequence[str]) -> str:
    setting, task = rows[0].setting, rows[0].task
    if task in single:
        return task if setting == OWN else f"{task} ({setting})"
    return setting


def _title(rows: Sequence[Row]) -> str:
    if not rows:
        return "nothing was evaluated"
    row = rows[0]
    if row.domain == OWN_DOMAIN and CHOSEN in row.form:  # each form that may be chosen has a K and weights of its own
        return f"{row.domain}: {label(row.method, row.form, row.variant)}"
    components = f", K = {row.K}" if row.K else ""
    weight = "" if row.omega == "none" else ", learned weights" if row.omega == "learned" else f", omega {row.omega}"
    return f"{row.domain}: {label(row.method, row.form, row.variant)}{components}{weight}"


def _mean(rows: Sequence[Row], metric: str, error: bool = True) -> str:
    values = [row.value for row in rows if row.metric == metric]
    if not values:
        return ""
    spread = f" ± {standard_error(values):.2f}" if error and len(values) > 1 else ""
    return f"{sum(values) / len(values):.2f}{spread}"


def _samples(rows: Sequence[Row]) -> str:
    """Number of tasks and of samples per task."""
    counts = sorted({row.n for row in rows})
    samples = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
    tasks = len({row.task for row in rows})
    return f"{tasks}x{samples}" if tasks > 1 else samples


def literal(text: str, style: str = "") -> Text:
    """Cell with literal text: names come from files, and rich would interpret words in brackets as markup."""
    return Text(line(text), style)


def plain(table: Table) -> str:
    """Format a table as Markdown of unlimited width, for log files, pipes and TensorBoard."""
    in_markdown = Table(box=box.MARKDOWN, padding=(0, 1, 0, 1))
    for column in table.columns:
        in_markdown.add_column(Text(markdown(str(column.header))), justify=column.justify)
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        in_markdown.add_row(*(Text(markdown(str(cell))) for cell in cells))
    file = io.StringIO()
    Console(file=file, width=100_000, color_system=None).print(in_markdown)
    return "\n".join([markdown(str(table.title)), *(row.rstrip() for row in file.getvalue().rstrip().splitlines())])


def show(table: Table) -> None:
    """Print a table in the terminal's width, or without a terminal as :func:`plain`."""
    if sys.stdout.isatty():
        Console().print(table)
    else:
        say(plain(table))
