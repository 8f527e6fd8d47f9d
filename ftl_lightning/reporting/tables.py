"""A domain's tables from results, each number beside the paper's."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import pandas as pd

from ftl_lightning.domains.comparison import CHOSEN, OURS, PAPERS_METHOD, Compared, Published
from ftl_lightning.domains.domain import CLOSED, EXECUTED, OWN, Domain
from ftl_lightning.evaluation.generation import LOST, WON
from ftl_lightning.evaluation.results import LARGEST_WHOLE, METHOD, REFERENCE, labels, latest
from ftl_lightning.reporting.paired import episodes
from ftl_lightning.reporting.table import (
    MISSING,
    PAPERS,
    Table,
    beside_paper,
    component_tasks,
    decisive,
    lookup,
    main_omega,
    make_table,
    metrics,
    of_method,
    papers_omega,
    policies,
    published,
    select,
    settings,
    summarise,
    training_settings,
)
from ftl_lightning.services.errors import UserError

USUAL_K = 2  #: Number of components in the main tables, as in the paper.
LEARNED = "learned"  #: Value of ``omega`` for learned guidance weights.
AXES = {"demonstrations": "K", "K": "demonstrations"}  #: Axes of curves: the varied column, and the column that stays fixed.
BESIDE = ("method", "measured", *PAPERS)  #: Last columns of the tables of our method in all its forms.

Papers = Callable[..., Published | None]  #: The paper's number by the keyword ``method``.


def labelled(rows: pd.DataFrame) -> pd.DataFrame:
    """Add the column ``label``: the method with its form and variant."""
    return rows.assign(label=labels(rows))


def _cell(rows: pd.DataFrame) -> str:
    """Cell of rows: mean with errors, marked if the weighting differs from the caption's."""
    number = summarise(rows)
    marks = dict.fromkeys(rows["mark"]) if "mark" in rows else ()
    return MISSING if number is None else str(number) + "".join(marks)


def _table(
    domain: Domain, name: str, caption: str, heads: Sequence[str], subjects: Sequence[tuple[Sequence[str], Papers, pd.DataFrame]]
) -> Table:
    """A table with a line for each method of each subject: first cells, the paper's numbers, and labelled rows."""
    lines = []
    for first, papers, subject_rows in subjects:
        for label, rows in subject_rows.groupby("label"):
            published_number = papers(method=Compared(*rows.iloc[0][["method", "form"]]))
            lines.append([*first, str(label), _cell(rows), *beside_paper(summarise(rows), published_number)])
    return make_table(domain, name, caption, lines, [*heads, *BESIDE])


def _references(
    domain: Domain, name: str, caption: str, heads: Sequence[str], subjects: Sequence[tuple[Sequence[str], pd.DataFrame]]
) -> Table:
    """The table of references that accompanies the table ``name``; subjects are first cells and labelled rows."""
    lines = [
        [*first, str(label), _cell(rows)]
        for first, subject_rows in subjects
        for label, rows in select(subject_rows, role=REFERENCE).groupby("label")
    ]
    return make_table(domain, f"{name}_references", f"{caption}: references", lines, [*heads, "reference", "measured"])


def weighting(components: int, omega: str) -> str:
    """The number of components and their weights, in words."""
    weights = "learned weights" if omega == LEARNED else f"fixed omega {omega}"
    return f"K = {components}, {weights}" if components else weights


def _words(*parts: str) -> str:
    """Parts of a caption, without those that are empty."""
    return ", ".join(filter(None, parts))


def _weightings(rows: pd.DataFrame) -> list[tuple[int, str]]:
    """K and guidance weight of each row."""
    return list(zip(map(int, rows["K"]), map(str, rows["omega"]), strict=True))


def main_rows(rows: pd.DataFrame, omega: str) -> tuple[pd.DataFrame, str]:
    """Rows of a main table, and the words of its caption: for each method and setting two components with the main weight
    ``omega``, or else the most measured weighting, which the column ``mark`` then names. Rows have labels, see :func:`labelled`.
    The words are empty where no weighting applies: without rows of ours and without a main weight.
    """
    rows = select(rows, role=METHOD)
    usual = (USUAL_K, omega)
    parts = []
    for _, setting_rows in rows.groupby(["label", "setting"], sort=False):
        measured = Counter(_weightings(setting_rows))
        components, weight = usual if usual in measured else measured.most_common(1)[0][0]
        parts.append(select(setting_rows, K=components, omega=weight))
    selected = rows.loc[rows.index.intersection(pd.concat(parts).index)] if parts else rows
    # Where the form of own data is chosen, each form has a K and weights of its own.
    is_ours = (selected["method"] == OURS) & ~((selected["domain"] == OWN) & selected["form"].str.contains(CHOSEN, regex=False))
    weightings = set(_weightings(selected[is_ours]))
    common = usual if usual in weightings or not weightings else next(iter(weightings)) if len(weightings) == 1 else None
    marks = [
        f" ({weighting(*row_weighting)})" if ours and row_weighting != common else ""
        for ours, row_weighting in zip(is_ours, _weightings(selected), strict=True)
    ]
    if not weightings and not omega:  # neither ours nor a paper's numbers stand here
        return selected.assign(mark=marks), ""
    return selected.assign(mark=marks), "K and weights in brackets" if common is None else weighting(*common)


def as_learned_most(domain: Domain, rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a single configuration for each method, form and setting, and all references. The guidance weight is that of the
    main tables (:func:`main_rows`). Variant and number of demonstrations are the most measured; ties go to more demonstrations.
    """
    chosen, _ = main_rows(labelled(latest(rows)), main_omega(domain))
    kept = []
    for _, group in chosen.groupby(["method", "form", "setting"], sort=False):
        counts = group.groupby(["variant", "demonstrations"], sort=False).size()
        variant, demonstrations = max(counts.index, key=lambda way: (counts[way], way[1]))
        kept.append(select(group, variant=variant, demonstrations=demonstrations))
    return pd.concat([*kept, select(latest(rows), role=REFERENCE)])[list(rows.columns)]


def tables(domain: Domain, results: pd.DataFrame) -> list[Table]:
    """All tables of a domain that have results, with separate tables of references."""
    rows = labelled(latest(select(results, domain=domain.name)))
    metric = domain.main_metric
    ours = of_method(rows, PAPERS_METHOD)
    counts = Counter(components for components, _ in _weightings(ours) if components)
    count = USUAL_K if USUAL_K in counts or not counts else counts.most_common(1)[0][0]
    by_count = f"{domain.name}: number of learned concepts K, with learned weights"
    by_omega = f"{domain.name}: guidance weight omega, K = {count}"
    candidates = (
        *(() if metric == EXECUTED else _accuracy(domain, rows, metric, "accuracy")),
        *_accuracy(domain, rows, EXECUTED, "closed_loop"),
        *_outcomes(domain, rows),
        _paired(domain, rows),
        _ablation(domain, "concept_count", by_count, select(ours, omega=LEARNED), "K"),
        _ablation(domain, "omega", by_omega, select(ours, K=count), "omega"),
        _components(domain, select(rows, metric=metric), metric),
    )
    return [table for table in candidates if not table.cells.empty]


def _accuracy(domain: Domain, rows: pd.DataFrame, metric: str, name: str) -> list[Table]:
    """The numbers of the paper's main figure: each setting, and its tasks with a published number."""
    rows = select(rows, metric=metric)
    selected, how = main_rows(rows, main_omega(domain))
    numbers = [number for number in published(domain) if number.task and number.omega == papers_omega(domain)]
    subjects, references = [], []
    for setting in settings(domain, selected):
        for task in ("", *(number.task for number in numbers if number.setting == setting)):
            subject = {"setting": setting} | ({"task": task} if task else {})
            first, papers = [f"- {task}" if task else setting], partial(lookup, domain, setting, metric, task)
            if not (measured := select(selected, **subject)).empty:
                subjects.append((first, papers, measured))
                references.append((first, select(rows, **subject)))
    different = bool(published(domain)) and main_omega(domain) != papers_omega(domain)
    papers_weight = f" (the paper's: {papers_omega(domain)})" if different else ""
    caption = f"{_words(f'{domain.name}: {metric}', how)}{papers_weight}. Mean ± standard error over tasks (spread over seeds)"
    return [
        _table(domain, name, caption, ["setting"], subjects),
        _references(domain, name, f"{domain.name}: {metric}", ["setting"], references),
    ]


def _outcomes(domain: Domain, rows: pd.DataFrame) -> list[Table]:
    """All outcomes in closed loop, by setting."""
    executed = rows[rows["metric"].str.startswith(CLOSED)]
    selected, how = main_rows(executed, main_omega(domain))
    subjects, references = [], []
    for setting in settings(domain, selected):
        for metric in dict.fromkeys(select(selected, setting=setting)["metric"]):
            first = [setting, metric.removeprefix(f"{CLOSED} ")]
            papers = partial(lookup, domain, setting, metric)
            subjects.append((first, papers, select(selected, setting=setting, metric=metric)))
            references.append((first, select(executed, setting=setting, metric=metric)))
    caption, heads = f"{domain.name}: what happened in closed loop", ["setting", "outcome"]
    return [
        _table(domain, "outcomes", _words(caption, how), heads, subjects),
        _references(domain, "outcomes", caption, heads, references),
    ]


def against(ours: pd.DataFrame, policy: str) -> tuple[int, int, int] | None:
    """Episodes that only ours wins, that only the policy wins from the same start, and all, or ``None``. Raise UserError for
    impossible counts.
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
    learned = sorted(set(selected.loc[selected["metric"].str.startswith(WON), "label"]))
    # Suffixes of outcomes by environment: none for the default environment.
    environments = ("", *(f" ({name})" for name in domain.closed_loop.others)) if domain.closed_loop else ()
    lines, elsewhere = [], ""
    for setting, label in itertools.product(settings(domain, selected), learned):
        for place, name in itertools.product(environments, policies(domain)):
            counts = against(select(selected, setting=setting, label=label), f"{name}{place}")
            if counts is not None:
                lines.append([setting, label, f"{name}{place}", episodes(*counts)])
                elsewhere = "; an environment other than the domain's own is named behind the policy" if place else elsewhere
    compared = domain.comparison.headline.removeprefix(f"{CLOSED} ")
    caption = (
        f"{domain.name}: {compared} less that of policies from the same starts, 95 % interval, McNemar's exact p "
        f"(of these learned concepts: the episodes of a seed share one){elsewhere}"
    )
    return make_table(None, "paired", caption, lines, ["setting", "method", "compared with", "difference"])


def _ablation(domain: Domain, name: str, caption: str, ours: pd.DataFrame, column: str) -> Table:
    """Ablation of the number of learned concepts (``column`` K) or of the guidance weight (omega), without training settings."""
    failures = [metric for metric in metrics(domain) if domain.less_is_better(metric)]
    papers = [number.metric for number in published(domain)]
    shown = [metric for metric in dict.fromkeys((domain.main_metric, *failures, *papers)) if metric in set(ours["metric"])]
    ours = ours[ours["K"] > 0]
    subjects = [
        (
            (setting, str(value), metric),
            partial(lookup, domain, setting, metric, components=int(rows["K"].iloc[0]), omega=str(rows["omega"].iloc[0])),
            select(rows, metric=metric),
        )
        for setting in settings(domain, ours)
        if setting not in training_settings(domain)
        for value in sorted(set(ours[column]))
        if not (rows := select(ours, setting=setting, **{column: value})).empty
        for metric in shown
    ]
    return _table(domain, name, caption, ("setting", column, "metric"), subjects)


def _components(domain: Domain, rows: pd.DataFrame, metric: str) -> Table:
    """Each learned component alone, with learned weights or else the most measured weighting."""
    tasks = component_tasks(domain)
    selected, how = main_rows(rows[rows["setting"].isin({task.setting for task in tasks})], LEARNED)
    subjects = [
        (
            (task.name, task.setting),
            partial(lookup, domain, task.setting, metric, task.name, omega=LEARNED),
            select(selected, setting=task.setting, task=task.name),
        )
        for task in tasks
    ]
    caption = f"{domain.name}: {metric} of what each learned component generates alone, {how.removeprefix(f'K = {USUAL_K}, ')}"
    return _table(domain, "components", caption, ("concept", "generated from"), subjects)


def points(domain: Domain, results: pd.DataFrame, axis: str) -> pd.DataFrame:
    """The rows of a domain's headline, or else its main metric, along an axis of a curve. The other column of :data:`AXES` and the
    guidance weight have the values with most points on the axis. Ties go to the weight of the main tables for demonstrations, and
    to learned weights for K, as fixed weights per component would increase guidance with K. Settings with the initial states of the
    demonstrations are left out: they have no more samples than demonstrations.
    """
    rows = latest(select(results, domain=domain.name, role=METHOD))
    rows = select(rows, metric=decisive(domain, rows))
    rows = rows[(rows["K"] > 0) & (rows["demonstrations"] > 0) & (rows["n"] > rows["demonstrations"])]
    if rows.empty:
        return rows
    preferred = main_omega(domain) if axis == "demonstrations" else LEARNED
    measured = rows.groupby([AXES[axis], "omega"])[axis].nunique()
    stays, omega = max(measured.index, key=lambda pair: (measured[pair], pair[1] == preferred))
    return select(rows, omega=omega, **{AXES[axis]: stays})


def curves_table(domain: Domain, results: pd.DataFrame) -> Table:
    """Accuracy by number of demonstrations and number of components: a line for each setting and axis."""
    lines, grown = [], {axis: points(domain, results, axis) for axis in AXES}
    counts = sorted({count for axis, rows in grown.items() for count in rows[axis]})
    for axis, rows in grown.items():
        for setting in dict.fromkeys(rows["setting"]):
            lines.append([setting, axis, *(_cell(select(rows, setting=setting, **{axis: count})) for count in counts)])
    metric = next((name for rows in grown.values() for name in rows["metric"]), domain.main_metric)
    kept = {axis: rows.iloc[0] for axis, rows in grown.items() if len(rows)}
    axes = ", ".join(f"{axis} ({AXES[axis]} = {row[AXES[axis]]}, omega {row['omega']})" for axis, row in kept.items())
    caption = f"{domain.name}: {metric} by {axes}. Mean ± standard error over tasks (spread over seeds)"
    return make_table(None, "curves", caption, lines, ["setting", "of", *map(str, counts)])


def changes_table(domain: Domain, results: pd.DataFrame) -> Table:
    """Ablation of the changes to the paper's form: a line for ours, and for ours without a single change, by setting; decisive
    metric.
    """
    rows = latest(select(results, domain=domain.name, role=METHOD))
    metric = decisive(domain, rows)
    rows = select(rows, metric=metric)
    columns = list(dict.fromkeys(rows["setting"]))
    lines = [
        [variant, *(_cell(select(rows, variant=variant, setting=setting)) for setting in columns)]
        for variant in dict.fromkeys(rows["variant"])
    ]
    caption = (
        f"{domain.name}: {metric} of ours, and without one of our changes to the paper's form at a time. "
        "Mean ± standard error over tasks (spread over seeds)"
    )
    return make_table(None, "changes", caption, lines, ["variant", *columns])
