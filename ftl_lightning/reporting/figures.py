"""Figures from results."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence, Set

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ftl_lightning.domains.comparison import CHOSEN, FINE_TUNED, OURS, PAPERS_METHOD, WITH_ADAPTER, WITH_KNOTS, WITH_MODES, Compared
from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.references import FRESH, REPLAYED
from ftl_lightning.evaluation.results import REFERENCE, latest
from ftl_lightning.evaluation.results import label as method_label
from ftl_lightning.reporting.comparison import compared, methods, reference_lines, shown_lines
from ftl_lightning.reporting.measurements import NOISY, Measured, reached
from ftl_lightning.reporting.table import lookup, main_omega, of_method, select, settings, summarise
from ftl_lightning.reporting.tables import AXES, labelled, main_rows, points
from ftl_lightning.services.text import figure_text

_MODES_OVER_TIME = f"{WITH_MODES} {WITH_KNOTS}"
OF_METHODS: Mapping[Compared, str] = {
    PAPERS_METHOD: "#0072b2",
    Compared(OURS, CHOSEN): "#56b4e9",
    Compared(OURS, f"{WITH_KNOTS} {CHOSEN}"): "#56b4e9",
    Compared(OURS, WITH_MODES): "#44aa99",
    Compared(OURS, WITH_KNOTS): "#999933",
    Compared(OURS, _MODES_OVER_TIME): "#332288",
    Compared(OURS, WITH_ADAPTER): "#aa4499",
    Compared(OURS, f"{_MODES_OVER_TIME} {WITH_ADAPTER}"): "#661100",
    Compared("BC"): "#e69f00",
    Compared("CVAE"): "#d55e00",
    Compared("in-context"): "#009e73",
    Compared("language"): "#cc79a7",
    Compared(FINE_TUNED): "#882255",
}
"""Colour of each method, the same in all figures: Okabe and Ito's (2008) and Tol's (2021), safe for colour-blind readers."""
SPARE = ("#117733", "#ddcc77", "#88ccee", "#555555")
"""Colours of user methods, used before colours of methods that a figure lacks."""
COLOURS = (*dict.fromkeys(OF_METHODS.values()), *SPARE)  # colours in order, for lines that are not methods
PAPER_COLOUR = "#9a9a9a"
LINES = ("dotted", "dashed", "dashdot", (0, (1, 4)), (0, (6, 2, 1, 2, 1, 2)), "solid")  # line styles of reference policies
REFERENCE_MARKS = {REPLAYED: "X", FRESH: "*"}  # markers of the references of novelty and coverage
WIDEST = 60.0  # maximum width of a figure in inches; a figure of thousands of settings would fill the memory


def colours(named: Iterable[tuple[str, Compared]]) -> dict[str, str]:
    """Assign a colour to each name of a method: its method's colour, else the colour of another form, else a spare colour."""
    chosen: dict[str, str] = {}
    waiting: dict[str, Compared] = {}
    for name, method in named:
        colour = OF_METHODS.get(method)
        if colour is None or colour in chosen.values():
            waiting[name] = method
        else:
            chosen[name] = colour
    for name, method in waiting.items():
        forms = [colour for known, colour in OF_METHODS.items() if known.name == method.name]
        left = [colour for colour in (*forms, *SPARE, *reversed(COLOURS)) if colour not in chosen.values()]
        chosen[name] = left[0] if left else COLOURS[len(chosen) % len(COLOURS)]
    return chosen


def _bar_axes(bars: int, beside: float) -> tuple[Figure, Axes]:
    """An empty figure for groups of bars, with ``beside`` inches for axis and legend."""
    figure = Figure(figsize=(min(1.9 * max(bars, 2) + beside, WIDEST), 3.4), layout="constrained")
    return figure, figure.subplots()


def _once(axes: Axes, label: str) -> str | None:
    """The legend entry of a label at its first use, else ``None``."""
    return None if figure_text(label) in axes.get_legend_handles_labels()[1] else figure_text(label)


def _policy_line(axes: Axes, index: int, policy: str, mean: float, start: float, end: float) -> None:
    line = LINES[index % len(LINES)]
    axes.hlines(mean, start, end, colors="black", linewidth=1, linestyles=line, label=_once(axes, policy))  # type: ignore[arg-type]


def _label_bars(axes: Axes, places: Sequence[float], shown: Sequence[str], metric: str, title: str) -> None:
    """Label axes with settings, wrapped so that neighbours do not touch, and draw the legend."""
    axes.set_xticks(places, [textwrap.fill(figure_text(setting), 18, break_long_words=False) for setting in shown])
    axes.set(ylim=(0, 1.05), ylabel=figure_text(metric), title=figure_text(title))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))


def accuracy_bars(domain: Domain, results: pd.DataFrame, metric: str = "accuracy") -> Figure:
    """Plot a metric of every setting beside the paper's numbers and references, for K = 2, else the K with most rows. Error
    bars are standard errors over tasks. ``results`` are rows of a results file.
    """
    rows = labelled(latest(select(results, domain=domain.name, metric=metric)))
    ours, how = main_rows(rows, main_omega(domain))
    shown, learned = settings(domain, ours), sorted(set(ours["label"]))
    figure, axes = _bar_axes(len(shown), 3.5)
    colour_of = colours(_labelled_methods(ours))
    width = 0.8 / (len(learned) + 1)
    references = select(rows, role=REFERENCE)
    policies = sorted(set(references["label"]))
    for place, setting in enumerate(shown):
        if papers := lookup(domain, setting, metric):
            label = _once(axes, "paper")
            axes.bar(place, papers.value, width, yerr=papers.error, color=PAPER_COLOUR, capsize=2, label=label)
        for index, name in enumerate(learned, start=1):
            if number := summarise(select(ours, setting=setting, label=name)):
                label, colour = _once(axes, name), colour_of[name]
                axes.bar(place + index * width, number.mean, width, yerr=number.error, color=colour, capsize=2, label=label)
        for index, policy in enumerate(policies):
            if reference := summarise(select(references, setting=setting, label=policy)):
                span = (place - width / 2, place + (len(learned) + 0.5) * width)
                _policy_line(axes, index, policy, reference.mean, *span)
    places = [place + width * len(learned) / 2 for place in range(len(shown))]
    _label_bars(axes, places, shown, metric, f"{domain.name}, {how}" if how else domain.name)
    return figure


def comparison_bars(domain: Domain, results: pd.DataFrame, metric: str = "accuracy") -> Figure:
    """Plot a metric of every setting for ours and the baselines, with references and the paper's numbers as diamonds. Error
    bars are standard errors over tasks. ``results`` are rows of a comparison.
    """
    rows = compared(domain, results)
    names = methods(rows)
    rows = select(rows, metric=metric)
    shown = settings(domain, rows)
    colour_of = colours((method_label(*method), method) for method in names)
    width = 0.8 / len(names)
    figure, axes = _bar_axes(len(shown), 3)
    for index, method in enumerate(names):
        method_rows, colour = of_method(rows, method), colour_of[method_label(*method)]
        for place, setting in enumerate(shown):
            where = place + (index - (len(names) - 1) / 2) * width
            label = None if place else figure_text(method_label(*method))
            if number := summarise(select(method_rows, setting=setting)):
                axes.bar(where, number.mean, width, yerr=number.error, color=colour, capsize=2, label=label)
            elif label and not method_rows.empty:
                axes.bar(where, 0, width, color=colour, label=label)
            if papers := lookup(domain, setting, metric, method=method):
                axes.plot(where, papers.value, "D", color="black", markersize=4, label=_once(axes, "the paper's"))
    references = select(reference_lines(domain, results), metric=metric)
    for index, policy in enumerate(sorted(set(references["method"]))):
        policy_rows = select(references, method=policy)
        for place, setting in enumerate(shown):
            if setting in set(policy_rows["setting"]):
                mean = select(policy_rows, setting=setting)["value"].mean()
                _policy_line(axes, index, policy, mean, place - 0.45, place + 0.45)
    _label_bars(axes, range(len(shown)), shown, metric, domain.name)
    return figure


MARKS = "os^Pv*X<h>p8d"  # markers of methods in the overview
ROW = 0.5  # height of a line of the overview in inches


def overview_dots(results: pd.DataFrame) -> Figure:
    """Plot all domains, settings and metrics of a comparison: a marker for each method, with standard errors over tasks. Open
    diamonds are the paper's numbers of the same method; ticks are references. Our forms are limited to the paper's,
    automatically chosen forms and the default forms of the domains. Rows are those of
    :func:`~ftl_lightning.reporting.comparison.all_methods`.
    """
    lines = shown_lines(results)
    series = _series(methods(results), {domain.comparison.ours for domain, _, _ in lines})
    colour_of = colours((label, forms[0]) for label, forms in series.items())
    panels = {domain.name: [line for line in lines if line[0].name == domain.name] for domain, _, _ in lines}
    sides: tuple[list[str], list[str]] = ([], [])
    for name in panels:
        min(sides, key=lambda side: sum(len(panels[shown]) + 1 for shown in side)).append(name)
    most = max((sum(len(panels[name]) + 1 for name in side) for side in sides), default=1)
    figure = Figure(figsize=(7.4, min(ROW * most + 0.9, WIDEST)), layout="constrained")
    halves, legend = figure.subfigures(2, 1, squeeze=False, height_ratios=[ROW * most, 0.9])[:, 0]
    for half, side in zip(halves.subfigures(1, 2, squeeze=False)[0], sides, strict=True):
        if side:
            spaces = [len(panels[name]) for name in side]
            for axes, name in zip(half.subplots(len(side), 1, squeeze=False, height_ratios=spaces)[:, 0], side, strict=True):
                _dots(axes, results, panels[name], series, colour_of)
    handles = {
        label: Line2D([], [], color=colour_of[label], marker=MARKS[index % len(MARKS)], linestyle="", markersize=5)
        for index, label in enumerate(series)
    }
    handles["the paper's"] = Line2D([], [], color="black", marker="D", markerfacecolor="none", linestyle="", markersize=5)
    handles["references"] = Line2D([], [], color="black", marker="|", linestyle="", markersize=8)
    legend.legend(list(handles.values()), list(map(figure_text, handles)), fontsize=8, loc="center", ncols=4, frameon=False)
    return figure


def _series(measured: Sequence[Compared], defaults: Set[Compared]) -> dict[str, list[Compared]]:
    """Methods of the overview by label; automatically chosen forms share a label."""
    series: dict[str, list[Compared]] = {}
    for method in measured:
        chosen = method.name == OURS and CHOSEN in method.form
        if chosen or method.name != OURS or not method.form or method in defaults:
            series.setdefault(method_label(OURS, CHOSEN) if chosen else method_label(*method), []).append(method)
    return series


def _dots(
    axes: Axes,
    results: pd.DataFrame,
    lines: Sequence[tuple[Domain, str, str]],
    series: Mapping[str, Sequence[Compared]],
    colour_of: Mapping[str, str],
) -> None:
    """Draw the panel of a domain, the first line on top; each line has its name, references, and methods below each other."""
    domain = lines[0][0]
    rows, references = compared(domain, results), reference_lines(domain, results)
    for place, (_, setting, metric) in enumerate(lines):
        title = f"{setting}, {metric}" + (" (less is better)" if domain.less_is_better(metric) else "")
        axes.text(0, place - 0.34, figure_text(title), fontsize=7, va="center")
        means = select(references, setting=setting, metric=metric).groupby("method")["value"].mean()
        axes.plot(means, [place - 0.12] * len(means), "|", color="black", markersize=5, markeredgewidth=1)
        for index, (label, forms) in enumerate(series.items()):
            height = place + 0.4 * index / max(len(series) - 1, 1)
            mark = {"color": colour_of[label], "markersize": 4}
            for method in forms:
                if number := summarise(select(of_method(rows, method), setting=setting, metric=metric)):
                    axes.errorbar(number.mean, height, xerr=number.error, fmt=MARKS[index % len(MARKS)], elinewidth=1, **mark)  # type: ignore[arg-type]
                    if papers := lookup(domain, setting, metric, method=method):
                        between = [number.mean, papers.value]
                        axes.plot(between, [height] * 2, color=colour_of[label], linewidth=0.5, linestyle="dotted")
                        axes.plot(papers.value, height, "D", markerfacecolor="none", **mark)  # type: ignore[arg-type]
        if place:
            axes.axhline(place - 0.5, color=PAPER_COLOUR, linewidth=0.4)
    axes.set(ylim=(len(lines) - 0.5, -0.5), yticks=[])
    axes.set_xlim(-0.03, max(1.03, axes.get_xlim()[1]))
    axes.tick_params(labelsize=7)
    axes.grid(axis="x", linewidth=0.3)
    axes.set_title(figure_text(domain.name), fontsize=9, loc="left", fontweight="bold")


def _labelled_methods(rows: pd.DataFrame) -> list[tuple[str, Compared]]:
    """Sorted labels, each with its method."""
    known = rows.drop_duplicates("label").sort_values("label")
    return [(str(row.label), Compared(str(row.method), str(row.form))) for row in known.itertuples()]


def growth(domain: Domain, results: pd.DataFrame) -> Figure:
    """Plot accuracy against the number of demonstrations and against K, with standard errors over tasks, from rows of curves."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    for axes, axis in zip(figure.subplots(1, len(AXES), sharey=True), AXES, strict=True):
        rows = points(domain, results, axis)
        for colour, setting in zip(COLOURS, dict.fromkeys(rows["setting"]), strict=False):
            setting_rows = select(rows, setting=setting)
            counts = sorted(set(setting_rows[axis]))
            numbers = [summarise(select(setting_rows, **{axis: count})) for count in counts]
            means = [number.mean for number in numbers if number]
            errors = [number.error or 0.0 for number in numbers if number]
            axes.errorbar(counts, means, errors, marker="o", capsize=2, color=colour, label=figure_text(setting))
        axes.set(xlabel=axis, ylim=(0, 1.05))
        axes.set_xticks(sorted(set(rows[axis])))
        if axis == "demonstrations":
            axes.set_ylabel(figure_text(" ".join(set(rows["metric"]))))
            axes.legend(fontsize=8, loc="lower right")
    figure.suptitle(figure_text(domain.name), fontsize=10)
    return figure


def frontier(domain: Domain, rows: pd.DataFrame) -> Figure:
    """Plot accuracy over coverage for each suite and setting: a line for each method, temperature from dark to light. Points are
    means over tasks and seeds. Less coverage is better, so better methods lie further up and to the left. Crosses and stars are the
    references *demonstrations replayed* and *fresh samples*. Rows are those of
    :func:`~ftl_lightning.reporting.measurements.read_frontier`.
    """
    rows = rows[rows["domain"] == domain.name].dropna(subset=["accuracy", "coverage"])
    rows = rows.assign(panel=rows["setting"] + (", " + rows["suite"] if len(set(rows["suite"])) > 1 else ""))
    shown = list(dict.fromkeys(rows["panel"]))
    figure = Figure(figsize=(min(3.6 * max(len(shown), 1) + 2.2, WIDEST), 3.6), layout="constrained")
    panels = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    lines = labelled(rows[~rows["method"].isin(list(REFERENCE_MARKS))])
    colour_of = colours(_labelled_methods(lines))
    for axes, panel in zip(panels, shown, strict=False):
        for label, colour in colour_of.items():
            by_temperature = select(lines, panel=panel, label=label).groupby("temperature", dropna=False)
            means = by_temperature[["coverage", "accuracy"]].mean().sort_index()
            if means.empty:
                continue
            axes.plot(means["coverage"], means["accuracy"], color=colour, linewidth=1, label=figure_text(label))
            strengths = [1 - 0.75 * place / len(means) for place in range(len(means))]
            axes.scatter(means["coverage"], means["accuracy"], color=colour, alpha=strengths, s=22)
        for method, mark in REFERENCE_MARKS.items():
            mean = select(rows, panel=panel, method=method)[["coverage", "accuracy"]].mean()
            if mean.notna().all():
                axes.plot(mean["coverage"], mean["accuracy"], mark, color="black", markersize=8, label=method)
        axes.set(xlabel="coverage (less is better)", ylim=(-0.05, 1.05), title=figure_text(panel))
    panels[0].set_ylabel(figure_text(domain.main_metric))
    handles = {name: handle for axes in panels for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(list(handles.values()), list(handles), fontsize=8, loc="outside right upper")
    known = lines.loc[lines["method"] != NOISY, "temperature"].dropna()
    temperatures = "none" if known.empty else f"{known.min():g} (dark) to {known.max():g}"
    figure.suptitle(figure_text(f"{domain.name}: temperature from {temperatures}"), fontsize=10)
    return figure


def learning_time(curves: Mapping[str, Sequence[Measured]]) -> Figure:
    """Plot accuracy over seconds of learning, a line for each curve; the dotted line is the accuracy that all curves reach."""
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for colour, (name, curve) in zip(COLOURS, curves.items(), strict=False):
        seconds, accuracy = ([getattr(point, axis) for point in curve] for axis in ("seconds", "accuracy"))
        axes.plot(seconds, accuracy, "o-", color=colour, markersize=4, label=figure_text(name))
    axes.axhline(reached(curves), color=PAPER_COLOUR, linestyle="dotted")
    axes.set(xscale="log", xlabel="seconds of learning", ylabel="accuracy", ylim=(-0.05, 1.05))
    figure.legend(fontsize=8, loc="outside upper center", ncols=len(curves))
    return figure
