"""``paper.md``: each table, figure and claim of the paper in its order, beside ours, from ``paper.yaml`` and rows of ``results``.

    python docs/paper.py

A line without rows is an error, so that nothing stands there that was not measured.
"""

import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

import pandas as pd
import yaml

from docs.sources import SourceError, measured
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parent.parent
HEAD = """# The paper, item by item

Which results of *Few-Shot Task Learning through Inverse Generative Modeling* are reproduced. Ours: mean ± standard error over tasks
(standard deviation over seeds), by `make comparison` and `make ablation [DOMAIN=...]`. *Other setting*: the two
numbers are not of the same thing; texts are embedded by MiniLM, and networks, most losses, learning and sampling are
[ours](differences.md); items name what else differs. Films of all methods: <a href="watch.html">page to watch</a> (`make docs`).
"""
VERDICTS = {"same": "same setting", "other": "other setting", "absent": "not there"}


def shown(rows: pd.DataFrame, chosen: Mapping[str, Any], where: str) -> str:
    """The number behind rows that have these values in their columns.

    Raises:
        SystemExit: if there are none, or rows of several settings.
    """
    try:
        return str(measured(rows, chosen))
    except SourceError as error:
        raise SystemExit(f"{where}: {error}") from error


def section(item: Mapping[str, Any], files: Mapping[str, pd.DataFrame]) -> str:
    """An item's heading, what it says, its verdict, command, numbers and pictures."""
    told = [f"## {item['item']}", item["says"], f"**{VERDICTS[item['verdict']].capitalize()}**: {item['why']}."]
    if "command" in item:
        told.append("\n".join(f"    {command}" for command in item["command"].split("; ")))
    if "rows" in item:
        lines = ["| | paper | ours |", "|---|---|---|"]
        for name, papers, chosen in item["rows"]:
            values = {**item.get("all", {}), **chosen}
            rows = files[values.pop("file")]
            lines.append(f"| {name} | {papers or '-'} | {shown(rows, values, item['item'] + ', ' + name)} |")
        told.append("\n".join(lines))
    for table in item.get("include", ()):
        told.append(f"```{{include}} ../results/report/{table}\n```")
    if "look" in item:
        look = item["look"]
        told.append(look if look.startswith("!") or "\n" in look else f"See {look}.")
    return "\n\n".join(told)


def page() -> str:
    """The page."""
    items = yaml.safe_load((ROOT / "docs" / "paper.yaml").read_text(encoding="utf-8"))
    names = {row[2].get("file", item.get("all", {}).get("file")) for item in items for row in item.get("rows", ())}
    files = {name: read_rows(ROOT / "results" / name) for name in sorted(names)}
    counts = Counter(item["verdict"] for item in items)
    told = ", ".join(f"{counts[verdict]} {text}" for verdict, text in VERDICTS.items())
    return "\n".join([HEAD, f"{len(items)} items: {told}.", "", *(section(item, files) + "\n" for item in items)])


if __name__ == "__main__":
    write_text(ROOT / "docs" / "paper.md", page())
