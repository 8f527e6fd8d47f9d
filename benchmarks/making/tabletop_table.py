"""Write the tables of the page on the table-top, results/tabletop.md and tabletop_wide.md, from its ablations and benchmarks.

    python benchmarks/making/tabletop_table.py

The new task and the training tasks, how episodes of pushing end and with which half done by the expert, and where the model's eyes
see things; of the wide model, what it learns, what its pushes aim at, and the training tasks.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from ftl_lightning.domains.tabletop.interface import BESIDE_BOWL, PUSH, PUSH_ON_BOOK, PUSH_TO_BOOK, TRAINING_CONCEPTS, WIDE_CONCEPTS
from ftl_lightning.services.tensor_file import write_text

NEW, OLD, FROM_PUSH = "new concept", "training concept", "training representation"
SUCCESS, MOVED = "closed loop success", "closed loop book moved"
METHODS = (
    ("**FTL-IGM with an adapter**", "FTL-IGM", "with adapter", 1, 10),
    ("with an adapter, from five demonstrations", "FTL-IGM", "with adapter", 1, 5),
    ("with an adapter, from three", "FTL-IGM", "with adapter", 1, 3),
    ("with an adapter, from one", "FTL-IGM", "with adapter", 1, 1),
    ("the form chosen by itself", "FTL-IGM", "form chosen", 2, 10),
    ("the paper's form of the concept: two components, learned weights", "FTL-IGM", "", 2, 10),
    ("the same, but one component", "FTL-IGM", "", 1, 10),
    ("LoRA fine-tuning", "LoRA fine-tuning", "", 1, 10),
    ("BC", "BC", "", 1, 10),
    ("CVAE", "CVAE", "", 1, 10),
    ("in-context", "in-context", "", 0, 10),
    ("language", "language", "", 0, 10),
)
"""What a row is called; method, form, K and demonstrations of its results."""
REFERENCES = ("expert (oracle)", "straight push", "table-height push")
PUBLISHED = {PUSH_ON_BOOK: ".55", PUSH: ".90", FROM_PUSH: ".15"}
"""The paper's, on a real robot."""
ENDS = {
    "success": "success",
    "rim": "edge of reach",
    "beside": "hand beside circle",
    "fell": "fell",
    "wrong object": "wrong object",
    "timeout": "timeout",
}
KINDS = {"read": "read by the encoder", "linear": "linear probe", "network": "network probe"}


def number(value: float) -> str:
    """Two digits, without the zero before the point."""
    return f"{value:.2f}".replace("0.", ".", 1)


def cell(values: "pd.Series[float]") -> str:
    """Mean over seeds ± their spread; a dash where there are none."""
    if values.empty:
        return "-"
    return number(values.mean()) + (f" ± {number(values.std(ddof=1))}" if len(values) > 1 else "")


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines))


def cells(rows: pd.DataFrame) -> list[str]:
    """Success, and how often the book moved."""
    return [cell(rows[rows["metric"] == metric].groupby("seed")["value"].mean()) for metric in (SUCCESS, MOVED)]


def new_task(rows: pd.DataFrame) -> str:
    """A line for each method and reference."""
    new, lines = rows[(rows["setting"] == NEW) & (rows["task"] == PUSH_ON_BOOK)], []
    for name, method, form, components, demonstrations in METHODS:
        fitting = (new["method"] == method) & (new["form"] == form) & (new["K"] == components)
        own = new[fitting & (new["demonstrations"] == demonstrations)]
        if not own.empty:
            lines.append([name, *cells(own), PUBLISHED[PUSH_ON_BOOK] if name.startswith("the paper's form") else "-"])
    pushed = rows[(rows["setting"] == FROM_PUSH) & (rows["method"] == "FTL-IGM")]
    lines.append(["the training concept of pushing on the table (the paper's baseline)", *cells(pushed), PUBLISHED[FROM_PUSH]])
    lines += [[f"*{name}*", *cells(new[new["method"] == name]), "-"] for name in REFERENCES]
    return table(["the new task: push on the book", "success", "book moved", "paper, real robot"], lines)


def training_tasks(rows: pd.DataFrame) -> str:
    """A line for each task."""
    lines = []
    for task in TRAINING_CONCEPTS:
        own = rows[(rows["setting"] == OLD) & (rows["task"] == task)]
        expert = cells(own[own["method"] == REFERENCES[0]])[0]
        lines.append([task, *cells(own[own["method"] == "FTL-IGM"]), expert, PUBLISHED.get(task, "-")])
    return table(["training task", "success", "book moved", "*expert*", "paper, real robot"], lines)


def failures(found: dict[str, Any]) -> str:
    """How episodes end, a line for each task and way."""
    lines = []
    for task, ways in found["tasks"].items():
        for way, one in ways.items():
            total, rates = sum(one["ends"].values()), pd.Series(one["success"], dtype=float)
            lines.append([task, way, cell(rates), *(number(one["ends"].get(end, 0) / total) for end in list(ENDS)[1:])])
    return table(["task", "who acts", *ENDS.values()], lines)


def eyes(found: dict[str, Any]) -> str:
    """Errors in cm, a line for each object and surface."""
    kinds = [kind for kind in KINDS if f"{kind} rms" in next(iter(found["cm"].values()))]
    lines = []
    for name, one in found["cm"].items():
        lines.append([name, *(number(one[f"{kind} rms"]) if f"{kind} rms" in one else "-" for kind in kinds)])
    return table(["localisation error, cm (root mean square)", *(KINDS[kind] for kind in kinds)], lines)


def wide_tasks(rows: pd.DataFrame) -> str:
    """Tasks that the wide model learns, a line for each."""
    lines = []
    for task in (PUSH_TO_BOOK, PUSH_ON_BOOK, BESIDE_BOWL):
        new = rows[(rows["setting"] == NEW) & (rows["task"] == task)]
        forms = (("FTL-IGM", "with adapter"), ("LoRA fine-tuning", ""), ("FTL-IGM", ""), (REFERENCES[0], ""))
        lines.append([task, *(cells(new[(new["method"] == method) & (new["form"] == form)])[0] for method, form in forms)])
    head = [
        "wide model, from ten demonstrations",
        "with an adapter",
        "LoRA fine-tuning",
        "the paper's form of the concept",
        "*expert*",
    ]
    return table(head, lines)


def eight_tasks(rows: pd.DataFrame) -> str:
    """Eight tasks that pretraining does not show, a line for each, and their mean."""
    new, lines = rows[rows["setting"] == "new concept, eight tasks"], []
    methods = ("FTL-IGM", "with adapter"), ("LoRA fine-tuning", ""), ("FTL-IGM", ""), (REFERENCES[0], "")
    measured = [new[(new["method"] == method) & (new["form"] == form)] for method, form in methods]
    for task in new["task"].unique():
        lines.append([task, *(cells(own[own["task"] == task])[0] for own in measured)])
    lines.append(["mean", *(cells(own)[0] for own in measured)])
    return table(["eight tasks, one seed", "with an adapter", "LoRA fine-tuning", "the paper's form", "*expert*"], lines)


def wide_training(rows: pd.DataFrame) -> str:
    """What the wide model was pretrained on, a line for each task."""
    lines = []
    for task in WIDE_CONCEPTS:
        own = rows[(rows["setting"] == OLD) & (rows["task"] == task)]
        lines.append([task, cells(own[own["method"] == "FTL-IGM"])[0], cells(own[own["method"] == REFERENCES[0]])[0]])
    return table(["wide model, training task", "success", "*expert*"], lines)


def targets(found: dict[str, Any]) -> str:
    """Where pushes go when two things exchange their places, a line for what is pushed to."""
    pairs = found["pushed to, beside"]
    lines = []
    for target, others in pairs.items():
        shown = [others.get(other) for other in pairs]
        lines.append([target, *("-" if one is None else f"{number(one['right'])} / {number(one['followed'])}" for one in shown)])
    return table(["pushed to, beside another thing: right / followed", *pairs], lines)


def rows_of(path: Path) -> pd.DataFrame:
    """Rows of a results file; K and demonstrations are 0 where there are none."""
    rows = pd.read_csv(path, keep_default_na=False, na_values={"value": [""]})
    for column in ("K", "demonstrations"):
        rows[column] = rows[column].replace("", 0).astype(int)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results"), help="folder")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder")
    chosen = parser.parse_args(arguments)
    rows = rows_of(chosen.results / "tabletop.csv")
    found = {
        name: json.loads((chosen.results / f"tabletop_{name}.json").read_text(encoding="utf-8"))
        for name in ("failures", "localisation", "localisation_wide", "targets")
    }
    parts = [new_task(rows), training_tasks(rows), failures(found["failures"]), eyes(found["localisation"])]
    write_text(chosen.out / "tabletop.md", "\n\n".join(parts) + "\n")
    rows = rows_of(chosen.results / "tabletop_wide.csv")
    parts = [wide_tasks(rows), eight_tasks(rows), targets(found["targets"]), wide_training(rows), eyes(found["localisation_wide"])]
    write_text(chosen.out / "tabletop_wide.md", "\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
