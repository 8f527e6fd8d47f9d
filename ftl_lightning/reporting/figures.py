"""Figures from results."""

import pandas as pd
from matplotlib.figure import Figure

from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.results import latest
from ftl_lightning.reporting.tables import summarise

PAPER_COLOUR = "#9a9a9a"
COLOURS = ("#3f6fb5", "#4c9f70", "#e4704a", "#8a63b3")
LINES = ("dotted", "dashed", "dashdot", (0, (1, 4)), (0, (6, 2, 1, 2, 1, 2)), "solid")
"""Of reference policies."""


def accuracy_bars(domain: Domain, results: pd.DataFrame, metric: str = "accuracy") -> Figure:
    """A metric of every setting beside the paper's and reference policies, K = 2; bars show standard errors over tasks.

    Args:
        domain: the domain.
        results: rows of the results file.
        metric: as in a row of the results.
    """
    rows = latest(results[(results["domain"] == domain.name) & (results["metric"] == metric)])
    ours = rows[(rows["K"] == 2) & (rows["omega"] == domain.omega)]
    names = ("training", "paper")
    settings = [s for name in names for s in domain.suites[name].settings if s in set(ours["setting"])]
    methods = sorted(set(ours["method"]))
    figure = Figure(figsize=(1.9 * max(len(settings), 2) + 3.5, 3.4), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / (len(methods) + 1)
    published = {
        found.setting: found
        for found in domain.published
        if not found.task and found.omega == domain.published_omega and found.metric == metric and found.components == 2
    }
    references = rows[rows["omega"] == ""]
    policies = sorted(set(references["method"]))

    def once(label: str) -> str | None:
        """For the legend, which names everything once, wherever it is seen first."""
        return None if label in axes.get_legend_handles_labels()[1] else label

    for place, setting in enumerate(settings):
        found = published.get(setting)
        if found:
            axes.bar(place, found.value, width, yerr=found.error, color=PAPER_COLOUR, capsize=2, label=once("paper"))
        for index, method in enumerate(methods, start=1):
            number = summarise(ours[(ours["setting"] == setting) & (ours["method"] == method)])
            if number:
                colour, where = COLOURS[(index - 1) % len(COLOURS)], place + index * width
                axes.bar(where, number.mean, width, yerr=number.error, color=colour, capsize=2, label=once(method))
        span = (place - width / 2, place + (len(methods) + 0.5) * width)
        for index, policy in enumerate(policies):
            reference = summarise(references[(references["setting"] == setting) & (references["method"] == policy)])
            if reference:
                line = LINES[index % len(LINES)]
                axes.hlines(reference.mean, *span, colors="black", linewidth=1, linestyles=line, label=once(policy))  # type: ignore[arg-type]
    axes.set_xticks([place + width * len(methods) / 2 for place in range(len(settings))], settings)
    axes.set(ylim=(0, 1.05), ylabel=metric, title=f"{domain.name}, K = 2, omega = {domain.omega}")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return figure
