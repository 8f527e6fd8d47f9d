"""Figures from results."""

import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import NamedTuple

import pandas as pd
from matplotlib.artist import Artist
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

_MODES_KNOTS = f"{WITH_MODES}, {WITH_KNOTS}"
OF_METHODS: Mapping[Compared, str] = {
    PAPERS_METHOD: "#0072b2",
    Compared(OURS, CHOSEN): "#56b4e9",
    Compared(OURS, f"{WITH_KNOTS}, {CHOSEN}"): "#56b4e9",
    Compared(OURS, WITH_MODES): "#44aa99",
    Compared(OURS, WITH_KNOTS): "#999933",
    Compared(OURS, _MODES_KNOTS): "#332288",
    Compared(OURS, WITH_ADAPTER): "#aa4499",
    Compared(OURS, f"{_MODES_KNOTS}, {WITH_ADAPTER}"): "#661100",
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
REFERENCE_MARKS = {REPLAYED: "X", FRESH: "*"}  # markers of the references of novelty and coverage
WIDTH, FONT = 4.4, 11.0  # inches, and points of all text: 12 pixels where a page shows a figure 358 pixels wide
TALLEST = 60.0  # maximum height of a figure in inches; a figure of thousands of settings would fill the memory
LABEL = 22  # maximum number of characters in a line of a bar's label
LINE = 0.19  # height of a line of text in inches


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


class Bar(NamedTuple):
    """A horizontal bar: label, mean, standard error, colour (``None`` for a reference), and the paper's number, if any."""

    label: str
    mean: float
    error: float | None = None
    colour: str | None = None
    paper: float | None = None


def _stacked(heights: Sequence[float], beside: float = 0.0) -> tuple[Figure, list[Axes]]:
    """A figure of axes below each other with heights in inches, and ``beside`` inches for a legend."""
    figure = Figure(figsize=(WIDTH, min(sum(heights) + beside, TALLEST)), layout="constrained")
    panels = list(figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0])
    for axes in panels:
        axes.tick_params(labelsize=FONT)
    return figure, panels


def _title(axes: Axes, title: str, width: int = 2 * LABEL) -> None:
    wrapped = textwrap.fill(figure_text(title), width, break_long_words=False)
    axes.set_title(wrapped, fontsize=FONT, loc="left", fontweight="bold")


def _bars(panels: Mapping[str, Sequence[Bar]]) -> Figure:
    """Plot bars with their values; a panel for each title. Bars of references are empty, diamonds are the paper's numbers."""
    labels = {title: [textwrap.fill(figure_text(bar.label), LABEL) for bar in bars] for title, bars in panels.items()}
    lines = {title: [text.count("\n") + 1 for text in texts] for title, texts in labels.items()}
    figure, axes_of = _stacked([LINE * (sum(counts) + 4.5) for counts in lines.values()])
    for axes, (title, bars) in zip(axes_of, panels.items(), strict=True):
        ends = list(itertools.accumulate(lines[title]))
        places = [end - count / 2 for end, count in zip(ends, lines[title], strict=True)]
        for place, bar in zip(places, bars, strict=True):
            edge = {"color": bar.colour} if bar.colour else {"facecolor": "white", "edgecolor": "black"}
            axes.barh(place, bar.mean, 0.8, xerr=bar.error, capsize=2, label=figure_text(bar.label), **edge)  # type: ignore[arg-type]
            end = bar.mean + (bar.error or 0)
            axes.annotate(f"{bar.mean:.2f}", (end, place), (4, 0), textcoords="offset points", va="center", fontsize=FONT)
            if bar.paper is not None:
                axes.plot(bar.paper, place, "D", color="black", markersize=5)
        highest = max((max(bar.mean + (bar.error or 0), bar.paper or 0) for bar in bars), default=1.0)
        axes.set_yticks(places, labels[title])
        axes.set(xlim=(0, 1.2 * max(highest, 1.0)), ylim=(max(ends, default=1) + 0.2, -0.2))
        axes.spines[["top", "right"]].set_visible(False)
        _title(axes, title, LABEL + 4)
    return figure


def accuracy_bars(domain: Domain, results: pd.DataFrame, metric: str = "accuracy") -> Figure:
    """Plot a metric of every setting beside the paper's numbers and references, for K = 2, else the K with most rows. Error
    bars are standard errors over tasks. ``results`` are rows of a results file.
    """
    rows = labelled(latest(select(results, domain=domain.name, metric=metric)))
    ours, how = main_rows(rows, main_omega(domain))
    colour_of, references = colours(_labelled_methods(ours)), select(rows, role=REFERENCE)
    panels = {}
    for setting in settings(domain, ours):
        papers = lookup(domain, setting, metric)
        bars = [Bar("paper", papers.value, papers.error, PAPER_COLOUR)] if papers else []
        for name, colour in colour_of.items():
            if number := summarise(select(ours, setting=setting, label=name)):
                bars.append(Bar(name, number.mean, number.error, colour))
        panels[f"{domain.name}, {how}: {setting}" if how else f"{domain.name}: {setting}"] = bars + _references(references, setting)
    return _bars(panels)


def _references(rows: pd.DataFrame, setting: str) -> list[Bar]:
    """Bars of the references of a setting, by name."""
    means = select(rows, setting=setting).groupby("method")["value"].mean()
    return [Bar(str(name), float(mean)) for name, mean in means.items()]


def comparison_bars(domain: Domain, results: pd.DataFrame, metric: str = "accuracy") -> Figure:
    """Plot a metric of every setting for ours and the baselines, with references and the paper's numbers as diamonds. Error
    bars are standard errors over tasks. ``results`` are rows of a comparison.
    """
    rows = compared(domain, results)
    names = methods(rows)
    rows = select(rows, metric=metric)
    colour_of = colours((method_label(*method), method) for method in names)
    references = select(reference_lines(domain, results), metric=metric)
    panels = {}
    for setting in settings(domain, rows):
        bars = []
        for method in names:
            papers, label = lookup(domain, setting, metric, method=method), method_label(*method)
            if number := summarise(select(of_method(rows, method), setting=setting)):
                bars.append(Bar(label, number.mean, number.error, colour_of[label], papers.value if papers else None))
        panels[f"{setting}, {metric}" + (" (less is better)" if domain.less_is_better(metric) else "")] = bars + _references(
            references, setting
        )
    return _bars(panels)


MARKS = "os^Pv*X<h>p8d"  # markers of methods in the overview
ROW = 0.7  # height of a line of the overview in inches


def overview_dots(results: pd.DataFrame) -> Figure:
    """Plot the headline metric of all domains and settings: a marker for each method, with standard errors over tasks. Open
    diamonds are the paper's numbers of the same method; ticks are references. Our forms are limited to the paper's,
    automatically chosen forms and the default forms of the domains. Rows are those of
    :func:`~ftl_lightning.reporting.comparison.all_methods`.
    """
    lines = [line for line in shown_lines(results) if line[2] == line[0].comparison.headline] or shown_lines(results)
    series = _series(methods(results), {domain.comparison.ours for domain, _, _ in lines})
    colour_of = colours((label, forms[0]) for label, forms in series.items())
    panels = {domain.name: [line for line in lines if line[0].name == domain.name] for domain, _, _ in lines}
    entries = len(series) + 2
    figure, axes_of = _stacked([ROW * len(shown) + 0.5 for shown in panels.values()] or [1.0], LINE * 1.3 * entries)
    for axes, shown in zip(axes_of, panels.values(), strict=False):
        _dots(axes, results, shown, series, colour_of)
    handles = {
        figure_text(label): Line2D([], [], color=colour_of[label], marker=MARKS[index % len(MARKS)], linestyle="", markersize=6)
        for index, label in enumerate(series)
    }
    handles["the paper's"] = Line2D([], [], color="black", marker="D", markerfacecolor="none", linestyle="", markersize=6)
    handles["references"] = Line2D([], [], color="black", marker="|", linestyle="", markersize=9)
    _legend(figure, handles)
    return figure


def _legend(figure: Figure, handles: Mapping[str, Artist]) -> None:
    """Draw a legend below a figure, an entry in a line."""
    figure.legend(list(handles.values()), list(handles), fontsize=FONT, loc="outside lower left", frameon=False)


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
        axes.text(0, place - 0.34, figure_text(title), fontsize=FONT, va="center")
        means = select(references, setting=setting, metric=metric).groupby("method")["value"].mean()
        axes.plot(means, [place - 0.12] * len(means), "|", color="black", markersize=6, markeredgewidth=1)
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
    axes.grid(axis="x", linewidth=0.3)
    _title(axes, domain.name)


def _labelled_methods(rows: pd.DataFrame) -> list[tuple[str, Compared]]:
    """Sorted labels, each with its method."""
    known = rows.drop_duplicates("label").sort_values("label")
    return [(str(row.label), Compared(str(row.method), str(row.form))) for row in known.itertuples()]


def growth(domain: Domain, results: pd.DataFrame) -> Figure:
    """Plot accuracy against the number of demonstrations and against K, with standard errors over tasks, from rows of curves."""
    figure, panels = _stacked([2.6] * len(AXES), 0.5)
    for axes, axis in zip(panels, AXES, strict=True):
        rows = points(domain, results, axis)
        for colour, setting in zip(COLOURS, dict.fromkeys(rows["setting"]), strict=False):
            setting_rows = select(rows, setting=setting)
            counts = sorted(set(setting_rows[axis]))
            numbers = [summarise(select(setting_rows, **{axis: count})) for count in counts]
            means = [number.mean for number in numbers if number]
            errors = [number.error or 0.0 for number in numbers if number]
            axes.errorbar(counts, means, errors, marker="o", capsize=2, color=colour, label=figure_text(setting))
        axes.set(ylim=(0, 1.05))
        axes.set_xlabel(axis, fontsize=FONT)
        axes.set_ylabel(figure_text(" ".join(set(rows["metric"]))), fontsize=FONT)
        axes.set_xticks(sorted(set(rows[axis])))
    _title(panels[0], domain.name)
    _legend(figure, _handles(panels))
    return figure


def _handles(panels: Sequence[Axes]) -> dict[str, Artist]:
    """Legend entries of several axes by label, each once."""
    return {name: handle for axes in panels for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}


def frontier(domain: Domain, rows: pd.DataFrame) -> Figure:
    """Plot accuracy over coverage for each suite and setting: a line for each method, temperature from dark to light. Points are
    means over tasks and seeds. Less coverage is better, so better methods lie further up and to the left. Crosses and stars are the
    references *demonstrations replayed* and *fresh samples*. Rows are those of
    :func:`~ftl_lightning.reporting.measurements.read_frontier`.
    """
    rows = rows[rows["domain"] == domain.name].dropna(subset=["accuracy", "coverage"])
    rows = rows.assign(panel=rows["setting"] + (", " + rows["suite"] if len(set(rows["suite"])) > 1 else ""))
    shown = list(dict.fromkeys(rows["panel"]))
    lines = labelled(rows[~rows["method"].isin(list(REFERENCE_MARKS))])
    colour_of = colours(_labelled_methods(lines))
    figure, panels = _stacked([3.2] * max(len(shown), 1), LINE * 1.3 * (len(colour_of) + len(REFERENCE_MARKS)))
    for axes, panel in zip(panels, shown, strict=False):
        for label, colour in colour_of.items():
            by_temperature = select(lines, panel=panel, label=label).groupby("temperature", dropna=False)
            means = by_temperature[["coverage", "accuracy"]].mean().sort_index()
            if means.empty:
                continue
            axes.plot(means["coverage"], means["accuracy"], color=colour, linewidth=1, label=figure_text(label))
            strengths = [1 - 0.75 * place / len(means) for place in range(len(means))]
            axes.scatter(means["coverage"], means["accuracy"], color=colour, alpha=strengths, s=22)  # type: ignore[arg-type]
        for method, mark in REFERENCE_MARKS.items():
            mean = select(rows, panel=panel, method=method)[["coverage", "accuracy"]].mean()
            if mean.notna().all():
                axes.plot(mean["coverage"], mean["accuracy"], mark, color="black", markersize=8, label=figure_text(method))
        axes.set(ylim=(-0.05, 1.05))
        axes.set_ylabel(figure_text(domain.main_metric), fontsize=FONT)
        _title(axes, panel)
    known = lines.loc[lines["method"] != NOISY, "temperature"].dropna()
    temperatures = "" if known.empty else f"\ntemperature {known.min():g} (dark) to {known.max():g} (light)"
    panels[-1].set_xlabel(f"coverage (less is better){temperatures}", fontsize=FONT)
    _legend(figure, _handles(panels))
    return figure


def learning_time(curves: Mapping[str, Sequence[Measured]]) -> Figure:
    """Plot accuracy over seconds of learning, a line for each curve; the dotted line is the accuracy that all curves reach."""
    figure, (axes,) = _stacked([3.4], LINE * 1.3 * len(curves))
    for colour, (name, curve) in zip(COLOURS, curves.items(), strict=False):
        seconds, accuracy = ([getattr(point, axis) for point in curve] for axis in ("seconds", "accuracy"))
        axes.plot(seconds, accuracy, "o-", color=colour, markersize=4, label=figure_text(name))
    axes.axhline(reached(curves), color=PAPER_COLOUR, linestyle="dotted")
    axes.set(xscale="log", ylim=(-0.05, 1.05))
    axes.set_xlabel("seconds of learning", fontsize=FONT)
    axes.set_ylabel("accuracy", fontsize=FONT)
    _legend(figure, _handles([axes]))
    return figure
