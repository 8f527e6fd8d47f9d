"""Our method against the baselines, each number beside the paper's and the difference."""

from collections.abc import Sequence
from itertools import zip_longest
from operator import itemgetter

import pandas as pd

from ftl_lightning.domains.comparison import CHOSEN, FINE_TUNED, OURS, PAPERS_METHOD, WITH_MODES, Compared
from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.references import FRESH
from ftl_lightning.evaluation.results import METHOD, REFERENCE, label, latest
from ftl_lightning.reporting.paired import Lead, leads, least_certain, same_outcome
from ftl_lightning.reporting.table import (
    MISSING,
    MOST_COLUMNS,
    PAPERS,
    Number,
    Table,
    beside_paper,
    domain_of,
    headlines,
    lookup,
    make_table,
    metrics,
    of_method,
    policies,
    published,
    select,
    settings,
    summarise,
    training_settings,
)
from ftl_lightning.reporting.tables import against, as_learned_most
from ftl_lightning.services.shipped import topic
from ftl_lightning.training.method import load_method

BASELINES = tuple(load_method(name).name for name in ("bc", "cvae", "in_context", "language"))  # names of the paper's baselines
LANGUAGE = BASELINES[-1]
METHODS = (PAPERS_METHOD, Compared(OURS, CHOSEN), Compared(OURS, WITH_MODES), *map(Compared, BASELINES), Compared(FINE_TUNED))
"""Order of methods in tables; our other forms follow ours, other methods come last."""
ALIKE = 0.9  # minimum share of episodes with our outcome for which a reference policy is annotated
LINES, EACH = 8, 2  # maximum number of lines of the short overview, and of each domain
ORACLE = "(oracle)"  # in the names of references that know the right behaviour
MEASURED = ("measured", "spread over seeds")  # columns of a number in the comparison


def all_methods(comparison: pd.DataFrame, ablations: pd.DataFrame) -> pd.DataFrame:
    """Rows of all domains with a measured baseline: of the comparison, or of the most measured configurations in ablations."""
    compared_domains = set(comparison["domain"])
    others = [
        as_learned_most(domain_of(str(name), rows), rows)
        for name, rows in ablations.groupby("domain")
        if name not in compared_domains and set(rows["method"]) & set(BASELINES)
    ]
    return pd.concat([comparison, *others], ignore_index=True) if others else comparison


def reference_lines(domain: Domain, results: pd.DataFrame) -> pd.DataFrame:
    """The latest rows of references: chance, trivial policies and oracles."""
    return latest(select(results, domain=domain.name, role=REFERENCE))


def compared(domain: Domain, results: pd.DataFrame) -> pd.DataFrame:
    """The latest rows of a domain's methods."""
    return latest(select(results, domain=domain.name, role=METHOD))


def methods(rows: pd.DataFrame) -> list[Compared]:
    """Methods and forms in the rows: ours, the paper's baselines, then others in order of appearance."""
    learned = rows[rows["role"] == METHOD]
    measured = dict.fromkeys(map(Compared, learned["method"], learned["form"]))
    ordered = [method for method in dict.fromkeys((*METHODS, *measured)) if method in measured]
    return sorted(ordered, key=lambda method: method.name != OURS)


def comparison_table(domain: Domain, results: pd.DataFrame, shown: Sequence[str] = ()) -> Table:
    """Table of all methods, with a line for each setting, metric in ``shown`` (by default those of the comparison), and method:
    paired test, mean with errors, the paper's number and the difference.
    """
    rows = compared(domain, results)
    lines = []
    for setting in settings(domain, rows):
        for metric in shown or metrics(domain):
            method_rows = select(rows, setting=setting, metric=metric)
            verdicts = {lead.baseline: f"{lead.amount}, {lead.shown}" for lead in _leads(domain, rows, setting, metric)}
            for method in methods(rows):
                if number := summarise(of_method(method_rows, method)):
                    cells = beside_paper(number, lookup(domain, setting, metric, method=method))
                    verdict = verdicts.get(method, MISSING)
                    lines.append([setting, metric, label(*method), verdict, number.with_error(), _spread(number), *cells])
    caption = (
        f"{domain.name}: all methods{_learned_from(rows)}, mean ± standard error over tasks; ours is: by how much "
        f"{label(*domain.comparison.ours)} is better"
    )
    return make_table(domain, "comparison", caption, lines, ["setting", "metric", "method", "ours is", *MEASURED, *PAPERS])


def references_table(domain: Domain, results: pd.DataFrame) -> Table:
    """Table of references, with a line for each setting, metric and reference."""
    references = reference_lines(domain, results)
    lines = [
        [setting, metric, str(name), number.with_error(), _spread(number)]
        for setting in settings(domain, references)
        for metric in metrics(domain)
        for name, measured in select(references, setting=setting, metric=metric).groupby("method")
        if (number := summarise(measured))
    ]
    caption = f"{domain.name}: references (chance, trivial policies and oracles), mean ± standard error over tasks"
    return make_table(domain, "comparison_references", caption, lines, ["setting", "metric", "reference", *MEASURED])


def _spread(number: Number) -> str:
    return MISSING if number.spread is None else f"{number.spread:.2f}"


def _learned_from(rows: pd.DataFrame) -> str:
    counts = sorted(set(rows.loc[rows["demonstrations"] > 0, "demonstrations"]))
    if not counts:
        return ""
    few = "five" if counts == [5] else " to ".join(dict.fromkeys(str(count) for count in (counts[0], counts[-1])))
    return f", learned from {few} demonstrations"


def _leads(domain: Domain, rows: pd.DataFrame, setting: str, metric: str) -> list[Lead]:
    """Ours against each baseline; for training concepts without language, which is ours with another guidance weight there."""
    trained = setting in training_settings(domain)
    rivals = [method for method in methods(rows) if method.name != OURS and not (method.name == LANGUAGE and trained)]
    tasks = (task for suite in domain.concepts.suites.values() for task in suite.tasks)
    learned = {task.name: " and ".join(sorted(task.learned)) for task in tasks if task.setting == setting and task.learned}
    rows = select(rows, setting=setting, metric=metric)
    return leads(rows, domain.comparison.ours, rivals, learned, domain.less_is_better(metric))


def shown_lines(results: pd.DataFrame) -> list[tuple[Domain, str, str]]:
    """Domain, setting and metric of each line of the overview: ours and a baseline were measured."""
    return [
        (domain, setting, metric)
        for domain in _domains(results)
        for rows in [compared(domain, results)]
        for setting in settings(domain, rows)
        for metric in metrics(domain)
        if _comparable(domain, rows, setting, metric)
    ]


def short_lines(results: pd.DataFrame) -> list[tuple[Domain, str, str]]:
    """At most :data:`LINES` lines of :func:`shown_lines`: of each domain in turn :data:`EACH` settings of learned concepts with the
    most tasks, in the metric of the headline.
    """
    lines: dict[str, list[tuple[Domain, str, str]]] = {}
    for domain in _domains(results):
        rows, metric = compared(domain, results), domain.comparison.headline
        found = [setting for setting, reported in headlines(domain, rows) if reported == metric]
        learned = {task.setting for suite in domain.concepts.suites.values() for task in suite.tasks if task.learned}
        found = [name for name in found if name in learned and _comparable(domain, rows, name, metric)]
        found.sort(key=lambda setting: -select(rows, setting=setting)["task"].nunique())
        lines[domain.name] = [(domain, setting, metric) for setting in found[:EACH]]
    shown = [line for turn in zip_longest(*lines.values()) for line in turn if line][:LINES]
    return sorted(shown, key=lambda line: list(lines).index(line[0].name))


def _comparable(domain: Domain, rows: pd.DataFrame, setting: str, metric: str) -> bool:
    """Whether several methods were measured, or the only method that there is."""
    measured = methods(select(rows, setting=setting, metric=metric))
    return len({method.name for method in measured}) > 1 or (bool(measured) and len(set(rows["method"])) == 1)


def overview(results: pd.DataFrame) -> Table:
    """All domains of :func:`all_methods`: the lead, ours and the baselines, with the paper's numbers in brackets."""
    return _overview(results, shown_lines(results), methods(results))


def short_overview(results: pd.DataFrame) -> Table:
    """At most :data:`LINES` lines: ours in the paper's form, the chosen form and the domain's default form, the baseline and the
    reference with the best mean, and the lead.
    """
    lines = []
    for domain, setting, metric in short_lines(results):
        rows, references = compared(domain, results), reference_lines(domain, results)
        sign = -1 if domain.less_is_better(metric) else 1
        ours = [
            (method.form, cell)
            for method in methods(rows)
            if method.name == OURS and (method == domain.comparison.ours or not method.form or CHOSEN in method.form)
            if (cell := _cell(domain, rows, method, setting, metric)) != MISSING
        ]
        rivals = [
            (sign * number.mean, method)
            for method in methods(rows)
            if method.name != OURS
            if (number := summarise(select(of_method(rows, method), setting=setting, metric=metric)))
        ]
        rival = max(rivals, key=itemgetter(0))[1] if rivals else None
        means = select(references, setting=setting, metric=metric).groupby("method")["value"].mean()
        best = [
            max(named, key=lambda found: sign * found[1])
            for kind in (False, True)
            if (named := [(name, mean) for name, mean in means.items() if (ORACLE in str(name) or name == FRESH) == kind])
        ]
        lead = least_certain(_leads(domain, rows, setting, metric))
        prefix = f"{together(domain.comparison.ours.form)}: " if domain.comparison.ours.form else ""
        lines.append(
            [
                _subject(domain, setting, metric),
                "; ".join(f"{together(form)}: {cell}" if form else cell for form, cell in ours) or MISSING,
                MISSING if rival is None else f"{label(*rival)} {_cell(domain, rows, rival, setting, metric)}",
                ", ".join(f"{name}{f' {ORACLE}' if name == FRESH else ''} {mean:.2f}" for name, mean in best) or MISSING,
                MISSING if lead is None else prefix + (f"{lead.amount}, {lead.shown}" if lead.baseline == rival else str(lead)),
            ]
        )
    brackets = _brackets(results) if any("[" in line[1] + line[2] for line in lines) else ""
    caption = (
        f"New concepts, mean ± standard error over tasks{brackets}. {OURS} (ours): in the paper's form "
        "(parametrisation) unless another is named; networks, representations, most losses and some guidance weights are not the "
        "paper's. Lead: the paper's form, or the form named there, minus the best pretrained baseline; 95 % interval over "
        "tasks"
    )
    head = ["domain: setting, metric", OURS, "best pretrained baseline", "best without pretraining; oracle", "lead"]
    return make_table(None, "overview", caption, lines, head)


def together(form: str) -> str:
    """A form of several parts in a cell: ``'with modes, knots'``, ``'form chosen, with knots'``."""
    parts = form.removesuffix(f", {CHOSEN}")
    listed = parts.replace(", with ", ", ")
    return listed if parts == form else f"{CHOSEN}, {listed}"


def overview_tables(results: pd.DataFrame) -> list[Table]:
    """The overview in tables of few columns: the lead and our forms, the other methods, the references."""
    whole = overview(results)
    subject, lead, *columns = whole.cells.columns
    ours = [name for name in columns if name == label(*PAPERS_METHOD)]
    others = [name for name in columns if name not in ours]
    tables = [Table("overview", whole.caption, whole.cells[[subject, lead, *ours]])]
    step = MOST_COLUMNS - 1
    for start in range(0, len(others), step):
        caption = f"The other methods, mean ± standard error over tasks{_brackets(results)}"
        shown = whole.cells[[subject, *others[start : start + step]]]
        tables.append(Table("overview_methods" + (f"_{start // step + 1}" if start else ""), caption, shown))
    lines = [
        [_subject(*line), _references(domain, rows, references, *line[1:])]
        for domain in _domains(results)
        for rows, references in [(compared(domain, results), reference_lines(domain, results))]
        for line in shown_lines(select(results, domain=domain.name))
    ]
    caption = "References: chance, trivial policies and oracles, the least first"
    return [*tables, make_table(None, "overview_references", caption, lines, [subject, "references"])]


def headline_tables(domain: Domain, results: pd.DataFrame) -> list[Table]:
    """Headlines of a domain: a line for each method or reference, a column for each setting and metric."""
    rows, references = compared(domain, results), reference_lines(domain, results)
    shown = headlines(domain, rows)[: MOST_COLUMNS - 1]
    heads = [f"{setting}, {metric}" for setting, metric in shown]
    measured = [[label(*method), *(_cell(domain, rows, method, *line) for line in shown)] for method in methods(rows)]
    of_references = [
        [str(name), *(_mean(select(group, setting=setting, metric=metric)) for setting, metric in shown)]
        for name, group in references.groupby("method")
    ]
    marks = " [the paper's]" if published(domain) else ""
    sources = (
        ("headline", f"{domain.name}: mean ± standard error over tasks{marks}", "method", measured),
        ("headline_references", f"{domain.name}: references", "reference", of_references),
    )
    return [
        make_table(None, name, caption, [line for line in lines if set(line[1:]) != {MISSING}], [head, *heads])
        for name, caption, head, lines in sources
    ]


def _overview(results: pd.DataFrame, lines: Sequence[tuple[Domain, str, str]], columns: Sequence[Compared]) -> Table:
    grouped: dict[str, list[Compared]] = {}
    for method in sorted(columns, key=lambda method: method != PAPERS_METHOD):
        grouped.setdefault(_base(method), []).append(method)
    cells = []
    rows_of = {domain.name: compared(domain, results) for domain in _domains(results)}
    for domain, setting, metric in lines:
        rows = rows_of[domain.name]
        lead = least_certain(_leads(domain, rows, setting, metric))
        rows = select(rows, setting=setting, metric=metric)
        form = f"{domain.comparison.ours.form}: " if domain.comparison.ours.form and lead else ""
        line = [_subject(domain, setting, metric), MISSING if lead is None else f"{form}{lead}"]
        for name, group in grouped.items():
            cell_of = {
                label(*method).removeprefix(name).strip(", "): _cell(domain, rows, method, setting, metric) for method in group
            }
            line.append(", ".join(f"{form} {cell}".strip() for form, cell in cell_of.items() if cell != MISSING) or MISSING)
        cells.append(line)
    head = ["domain: setting, metric", "lead", *grouped]
    legend = (
        f". {PAPERS_METHOD.name}: the paper's form unless another is named; "
        "networks, representations, most losses and some guidance weights are not the paper's"
    )
    caption = (
        f"Ours and the baselines, mean ± standard error over tasks{_brackets(results)}; lead: by how much ours is better than the "
        f"best baseline, with its 95 % interval over tasks{legend * (len(grouped.get(OURS, ())) > 1)}"
    )
    return make_table(None, "overview", caption, cells, head)


def _base(method: Compared) -> str:
    """Name of the column of a method: ``'BC'`` for ``'BC, our network'`` and for every form of BC."""
    return method.name.partition(", ")[0]


def _brackets(results: pd.DataFrame) -> str:
    return " [the paper's number, in a setting that differs]" if any(map(published, _domains(results))) else ""


def _domains(results: pd.DataFrame) -> list[Domain]:
    return [domain_of(name, results) for name in sorted(set(results["domain"]))]


def _subject(domain: Domain, setting: str, metric: str) -> str:
    return f"{topic(domain.name)}: {setting}, {metric}"


def _references(domain: Domain, rows: pd.DataFrame, references: pd.DataFrame, setting: str, metric: str) -> str:
    """Means of the references, ascending; policies that nearly agree with ours have the number of equal outcomes."""
    ours = of_method(select(rows, setting=setting), domain.comparison.ours)
    agreeing = {}
    for policy in policies(domain) if metric == domain.comparison.headline else ():
        counts = against(ours, policy)
        if counts is not None and sum(counts[:2]) <= (1 - ALIKE) * counts[2]:
            agreeing[policy] = f" ({same_outcome(*counts)})"
    groups = select(references, setting=setting, metric=metric).groupby("method")
    means = sorted((number.mean, str(name)) for name, rows in groups if (number := summarise(rows)))
    return ", ".join(f"{name} {mean:.2f}{agreeing.get(name, '')}" for mean, name in means) or MISSING


def _mean(rows: pd.DataFrame) -> str:
    number = summarise(rows)
    return MISSING if number is None else number.with_error()


def _cell(domain: Domain, rows: pd.DataFrame, method: Compared, setting: str, metric: str) -> str:
    text = _mean(select(of_method(rows, method), setting=setting, metric=metric))
    papers = lookup(domain, setting, metric, method=method)
    return text if text == MISSING or papers is None else f"{text} [{papers.value:.2f}]"
