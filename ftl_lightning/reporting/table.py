"""What reports take from a domain, summary numbers of results, and tables in Markdown and LaTeX."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
import pandas as pd

from ftl_lightning.domains.comparison import OURS, PAPERS_METHOD, Compared, Comparison, Published
from ftl_lightning.domains.domain import CLOSED, COVERAGE, EXECUTED, NOVELTY, OWN, Concepts, Domain, Metric, Plans
from ftl_lightning.domains.registry import domain_of_file, is_known
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.generation import LOST, WON, standard_error
from ftl_lightning.evaluation.results import FOLDER
from ftl_lightning.services.errors import UserError, require, shown
from ftl_lightning.services.text import latex, latex_row, markdown, say

MISSING = "-"
PAPERS = ("paper", "difference")  #: Columns of tables of domains with a paper.
MOST_COLUMNS = 8  #: Maximum columns of a table in the documentation.
TRAINING, PAPER = "training", "paper"  #: Suites that come first in reports, if a domain has them.
MORE = "more"  #: Suite of more tasks of the paper's kinds, if a domain has it: enough for a test over tasks.


@dataclass(frozen=True)
class Number:
    """A measured accuracy.

    Attributes:
        mean: mean over tasks and seeds.
        error: standard error over tasks, of the means over seeds; ``None`` for a single task.
        spread: standard deviation over seeds, of the means over tasks; ``None`` for a single seed.
    """

    mean: float
    error: float | None
    spread: float | None

    def __str__(self) -> str:
        spread = "" if self.spread is None else f" (seeds {self.spread:.2f})"
        return f"{self.with_error()}{spread}"

    def with_error(self) -> str:
        """Format without the spread over seeds."""
        return plus_minus(self.mean, self.error)


def plus_minus(mean: float, error: float | None) -> str:
    """Format a mean, and its standard error if there is one."""
    return f"{mean:.2f}" + ("" if error is None else f" ± {error:.2f}")


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
    )


@dataclass(frozen=True)
class Table:
    """A table: name of its files, a sentence, and rows and columns of text."""

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


def make_table(domain: Domain | None, name: str, caption: str, lines: Sequence[Sequence[str]], columns: Sequence[str]) -> Table:
    """A table; of a domain, it lacks the columns :data:`PAPERS` without numbers of a paper for the lines."""
    cells = pd.DataFrame(lines, columns=list(columns), dtype=str)
    if domain and not (published(domain) and any(set(cells[column]) - {MISSING} for column in PAPERS if column in cells)):
        cells = cells.loc[:, ~cells.columns.isin(PAPERS)]
    return Table(name, caption, cells)


def select(rows: pd.DataFrame, **values: object) -> pd.DataFrame:
    """Select rows by values of columns."""
    chosen = np.ones(len(rows), dtype=bool)
    for column, value in values.items():
        chosen &= (rows[column] == value).to_numpy(dtype=bool)
    return rows[chosen]


def of_method(rows: pd.DataFrame, method: Compared) -> pd.DataFrame:
    """Select the rows of a method and form."""
    return select(rows, method=method.name, form=method.form)


def beside_paper(number: Number | None, papers: Published | None) -> list[str]:
    """Cells of the columns :data:`PAPERS`: the paper's number, and ours minus the paper's."""
    if papers is None:
        return [MISSING, MISSING]
    difference = MISSING if number is None else f"{number.mean - papers.value:+.2f}"
    return [plus_minus(papers.value, papers.error), difference]


def domain_of(name: str, rows: pd.DataFrame) -> Domain:
    """Domain of results, made from the rows if it is not installed or of user data. Raise UserError for an invalid name."""
    is_name = re.fullmatch(FOLDER, name)
    require(is_name, "results: column 'domain'", "a name of letters, digits and - . +", shown(name))
    if name != OWN and not is_known(name):
        say(f"domain {name!r} is not installed: its tables are made from the results alone", error=True)
    try:
        return domain_of_file(name)
    except UserError:
        measured = rows.loc[(rows["domain"] == name) & ~rows["metric"].str.startswith((CLOSED, WON, LOST)), "metric"]
        metrics = {metric: Metric(_unknown) for metric in dict.fromkeys(measured) if metric not in (NOVELTY, COVERAGE)}
        comparison = Comparison(headline=next(iter(metrics), EXECUTED))
        concepts = Concepts(training=(), suites={}, descriptions=(), reads=lambda text: False)
        return Domain(name, Plans(0, (), ()), concepts, _unknown, metrics=metrics, comparison=comparison)


def _unknown(*arguments: object) -> NoReturn:
    raise UserError("domain: expected an installed domain, found only its results; install its package")


def _suite(domain: Domain, name: str) -> tuple[str, ...]:
    return domain.concepts.suites[name].settings if name in domain.concepts.suites else ()


def training_settings(domain: Domain) -> tuple[str, ...]:
    """The settings of training concepts."""
    return _suite(domain, TRAINING)


def component_tasks(domain: Domain) -> tuple[EvaluationTask, ...]:
    """Tasks generated from a single component; they have a separate table."""
    return tuple(task for suite in domain.concepts.suites.values() for task in suite.tasks if task.component is not None)


def settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """Settings with results: training settings, the paper's, then others in order of appearance."""
    separate = {task.setting for task in component_tasks(domain)}
    measured = [setting for setting in dict.fromkeys(rows["setting"]) if setting not in separate]
    order = dict.fromkeys((*training_settings(domain), *_suite(domain, PAPER), *measured))
    return [setting for setting in order if setting in measured]


def metrics(domain: Domain) -> tuple[str, ...]:
    """Metrics of the comparison: the main metric, success and failures in closed loop, the headline, and the paper's metrics."""
    executed = [EXECUTED, *(f"{CLOSED} {outcome}" for outcome in domain.closed_loop.less_is_better)] if domain.closed_loop else []
    names = dict.fromkeys(
        (domain.main_metric, *executed, domain.comparison.headline, *(number.metric for number in published(domain)))
    )
    return tuple(name for name in names if name)


def decisive(domain: Domain, rows: pd.DataFrame) -> str:
    """The metric of a small table: the domain's headline, or its main metric if the rows lack the headline."""
    return domain.comparison.headline if domain.comparison.headline in set(rows["metric"]) else domain.main_metric


def policies(domain: Domain) -> Sequence[str]:
    """Reference policies that start from the method's initial states."""
    return tuple(domain.closed_loop.policies) if domain.closed_loop else ()


def published(domain: Domain) -> tuple[Published, ...]:
    """The paper's numbers, if comparable with ours; otherwise tables have no columns for the paper."""
    return domain.comparison.paper.numbers if domain.comparison.paper and domain.comparison.paper.comparable else ()


def main_omega(domain: Domain) -> str:
    """Guidance weight of our main tables; empty for any measured weight."""
    return domain.comparison.paper.ours if domain.comparison.paper else ""


def papers_omega(domain: Domain) -> str:
    """Guidance weight of the paper's main figures; empty without a paper."""
    return domain.comparison.paper.omega if domain.comparison.paper else ""


def lookup(
    domain: Domain,
    setting: str,
    metric: str,
    task: str = "",
    components: int = 2,
    omega: str = "",
    method: Compared = PAPERS_METHOD,
) -> Published | None:
    """The paper's number, or ``None``.

    Args:
        setting, metric, task: as in a row of the results; without a task the mean of the setting.
        components, omega: K and guidance weight as text (empty for that of the paper's main figures); ignored for baselines.
        method: ours, or a baseline; of our forms, only the paper's has numbers.
    """
    learned = (components, omega or papers_omega(domain))
    for number in published(domain):
        same = (number.setting, number.metric, number.task, Compared(number.method)) == (setting, metric, task, method)
        if same and (method.name != OURS or (number.components, number.omega) == learned):
            return number
    return None


def headlines(domain: Domain, rows: pd.DataFrame) -> list[tuple[str, str]]:
    """Settings and metrics of short tables: those with numbers of the paper, the headline, and that of the suite ``more``, closed
    loop first. Without a paper: the first setting of the suite ``paper`` and that of ``more``, else all settings, each with its
    decisive metric.
    """
    measured = set(zip(rows["setting"], rows["metric"], strict=True))
    measured_settings = settings(domain, rows)
    numbers = {
        (number.setting, number.metric)
        for number in published(domain)
        if not number.task and (number.method != OURS or (number.components, number.omega) == (2, papers_omega(domain)))
    }
    if not numbers:
        papers = [setting for setting in measured_settings if setting in _suite(domain, PAPER)][:1]
        papers += [setting for setting in measured_settings if setting in _suite(domain, MORE)]
        shown = papers or measured_settings
        alone = [(setting, decisive(domain, rows[rows["setting"] == setting])) for setting in shown]
        return [headline for headline in alone if headline in measured]
    reported = [(setting, metric) for setting in measured_settings for metric in metrics(domain) if (setting, metric) in numbers]
    executed = [(setting, domain.comparison.headline) for setting in dict.fromkeys(setting for setting, _ in reported)]
    more = [(setting, domain.comparison.headline) for setting in _suite(domain, MORE)]
    found = [headline for headline in dict.fromkeys((*reported, *executed, *more)) if headline in measured]
    return sorted(found, key=lambda headline: not headline[1].startswith(CLOSED))
