"""Ablation of the changes to the paper's form: ours, and ours without one change at a time."""

import pandas as pd

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.results import METHOD, latest
from ftl_lightning.reporting.shown import decisive
from ftl_lightning.reporting.table import MISSING, Table, select, summarise


def changes_table(domain: Domain, results: pd.DataFrame) -> Table:
    """One line for each variant in the order of the rows, one column for each setting, with the domain's headline or else its
    main metric.

    Args:
        domain: the domain.
        results: rows of the results file.
    """
    rows = latest(select(results, domain=domain.name, role=METHOD))
    metric = decisive(domain, rows)
    rows = select(rows, metric=metric)
    settings = list(dict.fromkeys(rows["setting"]))
    lines = []
    for variant in dict.fromkeys(rows["variant"]):
        numbers = [summarise(select(rows, variant=variant, setting=setting)) for setting in settings]
        lines.append([variant, *(MISSING if number is None else str(number) for number in numbers)])
    caption = (
        f"{domain.name}: {metric} of ours, and with one change to the paper's form taken away at a time. "
        "Mean ± standard error over tasks (spread over seeds)"
    )
    return Table("changes", caption, pd.DataFrame(lines, columns=["variant", *settings], dtype=str))
