"""Write the tables of the page on human motion, results/mocap.md, from the rows of its ablation.

    python benchmarks/making/mocap_table.py

Rules first, the trained judge beside them, level starts and strides apart; then compositions, and the paper's protocol.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ftl_lightning.services.tensor_file import write_text

JACKS, CIRCLE = "jumping jacks", "arm circle"
BOTH = tuple(f"{concept} + {other}" for concept in (JACKS, CIRCLE) for other in ("walk", "jump"))
NEW, PARTS, WHOLE = "new concept", "new + training, by parts of the body", "new + training"
LAST, LAST_BOTH = "new concept, last states", "new + training, last states"
MORE = "new concept, eight actions"
METHODS = (
    ("**with modes, with knots**", "FTL-IGM", "with modes, with knots", 1),
    ("**the same with an adapter**", "FTL-IGM", "with modes, with knots, with adapter", 1),
    ("form chosen", "FTL-IGM", "with knots, form chosen", 1),
    ("with knots, one set", "FTL-IGM", "with knots", 1),
    ("one set for the whole plan, K = 2", "FTL-IGM", "", 2),
    ("LoRA fine-tuning", "LoRA fine-tuning", "", 1),
    ("language", "language", "", 0),
    ("BC, our network", "BC, our network", "", 1),
    ("BC", "BC", "", 1),
    ("CVAE", "CVAE", "", 1),
    ("in-context", "in-context", "", 0),
    ("*demonstrations replayed*", "demonstrations replayed", "", 0),
    ("*frozen frame*", "frozen frame", "", 0),
)
"""What a row is called; method, form and K of its results."""


def cell(values: "pd.Series[float]", digits: int = 2) -> str:
    """Mean over seeds, and the spread over them in brackets; a dash where there are none."""
    if values.empty:
        return "-"
    spread = f" ({values.std(ddof=1):.{digits}f})" if len(values) > 1 and digits else ""
    return f"{values.mean():.{digits}f}{spread}"


def selected(rows: pd.DataFrame, method: str, form: str, components: int) -> pd.DataFrame:
    """Rows of a method in a form, that are not of the protocol."""
    fitting = (rows["method"] == method) & (rows["form"] == form) & (rows["K"] == components)
    return rows[fitting & ~rows["setting"].isin((LAST, LAST_BOTH))]


def values(rows: pd.DataFrame, setting: str, task: str, metric: str) -> "pd.Series[float]":
    """One value for each seed."""
    found = rows[(rows["setting"] == setting) & (rows["task"] == task) & (rows["metric"] == metric)]
    return found.groupby("seed")["value"].mean()


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines))


def new_concepts(rows: pd.DataFrame, task: str, columns: Sequence[tuple[str, tuple[str, ...], int]]) -> str:
    """A line for each method.

    Args:
        rows: of the results.
        task: the concept.
        columns: name, metrics and digits of each.
    """
    lines = []
    for name, method, form, components in METHODS:
        own = selected(rows, method, form, components)
        told = [[cell(values(own, NEW, task, metric), digits) for metric in metrics] for _, metrics, digits in columns]
        if {one for cells in told for one in cells} != {"-"}:
            lines.append([name, *map(", ".join, told)])
    return table([f"{task} from new initial poses", *(name for name, *_ in columns)], lines)


def compositions(rows: pd.DataFrame) -> str:
    """What the judge says of arms and trunk, and of the legs."""
    columns = [[*(f"{task}, by parts" for task in BOTH), *(f"{task}, whole body" for task in BOTH)]]
    head = ["compositions, judge"]
    for name, method, form, components in METHODS:
        own = selected(rows, method, form, components)
        column = [cell(values(own, setting, task, "accuracy")) for setting in (PARTS, WHOLE) for task in BOTH]
        if set(column) != {"-"}:
            head.append(name)
            columns.append(column)
    return table(head, list(zip(*columns, strict=True)))


def more(rows: pd.DataFrame) -> str:
    """Rule and judge of each of the eight actions, for every method."""
    rows = rows[rows["setting"] == MORE]
    columns = {name: selected(rows, method, form, components) for name, method, form, components in METHODS}
    columns = {name: some for name, some in columns.items() if not some.empty}
    lines = [[task, *(_rule_and_judge(some, task) for some in columns.values())] for task in dict.fromkeys(rows["task"])]
    means = [f"{some.loc[some['metric'] == 'rule', 'value'].mean():.2f}" for some in columns.values()]
    return table(["from three demonstrations: rule, judge", *columns], [*lines, ["mean of the rules", *means]])


def _rule_and_judge(rows: pd.DataFrame, task: str) -> str:
    judged = cell(values(rows, MORE, task, "accuracy"))
    return f"{cell(values(rows, MORE, task, 'rule'))}, {'-' if 'nan' in judged else judged}"


def protocol(rows: pd.DataFrame) -> str:
    """The paper's form of the concept from the demonstrations' last states."""
    own = rows[(rows["method"] == "FTL-IGM") & rows["setting"].isin((LAST, LAST_BOTH))]
    columns = [[f"{task}, {said}" for task in (JACKS, CIRCLE) for said in ("rule", "judge")] + [f"{task}, judge" for task in BOTH]]
    head = ["the paper's form of the concept, from last states"]
    for (components, shown), part in own.groupby(["K", "demonstrations"]):
        alone = [cell(values(part, LAST, task, metric)) for task in (JACKS, CIRCLE) for metric in ("rule", "accuracy")]
        both = [cell(values(part, LAST_BOTH, task, "accuracy")) for task in BOTH]
        head.append(f"K = {components}, {shown} demonstrations")
        columns.append([*alone, *both])
    return table(head, list(zip(*columns, strict=True)))


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results/mocap.csv"))
    parser.add_argument("--out", type=Path, default=Path("results/mocap.md"))
    chosen = parser.parse_args(arguments)
    rows = pd.read_csv(chosen.results, keep_default_na=False, na_values={"value": [""]})
    rows["K"] = rows["K"].replace("", 0).astype(int)
    jacks = (
        ("rule", ("rule",), 2),
        ("level starts", ("level",), 2),
        ("strides", ("strides",), 2),
        ("feet in time", ("feet in time",), 2),
        ("hands, feet, m", ("amplitude of hands", "amplitude of feet"), 2),
        ("judge", ("accuracy",), 2),
        ("jerk", ("jerk",), 0),
    )
    circle = (
        ("rule", ("rule",), 2),
        ("level starts", ("level",), 2),
        ("strides", ("strides",), 2),
        ("full turn", ("full turn",), 2),
        ("degrees turned", ("degrees turned",), 0),
        ("judge", ("accuracy",), 2),
        ("jerk", ("jerk",), 0),
    )
    tables = [new_concepts(rows, JACKS, jacks), new_concepts(rows, CIRCLE, circle), more(rows), compositions(rows), protocol(rows)]
    write_text(chosen.out, "\n\n".join(tables) + "\n")


if __name__ == "__main__":
    main()
