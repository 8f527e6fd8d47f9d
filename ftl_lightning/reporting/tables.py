"""A domain's tables from results, each number beside the paper's."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pandas as pd

from ftl_lightning.domains.domain import CLOSED, EXECUTED, Domain
from ftl_lightning.domains.paper import OURS, PAPERS_METHOD, Compared, Published
from ftl_lightning.evaluation.judged import LOST, WON
from ftl_lightning.evaluation.results import LARGEST_WHOLE, METHOD, REFERENCE, labels, latest
from ftl_lightning.reporting.paired import episodes
from ftl_lightning.reporting.shown import (
    component_tasks,
    environments,
    learned_settings,
    lookup,
    main_omega,
    metrics,
    paper_tasks,
    papers_omega,
    policies,
    published,
    settings,
)
from ftl_lightning.reporting.table import (
    MISSING,
    PAPERS,
    Table,
    difference_to,
    make_table,
    of_method,
    paper,
    select,
    summarise,
)
from ftl_lightning.services.errors import UserError

USUAL_K = 2
"""Number of components in the main tables, as in the paper."""
LEARNED = "learned"
"""Value of ``omega`` for learned guidance weights."""


def _cell(rows: pd.DataFrame) -> str:
    """Cell text of a number, marked if its weighting differs from the caption's."""
    number = summarise(rows)
    marks = dict.fromkeys(rows["mark"]) if "mark" in rows else ()
    return MISSING if number is None else str(number) + "".join(marks)


BESIDE = ("method", "measured", *PAPERS)
"""Last columns of the tables of our method in all its forms."""


def _beside(
    rows: pd.DataFrame, names: Sequence[str], papers: Callable[[Compared], Published | None] = lambda method: None
) -> list[list[str]]:
    """Cells of the columns :data:`BESIDE` for each method with rows.

    Args:
        rows: rows with labels, see :func:`labelled`.
        names: labels of methods, in order.
        papers: the paper's number of a method, or ``None``.
    """
    lines = []
    for name in names:
        method_rows = select(rows, label=name)
        if (number := summarise(method_rows)) is not None:
            published_number = papers(Compared(*method_rows.iloc[0][["method", "form"]]))
            lines.append([name, _cell(method_rows), paper(published_number), difference_to(published_number, number)])
    return lines


def _references(
    domain: Domain,
    name: str,
    caption: str,
    rows: pd.DataFrame,
    subjects: Sequence[tuple[list[str], pd.DataFrame]],
    heads: Sequence[str],
) -> Table:
    """The table of reference lines beside another table.

    Args:
        domain: the domain.
        name, caption: of the other table.
        rows: all rows, for the order of lines.
        subjects: first cells of each line, and its rows.
        heads: column names of the first cells.
    """
    _, names = _columns(rows)
    lines = [
        [*first, label, _cell(reference)]
        for first, subject_rows in subjects
        for label in names
        if not (reference := select(subject_rows, role=REFERENCE, label=label)).empty
    ]
    return make_table(domain, f"{name}_references", f"{caption}: reference lines", lines, [*heads, "reference line", "measured"])


def _columns(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Sorted labels of methods and of reference lines."""
    return tuple(sorted(set(rows.loc[rows["role"] == role, "label"])) for role in (METHOD, REFERENCE))  # type: ignore[return-value]


def labelled(rows: pd.DataFrame) -> pd.DataFrame:
    """Add the column ``label``: the method with its form and variant."""
    return rows.assign(label=labels(rows))


def weighting(components: int, omega: str) -> str:
    """The number of components and their weights, in words."""
    weights = "learned weights" if omega == LEARNED else f"fixed omega {omega}"
    return f"K = {components}, {weights}" if components else weights


def _weightings(rows: pd.DataFrame) -> list[tuple[int, str]]:
    """K and guidance weight of each row."""
    return list(zip(map(int, rows["K"]), map(str, rows["omega"]), strict=True))


def main_rows(rows: pd.DataFrame, omega: str) -> tuple[pd.DataFrame, str]:
    """Rows of a main table: for each method and setting two components with the main weight, or else the most measured weighting.

    Args:
        rows: rows with labels, see :func:`labelled`.
        omega: guidance weight of the main tables.

    Returns:
        The rows, with the weighting of ours in the column ``mark`` where it differs from the caption's; and the caption's words
        for the weighting.
    """
    rows = rows[rows["role"] == METHOD]
    usual = (USUAL_K, omega)
    parts = []
    for _, setting_rows in rows.groupby(["label", "setting"], sort=False):
        measured = Counter(_weightings(setting_rows))
        components, weight = usual if usual in measured else measured.most_common(1)[0][0]
        parts.append(select(setting_rows, K=components, omega=weight))
    selected = rows.loc[rows.index.intersection(pd.concat(parts).index)] if parts else rows
    is_ours = selected["method"] == OURS
    weightings = set(_weightings(selected[is_ours]))
    common = usual if usual in weightings or not weightings else next(iter(weightings)) if len(weightings) == 1 else None
    marks = [
        f" ({weighting(*row_weighting)})" if ours and row_weighting != common else ""
        for ours, row_weighting in zip(is_ours, _weightings(selected), strict=True)
    ]
    return selected.assign(mark=marks), "K and weights in brackets" if common is None else weighting(*common)


def as_learned_most(domain: Domain, rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a single configuration for each method, form and setting, and all reference lines.

    The guidance weight is that of the main tables (:func:`main_rows`). Variant and number of demonstrations are the most measured;
    ties go to more demonstrations.
    """
    chosen, _ = main_rows(labelled(latest(rows)), main_omega(domain))
    kept = []
    for _, group in chosen.groupby(["method", "form", "setting"], sort=False):
        counts = group.groupby(["variant", "demonstrations"], sort=False).size()
        variant, demonstrations = max(counts.index, key=lambda way: (counts[way], way[1]))
        kept.append(select(group, variant=variant, demonstrations=demonstrations))
    return pd.concat([*kept, select(latest(rows), role=REFERENCE)])[list(rows.columns)]


def tables(domain: Domain, results: pd.DataFrame) -> list[Table]:
    """All tables of a domain that have results, with separate tables of reference lines."""
    domain_rows = labelled(latest(select(results, domain=domain.name)))
    metric = domain.main_metric
    rows = select(domain_rows, metric=metric)
    candidates = (
        *(() if metric == EXECUTED else _accuracy(domain, rows, metric, "accuracy")),
        *_accuracy(domain, select(domain_rows, metric=EXECUTED), EXECUTED, "closed_loop"),
        *_outcomes(domain, domain_rows),
        _paired(domain, domain_rows),
        _count(domain, domain_rows),
        _omega(domain, domain_rows),
        _components(domain, rows, metric),
    )
    return [table for table in candidates if not table.cells.empty]


def _accuracy(domain: Domain, rows: pd.DataFrame, metric: str, name: str) -> list[Table]:
    """The numbers of the paper's main figure, and trivial policies and the oracle."""
    learned_labels, _ = _columns(rows)
    selected, how = main_rows(rows, main_omega(domain))
    lines, subjects = [], []
    for setting in settings(domain, selected):
        for task in ("", *paper_tasks(domain, setting)):
            subject = {"setting": setting} | ({"task": task} if task else {})
            first = [f"- {task}" if task else setting]
            number = partial(_of_paper, domain, setting, metric, task=task)
            lines += [[*first, *line] for line in _beside(select(selected, **subject), learned_labels, number)]
            if not select(selected, **subject).empty:
                subjects.append((first, select(rows, **subject)))
    papers_weight = ""
    if published(domain) and main_omega(domain) != papers_omega(domain):
        papers_weight = f" (the paper's: {papers_omega(domain)})"
    caption = f"{domain.name}: {metric}, {how}{papers_weight}. Mean ± standard error over tasks (spread over seeds)"
    references = _references(domain, name, f"{domain.name}: {metric}", rows, subjects, ["setting"])
    return [make_table(domain, name, caption, lines, ["setting", *BESIDE]), references]


def _of_paper(domain: Domain, setting: str, metric: str, method: Compared, task: str = "", **learned: Any) -> Published | None:
    return lookup(domain, setting, metric, task, method=method, **learned)


def _outcomes(domain: Domain, rows: pd.DataFrame) -> list[Table]:
    """All outcomes in closed loop, by setting."""
    executed = rows[rows["metric"].str.startswith(CLOSED)]
    selected, how = main_rows(executed, main_omega(domain))
    learned_labels, _ = _columns(executed)
    lines, subjects = [], []
    for setting in settings(domain, selected):
        for metric in dict.fromkeys(select(selected, setting=setting)["metric"]):
            first = [setting, metric.removeprefix(f"{CLOSED} ")]
            number = partial(_of_paper, domain, setting, metric)
            measured = select(selected, setting=setting, metric=metric)
            lines += [[*first, *line] for line in _beside(measured, learned_labels, number)]
            subjects.append((first, select(executed, setting=setting, metric=metric)))
    caption, heads = f"{domain.name}: what happened in closed loop", ["setting", "outcome"]
    return [
        make_table(domain, "outcomes", f"{caption}, {how}", lines, [*heads, *BESIDE]),
        _references(domain, "outcomes", caption, executed, subjects, heads),
    ]


def against(ours: pd.DataFrame, policy: str) -> tuple[int, int, int] | None:
    """Episodes that only ours wins, episodes that only the policy wins from the same start, and all; ``None`` without rows.

    Raises:
        UserError: for counts that are impossible.
    """
    won, lost = (select(ours, metric=f"{begin}{policy}") for begin in (WON, LOST))
    if won.empty:
        return None
    gains, losses = (round(float((rows["value"] * rows["n"]).clip(-1, LARGEST_WHOLE).sum())) for rows in (won, lost))
    count = int(won["n"].sum())
    if not 0 <= gains + losses <= count or min(gains, losses, count - 1) < 0:
        raise UserError(
            f"results: metrics {f'{WON}{policy}'!r} and {f'{LOST}{policy}'!r}: expected shares of the same episodes, found "
            f"{gains} and {losses} of {count} episodes; mend the rows"
        )
    return gains, losses, count


def _paired(domain: Domain, rows: pd.DataFrame) -> Table:
    """Difference between our success and that of reference policies from the same starts, over all seeds, by environment."""
    selected, _ = main_rows(rows, main_omega(domain))
    learned_labels, _ = _columns(selected[selected["metric"].str.startswith(WON)])
    lines, elsewhere = [], ""
    for setting, label in itertools.product(settings(domain, selected), learned_labels):
        for place, name in itertools.product(environments(domain), policies(domain)):
            counts = against(select(selected, setting=setting, label=label), f"{name}{place}")
            if counts is not None:
                lines.append([setting, label, f"{name}{place}", episodes(*counts)])
                elsewhere = "; an environment other than the domain's own is named behind the policy" if place else elsewhere
    compared = domain.headline.removeprefix(f"{CLOSED} ")
    caption = (
        f"{domain.name}: {compared} less that of policies from the same starts, 95 % interval, McNemar's exact p "
        f"(of these learned concepts: the episodes of a seed share one){elsewhere}"
    )
    return make_table(domain, "paired", caption, lines, ["setting", "method", "compared with", "difference"])


def _grid(
    domain: Domain,
    name: str,
    caption: str,
    rows: pd.DataFrame,
    lines: Sequence[tuple[Sequence[str], Callable[[Compared], Published | None], pd.DataFrame]],
    heads: Sequence[str],
) -> Table:
    """A table with a line for each method of each subject (first cells, the paper's number of a method, rows)."""
    learned_labels, _ = _columns(rows)
    cells = [[*first, *line] for first, papers, line_rows in lines for line in _beside(line_rows, learned_labels, papers)]
    return make_table(domain, name, caption, cells, [*heads, *BESIDE])


def _judged(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """Metrics of the tables of K and omega: the main metric, failures in closed loop, and the paper's metrics."""
    wrong = [metric for metric in metrics(domain) if domain.less_is_better(metric)]
    papers = [number.metric for number in published(domain)]
    return [metric for metric in dict.fromkeys((domain.main_metric, *wrong, *papers)) if metric in set(rows["metric"])]


def _count(domain: Domain, rows: pd.DataFrame) -> Table:
    """Ablation of the number of learned concepts, with learned weights."""
    ours = select(of_method(rows, PAPERS_METHOD), omega=LEARNED)
    lines = [
        (
            (setting, str(count), metric),
            partial(_of_paper, domain, setting, metric, components=count, omega=LEARNED),
            select(ours, setting=setting, K=count, metric=metric),
        )
        for setting in learned_settings(domain, ours)
        for count in sorted(set(ours.loc[ours["K"] > 0, "K"]))
        for metric in _judged(domain, ours)
    ]
    caption = f"{domain.name}: number of learned concepts K, with learned weights"
    return _grid(domain, "concept_count", caption, ours, lines, ("setting", "K", "metric"))


def _omega(domain: Domain, rows: pd.DataFrame) -> Table:
    """Ablation of the guidance weight, for K = 2 or else the most measured K."""
    ours = of_method(rows, PAPERS_METHOD)
    counts = Counter(components for components, _ in _weightings(ours) if components)
    count = USUAL_K if USUAL_K in counts or not counts else counts.most_common(1)[0][0]
    ours = select(ours, K=count)
    lines = [
        (
            (setting, omega, metric),
            partial(_of_paper, domain, setting, metric, components=count, omega=omega),
            select(ours, setting=setting, omega=omega, metric=metric),
        )
        for setting in learned_settings(domain, ours)
        for omega in sorted(set(ours["omega"]))
        for metric in _judged(domain, ours)
    ]
    caption = f"{domain.name}: guidance weight omega, K = {count}"
    return _grid(domain, "omega", caption, ours, lines, ("setting", "omega", "metric"))


def _components(domain: Domain, rows: pd.DataFrame, metric: str) -> Table:
    """Each learned component alone, with learned weights or else the most measured weighting."""
    tasks = component_tasks(domain)
    selected, how = main_rows(rows[rows["setting"].isin({task.setting for task in tasks})], LEARNED)
    lines = [
        (
            (task.name, task.setting),
            partial(_of_paper, domain, task.setting, metric, task=task.name, omega=LEARNED),
            select(selected, setting=task.setting, task=task.name),
        )
        for task in tasks
    ]
    caption = f"{domain.name}: {metric} of what each learned component generates alone, {how.removeprefix(f'K = {USUAL_K}, ')}"
    return _grid(domain, "components", caption, selected, lines, ("concept", "generated from"))
