"""Tables, figures and claims of the paper beside the rows of a results folder: ``report --paper``, and the page on the paper."""

import re
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from ftl_lightning.apps.ablation.plan import Cell, Stage
from ftl_lightning.apps.ablation.record import read_record
from ftl_lightning.apps.ablation.run import planned, run_ablation
from ftl_lightning.evaluation.results import latest, read_rows
from ftl_lightning.reporting.table import Number, select, summarise
from ftl_lightning.services.errors import require
from ftl_lightning.services.files import read_text
from ftl_lightning.services.text import counted, say

Item = Mapping[str, Any]
ITEMS = Path(__file__).parent / "paper.yaml"
VERDICTS = {"reproduced": "reproduced", "partly": "partly reproduced", "not": "not reproduced", "none": "not compared"}
ONE_OF = ("setting", "metric", "method", "form", "variant", "K", "omega")
"""Columns in which rows behind a number must be alike."""
REPORTED = "report"
"""Subfolder of a results folder with the tables that items include."""


def items(name: str = "") -> list[Item]:
    """Items of the paper in its order whose names contain all words of ``name``, such as ``'Table 4'`` or ``'4'``.

    Raises:
        UserError: if no name does.
    """
    every: list[Item] = yaml.safe_load(ITEMS.read_text("utf-8"))
    named = [item for item in every if _words(name) <= _words(item["item"])]
    require(named, "paper", f"one of {'; '.join(item['item'] for item in every)}; or all", name)
    return named


def _words(text: str) -> set[str]:
    return {word.removesuffix("s") for word in re.findall(r"\w+(?:\.\w+)*", text.lower())}


def alike(rows: pd.DataFrame, chosen: Mapping[str, Any], where: str) -> pd.DataFrame:
    """The latest rows that have the values of ``chosen`` in their columns; ``where`` their number stands is for messages.

    Raises:
        UserError: if there are none, or rows of several settings.
    """
    selected = latest(select(rows, **chosen))
    require(not selected.empty, where, f"rows with {dict(chosen)}", "none")
    for column in ONE_OF:
        different = sorted(set(map(str, selected[column])))
        require(len(different) == 1, where, f"rows of one {column}", str(different))
    return selected


def measured(rows: pd.DataFrame, chosen: Mapping[str, Any], where: str) -> Number:
    """The number behind the rows of :func:`alike`."""
    number = summarise(alike(rows, chosen, where))
    assert number is not None  # there are rows
    return number


def lines_of(item: Item) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Lines of an item: name, the paper's value (may be empty), name of the results file, and values of columns of its rows."""
    for name, papers, chosen in item.get("rows", ()):
        values = {**item.get("all", {}), **chosen}
        yield name, papers, values.pop("file"), values


def table(item: Item, results: Path) -> str:
    """Table of an item's rows; for each column of ``across`` the paper's values, if it prints any, and those of the results."""
    cells: dict[str, dict[str, str]] = {}
    files = {file: read_rows(results / file) for _, _, file, _ in lines_of(item)}
    for name, papers, file, values in lines_of(item):
        label, _, column = name.rpartition("; ") if "across" in item else (name, "", "")
        ours = str(measured(files[file], values, f"{item['item']}, {name}")).replace("(seeds ", "(")
        cells.setdefault(label, {}).update({f"{column}, paper": papers or "-", f"{column}, ours": ours})
    columns = [f"{column}, {of}" for column in item.get("across", [""]) for of in ("paper", "ours")]
    columns = [column for column in columns if any(row.get(column, "-") != "-" for row in cells.values())]
    lines = [f"| {' | '.join([label, *(row.get(column, '-') for column in columns)])} |" for label, row in cells.items()]
    head = " | ".join(column.removeprefix(", ") for column in columns)
    return "\n".join([f"| | {head} |", f"|{'---|' * (len(columns) + 1)}", *lines])


def heading(item: Item) -> str:
    """An item's name, what the paper shows, and the verdict, as Markdown."""
    return f"## {item['item']}\n\n{item['says']}\n\n**{VERDICTS[item['verdict']].capitalize()}.** {item['why']}"


def printed(item: Item, results: Path) -> str:
    """An item for a terminal: :func:`heading` without targets of links, its table and the tables that it includes."""
    parts = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading(item)), *([table(item, results)] if "rows" in item else [])]
    parts += [read_text(results / REPORTED / name, "Markdown").strip() for name in item.get("include", ())]
    return "\n\n".join(parts)


def cells_of(chosen: Sequence[Item], results: Path, root: str = "") -> dict[str, list[Cell]]:
    """Cells behind the numbers of items, by name of the results file.

    They are the cells of ``conf/ablation/NAME.yaml`` with the hashes of the rows, after the pretrainings of their models. Rows of
    included tables are those with the columns of ``behind``.

    Args:
        chosen, results: items, and the folder of results whose records name the cells.
        root: folder of recordings, for domains that read one.
    """
    selections: dict[str, list[dict[str, Any]]] = {}
    for item in chosen:
        for values in [*({"file": file, **values} for _, _, file, values in lines_of(item)), *item.get("behind", ())]:
            columns = dict(values)
            selections.setdefault(columns.pop("file"), []).append(columns)
    cells_by_file = {}
    for file, selected in selections.items():
        rows = read_rows(results / file)
        hashes = {config_hash for columns in selected for config_hash in latest(select(rows, **columns))["config_hash"]}
        record, plan = read_record(results / file), Path("conf/ablation", file).with_suffix(".yaml")
        content = yaml.safe_load(plan.read_text("utf-8")) if plan.is_file() else {}
        stages = [Stage(**stage) for stage in content.get("stages", ())]
        cells = [cell for stage in planned(stages, content["seeds"], root).values() for cell in stage] if stages else []
        needed = [cell for cell in cells if cell.name in record and record[cell.name].config_hash in hashes]
        require(needed, f"paper: {file}", f"a plan {plan} with the cells of these rows", f"none; see {results / 'README.md'}")
        fits = {cell.pretraining.name: cell.pretraining for cell in needed if cell.pretraining}
        cells_by_file[file] = [*fits.values(), *needed]
    return cells_by_file


def measure_again(chosen: Sequence[Item], results: Path, out: Path, root: str = "") -> None:
    """Run the cells of :func:`cells_of` and write their rows to ``out``, where cells with rows are skipped.

    Raises:
        UserError: for items without cells, or for cells that fail.
    """
    cells = cells_of(chosen, results, root)
    require(cells, "paper", "an item with measured numbers", ", ".join(item["item"] for item in chosen))
    say("\n".join(f"{file}: {counted(len(some), 'cell')}" for file, some in cells.items()))
    start = time.monotonic()
    for file, some in cells.items():
        run_ablation([[cell] for cell in some], str(out / file))
    say(f"{out}: {(time.monotonic() - start) / 60:.0f} minutes")
    if any("include" in item for item in chosen):
        from ftl_lightning.reporting.report import write_report

        write_report(out, out / REPORTED)
