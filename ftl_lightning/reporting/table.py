"""Summary numbers of results, and tables in Markdown and LaTeX."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.paper import Compared, Published
from ftl_lightning.evaluation.judged import standard_error
from ftl_lightning.reporting.shown import published
from ftl_lightning.services.text import latex, latex_row, markdown

MISSING = "-"
MOST_COLUMNS = 8
"""Maximum columns of a table in the documentation."""


@dataclass(frozen=True)
class Number:
    """A measured accuracy.

    Attributes:
        mean: mean over tasks and seeds.
        error: standard error over tasks, of the means over seeds; ``None`` for a single task.
        spread: standard deviation over seeds, of the means over tasks; ``None`` for a single seed.
        seeds: number of seeds.
    """

    mean: float
    error: float | None
    spread: float | None
    seeds: int

    def __str__(self) -> str:
        spread = "" if self.spread is None else f" (seeds {self.spread:.2f})"
        return f"{self.with_error()}{spread}"

    def with_error(self) -> str:
        """Format without the spread over seeds."""
        return f"{self.mean:.2f}" + ("" if self.error is None else f" ± {self.error:.2f}")


def summarise(rows: pd.DataFrame) -> Number | None:
    """Summarise rows of the results; ``None`` for no rows."""
    if rows.empty:
        return None
    by_task = rows.groupby("task")["value"].mean()
    by_seed = rows.groupby("seed")["value"].mean()
    return Number(
        mean=float(by_task.mean()),
        error=standard_error(by_task.tolist()) if len(by_task) > 1 else None,
        spread=float(by_seed.std()) if len(by_seed) > 1 else None,
        seeds=len(by_seed),
    )


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: name of its files.
        caption: a sentence.
        cells: rows and columns of text.
    """

    name: str
    caption: str
    cells: pd.DataFrame

    def markdown(self) -> str:
        """GitHub's Markdown, caption first."""
        head, *rows = (list(map(markdown, row)) for row in self._rows())
        lines = [head, ["---"] * len(head), *rows]
        return f"**{markdown(self.caption)}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def latex(self) -> str:
        """A booktabs table."""
        head, *rows = map(latex_row, self._rows())
        columns = "l" + "c" * (len(self.cells.columns) - 1)
        body = "\n".join((head, r"\midrule", *rows))
        return (
            f"\\begin{{table}}\n\\caption{{{latex(self.caption)}}}\n\\begin{{tabular}}{{{columns}}}\n\\toprule\n{body}\n"
            "\\bottomrule\n\\end{tabular}\n\\end{table}\n"
        )

    def _rows(self) -> list[list[str]]:
        return [list(map(str, self.cells.columns)), *self.cells.to_numpy().tolist()]


def select(rows: pd.DataFrame, **values: object) -> pd.DataFrame:
    """Select rows by values of columns."""
    chosen = np.ones(len(rows), dtype=bool)
    for column, value in values.items():
        chosen &= (rows[column] == value).to_numpy(dtype=bool)
    return rows[chosen]


def of_method(rows: pd.DataFrame, method: Compared) -> pd.DataFrame:
    """Select the rows of a method in one form."""
    return select(rows, method=method.name, form=method.form)


def paper(papers: Published | None) -> str:
    """Format the paper's number with its standard error."""
    if papers is None:
        return MISSING
    return f"{papers.value:.2f}" + ("" if papers.error is None else f" ± {papers.error:.2f}")


def difference_to(papers: Published | None, number: Number | None) -> str:
    """Format ours minus the paper's."""
    return MISSING if papers is None or number is None else f"{number.mean - papers.value:+.2f}"


PAPERS = ("paper", "difference")
"""Columns of tables of domains with a paper."""


def make_table(domain: Domain, name: str, caption: str, lines: Sequence[Sequence[str]], columns: Sequence[str]) -> Table:
    """A table; without numbers of a paper for the lines, it lacks the paper's columns."""
    cells = pd.DataFrame(lines, columns=list(columns), dtype=str)
    with_paper = bool(published(domain)) and any(set(cells[name]) - {MISSING} for name in PAPERS if name in cells)
    return Table(name, caption, cells if with_paper else cells.loc[:, ~cells.columns.isin(PAPERS)])
