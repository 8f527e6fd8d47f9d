"""The report: every table and figure of every domain that has results."""

from pathlib import Path

from ftl_lightning.domains.domain import load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.judged import ACCURACY, CLOSED
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.reporting.figures import accuracy_bars
from ftl_lightning.reporting.tables import EXECUTED, tables
from ftl_lightning.tensor_file import atomic, write_text

BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"
"""What ``report --readme`` writes stands between these lines."""


def write_report(results: Path, out: Path, readme: Path | None = None) -> str:
    """Write Markdown, LaTeX and figures.

    Args:
        results: a results file, or a folder of them.
        out: folder; each domain gets one of its own.
        readme: a Markdown file whose part between two marks is replaced by the main tables.

    Returns:
        All tables as Markdown.

    Raises:
        UserError: if there are no results, or the Markdown file has no marks.
    """
    rows = read_rows(results)
    everything, headline = [], []
    for name in sorted(set(rows["domain"])):
        domain = load_domain(name)
        found = tables(domain, rows)
        for table in found:
            write_text(out / name / f"{table.name}.md", table.markdown())
            write_text(out / name / f"{table.name}.tex", table.latex())
        measured = set(rows.loc[(rows["domain"] == name) & (rows["K"] == 2), "metric"])
        executed = {EXECUTED, f"{CLOSED} {domain.closed_loop.headline}"} if domain.closed_loop else set()
        for metric in sorted(measured & {ACCURACY, *executed, *(one.metric for one in domain.published)}):
            with atomic(out / name / f"{metric.replace(' ', '_')}.png") as temporary:
                accuracy_bars(domain, rows, metric).savefig(temporary, dpi=120)
        everything += [table.markdown() for table in found]
        # Where episodes alone are judged, all that happened in them.
        shown = ("accuracy", "closed_loop" if domain.succeeded else "outcomes", "concept_count")
        headline += [table.markdown() for table in found if table.name in shown]
    if readme:
        _splice(readme, "\n".join(headline))
    return "\n".join(everything)


def _splice(path: Path, text: str) -> None:
    before, begin, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise UserError(f"{path}: expected the lines {BEGIN!r} and {END!r}, found none; add them where the table belongs")
    write_text(path, f"{before}{BEGIN}\n{text}{END}{after}")
