"""Tables from results, each number beside the paper's: Markdown to read, LaTeX to paste."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from ftl_lightning.domains.domain import OURS, Domain, Published
from ftl_lightning.evaluation.evaluator import OWN
from ftl_lightning.evaluation.judged import ACCURACY, CLOSED, LOST, SUCCESS, WON, standard_error
from ftl_lightning.evaluation.results import latest

MISSING = "-"
EXECUTED = f"{CLOSED} {SUCCESS}"


@dataclass(frozen=True)
class Number:
    """A measured accuracy.

    Attributes:
        mean: over tasks and seeds.
        error: standard error over tasks, of the means over seeds; ``None`` for a single task.
        spread: standard deviation over seeds, of the means over tasks; ``None`` for a single seed.
        seeds: how many.
    """

    mean: float
    error: float | None
    spread: float | None
    seeds: int

    def __str__(self) -> str:
        error = "" if self.error is None else f" ± {self.error:.2f}"
        spread = "" if self.spread is None else f" (seeds {self.spread:.2f})"
        return f"{self.mean:.2f}{error}{spread}"


def summarise(rows: pd.DataFrame) -> Number | None:
    """The number behind some rows of the results, or ``None`` for no rows."""
    if rows.empty:
        return None
    by_task = rows.groupby("task")["value"].mean()
    by_seed = rows.groupby("seed")["value"].mean()
    return Number(
        mean=float(by_task.mean()),
        error=standard_error(by_task.tolist()) if len(by_task) > 1 else None,
        spread=float(by_seed.std()) if len(by_seed) > 1 else None,
        seeds=len(by_seed),
    )


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: of its files.
        caption: one sentence.
        cells: rows and columns of text.
    """

    name: str
    caption: str
    cells: pd.DataFrame

    def markdown(self) -> str:
        """GitHub's Markdown, caption first."""
        lines = [list(self.cells.columns), ["---"] * len(self.cells.columns), *self.cells.to_numpy().tolist()]
        return f"**{self.caption}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def latex(self) -> str:
        """A booktabs table."""
        lines = [" & ".join(map(_escape, row)) + r" \\" for row in [list(self.cells.columns), *self.cells.to_numpy().tolist()]]
        columns = "l" + "c" * (len(self.cells.columns) - 1)
        body = "\n".join((lines[0], r"\midrule", *lines[1:]))
        return (
            f"\\begin{{table}}\n\\caption{{{_escape(self.caption)}}}\n\\begin{{tabular}}{{{columns}}}\n\\toprule\n{body}\n"
            "\\bottomrule\n\\end{tabular}\n\\end{table}\n"
        )


def _escape(text: str) -> str:
    for plain, escaped in (("&", r"\&"), ("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$")):
        text = text.replace(plain, escaped)
    return text


def _select(rows: pd.DataFrame, **values: object) -> pd.DataFrame:
    for column, value in values.items():
        rows = rows[rows[column] == value]
    return rows


def paper(found: Published | None) -> str:
    """The paper's number with its standard error."""
    if found is None:
        return MISSING
    return f"{found.value:.2f}" + ("" if found.error is None else f" ± {found.error:.2f}")


def difference_to(found: Published | None, number: Number | None) -> str:
    """Ours less the paper's."""
    return MISSING if found is None or number is None else f"{number.mean - found.value:+.2f}"


def _text(number: Number | None) -> str:
    return MISSING if number is None else str(number)


def _beside(found: Published | None, numbers: Sequence[Number | None]) -> list[str]:
    """The paper's number, and each of ours with its difference from it."""
    return [paper(found), *(text for number in numbers for text in (_text(number), difference_to(found, number)))]


def _beside_head(methods: Sequence[str]) -> list[str]:
    return ["paper", *(head for method in methods for head in (method, "difference"))]


def _columns(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Methods that learn concepts and reference policies among the results, each sorted."""
    return sorted(set(rows.loc[rows["K"] > 0, "method"])), sorted(set(rows.loc[rows["omega"] == "", "method"]))


def tables(domain: Domain, results: pd.DataFrame) -> list[Table]:
    """Every table of a domain for which there are results."""
    every = latest(_select(results, domain=domain.name))
    # Ablations are about plans where they are judged, else about episodes.
    metric = ACCURACY if domain.succeeded else EXECUTED
    rows = _select(every, metric=metric)
    candidates = (
        _accuracy(domain, _select(every, metric=ACCURACY), ACCURACY, "accuracy"),
        _accuracy(domain, _select(every, metric=EXECUTED), EXECUTED, "closed_loop"),
        _outcomes(domain, every),
        _paired(domain, every),
        _count(domain, rows, metric),
        _omega(domain, rows, metric),
        _components(domain, rows, metric),
    )
    return [table for table in candidates if not table.cells.empty]


def _lookup(domain: Domain, setting: str, task: str, components: int, omega: str, metric: str) -> Published | None:
    asked = (setting, task, components, omega, metric, OURS)
    for found in domain.published:
        if (found.setting, found.task, found.components, found.omega, found.metric, found.method) == asked:
            return found
    return None


def _accuracy(domain: Domain, rows: pd.DataFrame, metric: str, name: str) -> Table:
    """The bars of the paper's main figure, with trivial policies and the oracle beside them."""
    learned, references = _columns(rows)
    lines = []
    for setting in _settings(domain):
        alone = [
            found.task
            for found in domain.published
            if found.setting == setting and found.task and found.omega == domain.published_omega
        ]
        for task in ("", *alone):
            own = _select(rows, setting=setting) if not task else _select(rows, setting=setting, task=task)
            ours = _select(own, K=2, omega=domain.omega)
            if ours.empty:
                continue
            theirs = _lookup(domain, setting, task, 2, domain.published_omega, metric)
            line = [f"- {task}" if task else setting]
            line += _beside(theirs, [summarise(_select(ours, method=method)) for method in learned])
            line += [_text(summarise(_select(own, K=0, method=method))) for method in references]
            lines.append(line)
    other = "" if domain.omega == domain.published_omega else f" (the paper's: {domain.published_omega})"
    caption = (
        f"{domain.name}: {metric}, K = 2, {_weights(domain.omega)}{other}. Mean ± standard error over tasks (spread over seeds)"
    )
    return Table(name, caption, pd.DataFrame(lines, columns=["setting", *_beside_head(learned), *references], dtype=str))


def _weights(omega: str) -> str:
    return "learned weights" if omega == "learned" else f"fixed omega {omega}"


def _outcomes(domain: Domain, every: pd.DataFrame) -> Table:
    """All that happened in closed loop, by setting."""
    executed = every[every["metric"].str.startswith(CLOSED)]
    ours = _select(executed, K=2, omega=domain.omega)
    learned, references = _columns(executed)
    lines = [
        [
            setting,
            metric.removeprefix(f"{CLOSED} "),
            *_beside(
                _lookup(domain, setting, "", 2, domain.published_omega, metric),
                [summarise(_select(ours, setting=setting, metric=metric, method=method)) for method in learned],
            ),
            *(_text(summarise(_select(executed, setting=setting, metric=metric, K=0, method=method))) for method in references),
        ]
        for setting in _settings(domain)
        for metric in dict.fromkeys(_select(ours, setting=setting)["metric"])
    ]
    caption = f"{domain.name}: what happened in closed loop, K = 2, {_weights(domain.omega)}"
    return Table("outcomes", caption, pd.DataFrame(lines, columns=["setting", "", *_beside_head(learned), *references], dtype=str))


def difference(won: int, lost: int, count: int) -> str:
    """A paired difference of two success rates with its 95 % interval, and McNemar's exact p.

    Args:
        won, lost: pairs in which only the one succeeds, and only the other.
        count: all pairs.
    """
    mean = (won - lost) / count
    error = 1.96 * math.sqrt(won + lost - (won - lost) ** 2 / count) / count
    fewer, apart = min(won, lost), won + lost
    chance = min(1.0, 2 * sum(math.comb(apart, k) for k in range(fewer + 1)) / 2**apart)
    return f"{mean:+.2f} [{mean - error:+.2f}, {mean + error:+.2f}], p = {chance:.3f}"


def _paired(domain: Domain, every: pd.DataFrame) -> Table:
    """Our successes less those of reference policies from the same starts, over all seeds."""
    ours = every[(every["K"] == 2) & (every["omega"] == domain.omega)]
    learned, _ = _columns(ours[ours["metric"].str.startswith(WON)])
    lines = []
    for setting in _settings(domain):
        for policy in domain.closed_loop.policies if domain.closed_loop else ():
            line = []
            for method in learned:
                won, lost = (_select(ours, setting=setting, method=method, metric=f"{what}{policy}") for what in (WON, LOST))
                gains, losses = (round(float((rows["value"] * rows["n"]).sum())) for rows in (won, lost))
                line.append(MISSING if won.empty else difference(gains, losses, int(won["n"].sum())))
            if set(line) - {MISSING}:
                lines.append([setting, policy, *line])
    headline = domain.closed_loop.headline if domain.closed_loop else ""
    caption = f"{domain.name}: {headline} less that of policies from the same starts, 95 % interval, McNemar's exact p"
    return Table("paired", caption, pd.DataFrame(lines, columns=["setting", "compared with", *learned], dtype=str))


def _settings(domain: Domain) -> list[str]:
    """Settings of the paper's suites, without the analysis of components, and the user's own demonstrations."""
    names = [setting for suite in ("training", "paper") for setting in domain.suites[suite].settings]
    return [*dict.fromkeys(names), OWN]


def _grid(
    name: str,
    caption: str,
    learned: Sequence[str],
    lines: Sequence[tuple[str, str, Published | None, pd.DataFrame]],
    heads: tuple[str, str],
) -> Table:
    cells = [
        [first, second, *_beside(theirs, [summarise(_select(ours, method=method)) for method in learned])]
        for first, second, theirs, ours in lines
        if not ours.empty
    ]
    return Table(name, caption, pd.DataFrame(cells, columns=[*heads, *_beside_head(learned)], dtype=str))


def _count(domain: Domain, rows: pd.DataFrame, metric: str) -> Table:
    """The ablation on the number of learned concepts, with learned weights."""
    own = _select(rows, omega="learned")
    learned, _ = _columns(own)
    lines = [
        (
            setting,
            str(count),
            _lookup(domain, setting, "", count, "learned", metric),
            _select(own, setting=setting, K=count),
        )
        for setting in domain.suites["paper"].settings
        for count in sorted(set(own.loc[own["K"] > 0, "K"]))
    ]
    caption = f"{domain.name}: number of learned concepts K, with learned weights"
    return _grid("concept_count", caption, learned, lines, ("setting", "K"))


def _omega(domain: Domain, rows: pd.DataFrame, metric: str) -> Table:
    """The effect of the guidance weight, K = 2."""
    own = _select(rows, K=2)
    learned, _ = _columns(own)
    settings = domain.suites["paper"].settings
    lines = [
        (
            setting,
            omega,
            _lookup(domain, setting, "", 2, omega, metric),
            _select(own, setting=setting, omega=omega),
        )
        for setting in settings
        for omega in sorted(set(own["omega"]))
    ]
    return _grid("omega", f"{domain.name}: guidance weight omega, K = 2", learned, lines, ("setting", "omega"))


def _components(domain: Domain, rows: pd.DataFrame, metric: str) -> Table:
    """What each learned component generates alone, with learned weights."""
    own = _select(rows, K=2, omega="learned")
    learned, _ = _columns(own)
    suite = domain.suites.get("components")
    lines = [
        (
            task.name,
            task.setting,
            _lookup(domain, task.setting, task.name, 2, "learned", metric),
            _select(own, setting=task.setting, task=task.name),
        )
        for task in (suite.tasks if suite else ())
    ]
    caption = f"{domain.name}: accuracy of what each learned component generates alone, learned weights"
    return _grid("components", caption, learned, lines, ("concept", "generated from"))
