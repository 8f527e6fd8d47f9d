"""The report: tables and figures of every domain with results."""

import re
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from ftl_lightning.domains.comparison import OURS, PAPERS_METHOD
from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.results import CHANGES, COMPARISON, CURVES, METHOD, read_rows, read_study, replaced
from ftl_lightning.reporting.comparison import (
    all_methods,
    compared,
    comparison_table,
    headline_tables,
    methods,
    overview_tables,
    references_table,
    short_overview,
)
from ftl_lightning.reporting.figures import accuracy_bars, comparison_bars, frontier, growth, learning_time, overview_dots
from ftl_lightning.reporting.measurements import FRONTIER, frontier_table, read_frontier, read_speed
from ftl_lightning.reporting.table import Table, domain_of, metrics, of_method, select
from ftl_lightning.reporting.tables import as_learned_most, changes_table, curves_table, tables
from ftl_lightning.services.errors import require, shown
from ftl_lightning.services.files import read_text
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import atomic, write_text
from ftl_lightning.services.text import say

BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"  #: Lines around the text that ``report --readme`` writes.
MOST_DOMAINS, MOST_CELLS = 100, 10_000  #: Maximum number of domains of a report, and of cells of a domain's tables.


def write_report(results: Path, out: Path, readme: Path | None = None) -> str:
    """Write Markdown, LaTeX and figures, and return all tables as Markdown. Raise UserError if there are no results, none that
    tables show, or the Markdown file has no marks.

    Args:
        results: a results file, or a folder of them.
        out: output folder, with a subfolder for each domain and the complete overview.
        readme: a Markdown file whose part between two marks is replaced by the short overview of the comparison, or without a
            comparison by each domain's main table.
    """
    rows = read_rows(results)
    ablations, comparison, curves, changes = (read_study(results, name) for name in ("", COMPARISON, CURVES, CHANGES))
    _check_few(results, (ablations, comparison, curves, changes))
    tempered = read_frontier(results)
    measured = tempered.dropna(subset=["accuracy", "coverage"])
    if count := len(tempered) - len(measured):
        say(f"{results}: {count} rows of {FRONTIER} are left out, which have no accuracy or no coverage")
    if count := replaced(ablations):
        say(f"{results}: {count} rows are left out, since the same was measured again later in another configuration")
    everything, headline = [], []
    names = sorted(set(rows["domain"]))
    with bar("tables and figures", len(names) + 1, lines=False) as advance:
        for name in names:
            domain = domain_of(name, rows)
            domain_tables = _ablations(domain, ablations, out / name)
            headline += domain_tables[:1]
            if name in set(comparison["domain"]):
                domain_tables += _compared(domain, comparison, out / name)
            elif any(method.name != OURS for method in methods(compared(domain, ablations))):
                domain_tables += _compared(domain, as_learned_most(domain, select(ablations, domain=name)), out / name)
            if name in set(curves["domain"]):
                domain_tables.append(_written(curves_table(domain, curves), out / name))
                _save(growth(domain, curves), out / name / "curves.png")
            if name in set(changes["domain"]):
                domain_tables.append(_written(changes_table(domain, changes), out / name))
            if name in set(measured["domain"]):
                _save(frontier(domain, measured), out / name / "frontier.png")
                domain_tables.append(_written(frontier_table(domain, measured), out / name))
            everything += domain_tables
            advance()
        if curve_by_name := read_speed(results):
            _save(learning_time(curve_by_name), out / "speed.png")
        beside = all_methods(comparison, ablations)
        if not beside.empty:
            everything += [_written(table, out) for table in overview_tables(beside)]
            _save(overview_dots(beside), out / "overview.png")
            headline = [short_overview(beside)]
        advance()
    found = ", ".join(sorted(set(select(rows, role=METHOD)["metric"])))
    require(everything or curve_by_name, str(results), "a metric that tables show", f"{found} alone" if found else "none")
    if readme:
        _splice(readme, "\n".join(table.markdown() for table in headline))
    return "\n".join(table.markdown() for table in everything)


def _check_few(results: Path, studies: Sequence[pd.DataFrame]) -> None:
    """Refuse results whose tables would be unreadable and take hours."""
    domains = len({name for rows in studies for name in rows["domain"]})
    require(domains <= MOST_DOMAINS, str(results), f"at most {MOST_DOMAINS} domains", f"{domains}; report fewer files at a time")
    for domain, domain_rows in (group for rows in studies for group in rows.groupby("domain")):
        ours = of_method(domain_rows, PAPERS_METHOD)
        cells = domain_rows["setting"].nunique() * len(domain_rows.groupby(["method", "form", "variant"]))
        cells += ours["setting"].nunique() * ours["variant"].nunique() * ours["K"].nunique() * ours["omega"].nunique()
        expected = f"at most {MOST_CELLS} pairs of a setting and a method"
        require(cells <= MOST_CELLS, f"{results}: domain {shown(domain)}", expected, f"{cells}; report fewer files at a time")


def _ablations(domain: Domain, rows: pd.DataFrame, folder: Path) -> list[Table]:
    """Tables and figures of our method in all its forms."""
    written = [_written(table, folder) for table in tables(domain, rows)]
    measured = set(select(rows, domain=domain.name, role=METHOD)["metric"])
    for metric in sorted(measured & set(metrics(domain))):
        _save(accuracy_bars(domain, rows, metric), folder / f"{_file(metric)}.png")
    return written


def _compared(domain: Domain, rows: pd.DataFrame, folder: Path) -> list[Table]:
    """Tables and figures of all methods of a domain."""
    for metric in sorted(set(metrics(domain)) & set(compared(domain, rows)["metric"])):
        _save(comparison_bars(domain, rows, metric), folder / f"comparison_{_file(metric)}.png")
    candidates = (*headline_tables(domain, rows), comparison_table(domain, rows), references_table(domain, rows))
    return [_written(table, folder) for table in candidates if not table.cells.empty]


def _written(table: Table, folder: Path) -> Table:
    write_text(folder / f"{table.name}.md", table.markdown())
    write_text(folder / f"{table.name}.tex", table.latex())
    return table


def _save(figure: Figure, path: Path) -> None:
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _file(metric: str) -> str:
    """A valid file name, not hidden, for any metric."""
    return re.sub(r"[^\w+-]+", "_", metric).strip("_")[:100] or "_"


def _splice(path: Path, text: str) -> None:
    before, begin, rest = read_text(path, "Markdown").partition(BEGIN)
    _, end, after = rest.partition(END)
    require(begin and end, str(path), f"the lines {BEGIN!r} and {END!r}", "none; add them where the table belongs")
    write_text(path, f"{before}{BEGIN}\n{text}{END}{after}")
