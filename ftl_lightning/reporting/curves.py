"""Accuracy against the number of demonstrations and the number of components."""

import pandas as pd

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.results import METHOD, latest
from ftl_lightning.reporting.shown import decisive, main_omega
from ftl_lightning.reporting.table import MISSING, Table, select, summarise
from ftl_lightning.reporting.tables import LEARNED

AXES = {"demonstrations": "K", "K": "demonstrations"}
"""Varied column, and the column that stays fixed."""


def points(domain: Domain, results: pd.DataFrame, axis: str) -> pd.DataFrame:
    """The rows of a domain's headline, or else its main metric, along an axis.

    The other column of :data:`AXES` and the guidance weight have the values with most points on the axis. Ties go to the weight of
    the main tables for demonstrations, and to learned weights for K, as fixed weights per component would increase guidance with
    K. Settings with the initial states of the demonstrations are left out: they have no more samples than demonstrations.

    Args:
        domain: the domain.
        results: rows of the results file.
        axis: ``'demonstrations'`` or ``'K'``.
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
    """One line for each setting and axis; several seeds have their spread in brackets."""
    lines, grown = [], {axis: points(domain, results, axis) for axis in AXES}
    counts = sorted({count for axis, rows in grown.items() for count in rows[axis]})
    for axis, rows in grown.items():
        for setting in dict.fromkeys(rows["setting"]):
            numbers = [summarise(rows[(rows["setting"] == setting) & (rows[axis] == count)]) for count in counts]
            lines.append([setting, axis, *(MISSING if number is None else str(number) for number in numbers)])
    metric = next((name for rows in grown.values() for name in rows["metric"]), domain.main_metric)
    kept = {axis: rows.iloc[0] for axis, rows in grown.items() if len(rows)}
    axes = ", ".join(f"{axis} ({AXES[axis]} = {row[AXES[axis]]}, omega {row['omega']})" for axis, row in kept.items())
    caption = f"{domain.name}: {metric} by {axes}. Mean ± standard error over tasks (spread over seeds)"
    return Table("curves", caption, pd.DataFrame(lines, columns=["setting", "of", *map(str, counts)], dtype=str))
