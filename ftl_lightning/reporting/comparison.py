"""Our method against the baselines, each number beside the paper's and their difference."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest

import pandas as pd

from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.paper import CHOSEN, OURS, PAPERS_METHOD, WITH_MODES, Compared, Published
from ftl_lightning.evaluation.results import METHOD, REFERENCE, label, latest
from ftl_lightning.learning.methods import load_method
from ftl_lightning.reporting.paired import leads, least_certain, same_outcome, signed
from ftl_lightning.reporting.shown import (
    domain_of,
    headlines,
    lookup,
    metrics,
    policies,
    published,
    settings,
    training_settings,
)
from ftl_lightning.reporting.tables import (
    MISSING,
    Number,
    Table,
    against,
    difference_to,
    make_table,
    of_method,
    paper,
    select,
    summarise,
)

BASELINES = tuple(load_method(name).name for name in ("bc", "cvae", "in_context", "language"))
"""The paper's, by their names in tables."""
LANGUAGE = BASELINES[-1]
METHODS = (PAPERS_METHOD, Compared(OURS, CHOSEN), Compared(OURS, WITH_MODES), *map(Compared, BASELINES))
"""The order of methods in tables; others come after them."""
ALIKE = 0.9
"""In this share of episodes, at least, a reference policy ends as ours does to be told."""
LINES = 8
"""At most, of the short overview."""


def reference_lines(domain: Domain, results: pd.DataFrame) -> pd.DataFrame:
    """The latest rows of what stands beside all methods: chance, trivial policies and oracles."""
    return latest(select(results, domain=domain.name, role=REFERENCE))


def compared(domain: Domain, results: pd.DataFrame) -> pd.DataFrame:
    """The latest rows of a domain's methods."""
    return latest(select(results, domain=domain.name, role=METHOD))


def methods(rows: pd.DataFrame) -> list[Compared]:
    """The methods among the rows, each in its forms: ours, the paper's baselines, and others as they appear."""
    learned = rows[rows["role"] == METHOD]
    measured = dict.fromkeys(map(Compared, learned["method"], learned["form"]))
    return [method for method in dict.fromkeys((*METHODS, *measured)) if method in measured]


def comparison_table(domain: Domain, results: pd.DataFrame, shown: Sequence[str] = ()) -> Table:
    """One line for each setting, metric and method: measured, its errors, the paper's number, the difference, the paired test.

    Args:
        domain: whose.
        results: with rows of it.
        shown: metrics; those that methods are compared by where none are named.
    """
    rows, references = compared(domain, results), reference_lines(domain, results)
    lines = []
    for setting in settings(domain, rows):
        for metric in shown or metrics(domain):
            method_rows, reference_rows = (select(table, setting=setting, metric=metric) for table in (rows, references))
            names = sorted(set(reference_rows["method"]))
            numbers = [(method, summarise(of_method(method_rows, method))) for method in methods(rows)]
            numbers += [(Compared(name), summarise(select(reference_rows, method=name))) for name in names]
            tested = {
                lead.baseline: [signed(lead.difference), lead.shown]
                for lead in leads(method_rows, domain.ours, rivals(domain, rows, setting), domain.less_is_better(metric))
            }
            for method, number in numbers:
                if number:
                    cells = beside(number, lookup(domain, setting, metric, method=method))
                    lines.append([setting, metric, label(*method), *cells, *tested.get(method, [MISSING, MISSING])])
    caption = f"{domain.name}: all methods{_learned_from(rows)}"
    return make_table(
        domain, "comparison", caption, lines, ["setting", "metric", "method", *BESIDE, "ours is better by", "ours is"]
    )


def _learned_from(rows: pd.DataFrame) -> str:
    counts = sorted(set(rows.loc[rows["demonstrations"] > 0, "demonstrations"]))
    if not counts:
        return ""
    few = "five" if counts == [5] else " to ".join(dict.fromkeys(str(count) for count in (counts[0], counts[-1])))
    return f", learned from {few} demonstrations"


BESIDE = ("measured", "standard error over tasks", "spread over seeds", "paper", "difference")


def beside(number: Number, papers: Published | None) -> list[str]:
    """The columns :data:`BESIDE`."""
    error, spread = (MISSING if value is None else f"{value:.2f}" for value in (number.error, number.spread))
    return [f"{number.mean:.2f}", error, spread, paper(papers), difference_to(papers, number)]


def rivals(domain: Domain, rows: pd.DataFrame, setting: str) -> list[Compared]:
    """The baselines of a setting; of training concepts language is ours, the same model and the same words."""
    same = setting in training_settings(domain)
    return [method for method in methods(rows) if method.name != OURS and not (method.name == LANGUAGE and same)]


def overview(results: pd.DataFrame) -> Table:
    """All domains on one screen: ours and the baselines, the paper's numbers in brackets."""
    columns = methods(results)
    lines = []
    for domain in _domains(results):
        rows, references = compared(domain, results), reference_lines(domain, results)
        for setting in settings(domain, rows):
            for metric in metrics(domain):
                if not select(rows, setting=setting, metric=metric).empty:
                    lines.append(_line(domain, rows, references, setting, metric, columns))
    return _overview(results, lines, columns)


def short_overview(results: pd.DataFrame) -> Table:
    """The overview in at most :data:`LINES` lines: of each domain in turn what says most; modes only where no form is chosen."""
    columns = methods(results)
    if Compared(OURS, CHOSEN) in columns:
        columns = [method for method in columns if method != Compared(OURS, WITH_MODES)]
    lines = {
        domain.name: [
            _line(domain, rows, reference_lines(domain, results), setting, metric, columns)
            for setting, metric in headlines(domain, rows)
        ]
        for domain in _domains(results)
        for rows in [compared(domain, results)]
    }
    shown = [line for turn in zip_longest(*lines.values()) for line in turn if line][:LINES]
    shown.sort(key=lambda line: list(lines).index(line[0]))
    return _overview(results, shown, columns)


def _overview(results: pd.DataFrame, lines: list[list[str]], methods: Sequence[Compared]) -> Table:
    papers = " [the paper's]" if any(map(published, _domains(results))) else ""
    caption = (
        f"Ours and the baselines, mean ± standard error over tasks{papers}; lead: by how much ours is better than the best baseline"
    )
    columns = ["domain", "setting, metric", *(label(*method) for method in methods), "lead", "reference lines"]
    return Table("overview", caption, pd.DataFrame(lines, columns=columns, dtype=str))


def _domains(results: pd.DataFrame) -> list[Domain]:
    return [domain_of(name, results) for name in sorted(set(results["domain"]))]


def _line(
    domain: Domain, rows: pd.DataFrame, references: pd.DataFrame, setting: str, metric: str, columns: Sequence[Compared]
) -> list[str]:
    method_rows, reference_rows = (select(table, setting=setting, metric=metric) for table in (rows, references))
    cells = [_cell(domain, method_rows, method, setting, metric) for method in columns]
    lead = least_certain(leads(method_rows, domain.ours, rivals(domain, rows, setting), domain.less_is_better(metric)))
    agreeing = _agreeing(domain, of_method(select(rows, setting=setting), domain.ours)) if metric == domain.headline else {}
    return [domain.name, f"{setting}, {metric}", *cells, MISSING if lead is None else str(lead), _means(reference_rows, agreeing)]


def _cell(domain: Domain, rows: pd.DataFrame, method: Compared, setting: str, metric: str) -> str:
    number, papers = summarise(of_method(rows, method)), lookup(domain, setting, metric, method=method)
    if number is None:
        return MISSING
    error = "" if number.error is None else f" ± {number.error:.2f}"
    return f"{number.mean:.2f}{error}" + ("" if papers is None else f" [{papers.value:.2f}]")


def _agreeing(domain: Domain, ours: pd.DataFrame) -> dict[str, str]:
    """Of reference policies whose episodes nearly all end as ours do: in how many."""
    counted = {policy: against(ours, policy) for policy in policies(domain)}
    return {
        policy: same_outcome(*counts)
        for policy, counts in counted.items()
        if counts is not None and sum(counts[:2]) <= (1 - ALIKE) * counts[2]
    }


def _means(references: pd.DataFrame, agreeing: Mapping[str, str]) -> str:
    """The mean of each reference line, the least first."""
    means = references.groupby("method")["value"].mean().sort_values()
    named = [(str(name), f"{name} {mean:.2f}") for name, mean in means.items()]
    return ", ".join(text + (f" ({agreeing[name]})" if name in agreeing else "") for name, text in named) or MISSING
