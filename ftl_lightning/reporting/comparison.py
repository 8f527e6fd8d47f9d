"""Our method against the baselines, each number beside the paper's and their difference."""

from collections.abc import Sequence

import pandas as pd

from ftl_lightning.domains.domain import OURS, Domain, Published, load_domain
from ftl_lightning.evaluation.judged import ACCURACY, CLOSED, standard_error
from ftl_lightning.evaluation.results import latest
from ftl_lightning.reporting.tables import EXECUTED, MISSING, Number, Table, difference_to, paper, summarise

LANGUAGE = "language"
METHODS = (OURS, "BC", "CVAE", "in-context", LANGUAGE)
RESOLUTION = 0.005
"""What is nearer than that looks the same in the table."""


def family(method: str) -> str:
    """A method's name without what it tells of itself in brackets."""
    return method.partition(" (")[0]


def reference_lines(domain: Domain, results: pd.DataFrame) -> pd.DataFrame:
    """The latest rows of what stands beside all methods: chance, trivial policies and oracles."""
    return latest(results[(results["domain"] == domain.name) & (results["omega"] == "")])


def compared(domain: Domain, results: pd.DataFrame) -> pd.DataFrame:
    """The latest rows of a domain's methods, with a column ``family``."""
    rows = latest(results[(results["domain"] == domain.name) & (results["omega"] != "")])
    return rows.assign(family=rows["method"].map(family))


def metrics(domain: Domain) -> tuple[str, ...]:
    """What the methods are compared by: the paper's metrics, and what our tables take for a success."""
    headline = f"{CLOSED} {domain.closed_loop.headline}" if domain.closed_loop else EXECUTED
    own = ([ACCURACY] if domain.succeeded else []) + ([EXECUTED, headline] if domain.closed_loop else [])
    return tuple(dict.fromkeys((*own, *(one.metric for one in domain.published))))


def published(domain: Domain, method: str, setting: str, metric: str) -> Published | None:
    """The paper's number, if it has one; of ours, that of its main figures."""
    for found in domain.published:
        main = method != OURS or (found.components, found.omega) == (2, domain.published_omega)
        if main and (found.method, found.setting, found.metric, found.task) == (method, setting, metric, ""):
            return found
    return None


def settings(domain: Domain) -> list[str]:
    """Of training and of the paper, in their order."""
    return list(dict.fromkeys(name for suite in ("training", "paper") for name in domain.suites[suite].settings))


def comparison_table(domain: Domain, results: pd.DataFrame) -> Table:
    """One line for each setting, metric and method: measured, its errors, the paper's number, and the difference."""
    rows, references = compared(domain, results), reference_lines(domain, results)
    lines = []
    for setting in settings(domain):
        for metric in metrics(domain):
            own, around = (found[(found["setting"] == setting) & (found["metric"] == metric)] for found in (rows, references))
            numbers = [(method, summarise(own[own["family"] == method])) for method in METHODS]
            numbers += [(name, summarise(around[around["method"] == name])) for name in sorted(set(around["method"]))]
            for method, number in numbers:
                if number:
                    lines.append([setting, metric, method, *beside(number, published(domain, method, setting, metric))])
    caption = f"{domain.name}: all methods, learned from five demonstrations"
    return Table("comparison", caption, pd.DataFrame(lines, columns=["setting", "metric", "method", *BESIDE], dtype=str))


BESIDE = ("measured", "standard error over tasks", "spread over seeds", "paper", "difference")


def beside(number: Number, theirs: Published | None) -> list[str]:
    """The columns :data:`BESIDE`."""
    error, spread = (MISSING if value is None else f"{value:.2f}" for value in (number.error, number.spread))
    return [f"{number.mean:.2f}", error, spread, paper(theirs), difference_to(theirs, number)]


def lead(rows: pd.DataFrame, less: bool = False, others: Sequence[str] = METHODS[1:]) -> tuple[float, float] | None:
    """Ours less the best baseline, and its standard error; negative where a baseline is better. ``None`` of a single difference.

    Differences are taken task for task; of a single task, seed for seed.

    Args:
        rows: of one setting and metric, see :func:`compared`.
        less: of the metric less is better.
        others: baselines that are compared with.
    """
    sign = -1 if less else 1
    by = "task" if len(set(rows["task"])) > 1 else "seed"
    means = sign * rows.pivot_table(index=by, columns="family", values="value")
    others = [name for name in others if name in means]
    if OURS not in means or not others:
        return None
    best = max(others, key=lambda name: means[name].mean())
    differences = (means[OURS] - means[best]).dropna()
    return (float(differences.mean()), standard_error(differences.tolist())) if len(differences) > 1 else None


def overview(results: pd.DataFrame) -> Table:
    """All domains on one screen: ours and the baselines, the paper's numbers in brackets."""
    lines = []
    for name in sorted(set(results["domain"])):
        domain = load_domain(name)
        rows, references = compared(domain, results), reference_lines(domain, results)
        training = domain.suites["training"].settings  # there language is ours: the same model and the same words
        for setting in settings(domain):
            others = [method for method in METHODS[1:] if not (method == LANGUAGE and setting in training)]
            for metric in metrics(domain):
                own = rows[(rows["setting"] == setting) & (rows["metric"] == metric)]
                if not own.empty:
                    less = domain.closed_loop is not None and metric.removeprefix(f"{CLOSED} ") in domain.closed_loop.costs
                    cells = [_cell(domain, own, method, setting, metric) for method in METHODS]
                    around = references[(references["setting"] == setting) & (references["metric"] == metric)]
                    lines.append([name, f"{setting}, {metric}", *cells, _lead(lead(own, less, others)), _around(around)])
    caption = "Ours and the baselines, mean ± standard error over tasks [the paper's]; then ours less the best baseline"
    return Table(
        "overview",
        caption,
        pd.DataFrame(lines, columns=["domain", "setting, metric", *METHODS, "lead", "reference lines"], dtype=str),
    )


def _cell(domain: Domain, rows: pd.DataFrame, method: str, setting: str, metric: str) -> str:
    number, theirs = summarise(rows[rows["family"] == method]), published(domain, method, setting, metric)
    if number is None:
        return MISSING
    error = "" if number.error is None else f" ± {number.error:.2f}"
    return f"{number.mean:.2f}{error}" + ("" if theirs is None else f" [{theirs.value:.2f}]")


def _around(rows: pd.DataFrame) -> str:
    means = rows.groupby("method")["value"].mean().sort_values()
    return ", ".join(f"{method} {mean:.2f}" for method, mean in means.items()) or MISSING


def _lead(found: tuple[float, float] | None) -> str:
    if found is None:
        return MISSING
    difference, error = found
    margin = max(error, RESOLUTION)
    verdict = "ahead" if difference > margin else "behind" if difference < -margin else "even"
    return f"{difference:+.2f} ± {error:.2f}, {verdict}"
