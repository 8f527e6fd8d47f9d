"""One table: the number behind rows of the results, beside the paper's, and a table as Markdown to read and LaTeX to paste."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.paper import Compared, Published
from ftl_lightning.escape import latex, latex_row, markdown
from ftl_lightning.evaluation.judged import standard_error
from ftl_lightning.reporting.shown import published

MISSING = "-"
MOST_COLUMNS = 8
"""Of a table that a page of the documentation can show."""


@dataclass(frozen=True)
class Number:
    """A measured accuracy.

    Attributes:
        mean: over tasks and seeds.
        error: standard error over tasks, of the means over seeds; ``None`` for a single task.
        spread: standard deviation over seeds, of the means over tasks; ``None`` for a single seed.
        seeds: how many.
    """

    mean: float
    error: float | None
    spread: float | None
    seeds: int

    def __str__(self) -> str:
        spread = "" if self.spread is None else f" (seeds {self.spread:.2f})"
        return f"{self.with_error()}{spread}"

    def with_error(self) -> str:
        """Without the spread over seeds."""
        return f"{self.mean:.2f}" + ("" if self.error is None else f" ± {self.error:.2f}")


def summarise(rows: pd.DataFrame) -> Number | None:
    """The number behind some rows of the results, or ``None`` for no rows."""
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
        name: of its files.
        caption: one sentence.
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
    """The rows with these values in their columns."""
    chosen = np.ones(len(rows), dtype=bool)
    for column, value in values.items():
        chosen &= (rows[column] == value).to_numpy(dtype=bool)
    return rows[chosen]


def of_method(rows: pd.DataFrame, method: Compared) -> pd.DataFrame:
    """The rows of a method in one of its forms."""
    return select(rows, method=method.name, form=method.form)


def paper(papers: Published | None) -> str:
    """The paper's number with its standard error."""
    if papers is None:
        return MISSING
    return f"{papers.value:.2f}" + ("" if papers.error is None else f" ± {papers.error:.2f}")


def difference_to(papers: Published | None, number: Number | None) -> str:
    """Ours less the paper's."""
    return MISSING if papers is None or number is None else f"{number.mean - papers.value:+.2f}"


PAPERS = ("paper", "difference")
"""Columns that tables of domains without a paper do not have."""


def make_table(domain: Domain, name: str, caption: str, lines: Sequence[Sequence[str]], columns: Sequence[str]) -> Table:
    """A table, without the paper's columns where the domain has no numbers of a paper, or none for any of the lines."""
    cells = pd.DataFrame(lines, columns=list(columns), dtype=str)
    told = bool(published(domain)) and any(set(cells[name]) - {MISSING} for name in PAPERS if name in cells)
    return Table(name, caption, cells if told else cells.loc[:, ~cells.columns.isin(PAPERS)])
