"""``paper.md``: the items of the paper with pictures, from ``ftl_lightning/apps/paper.yaml`` and rows of ``results``.

    python docs/paper.py

A line without rows is an error, so that nothing stands there that was not measured.
"""

import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from ftl_lightning.apps.paper import VERDICTS, Item, heading, items, table
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parent.parent
HEAD = """# The paper, item by item

Which results of *Few-Shot Task Learning through Inverse Generative Modeling* are reproduced? *Ours*: mean ± standard error over
tasks, in brackets the standard deviation over seeds. No setting is exactly the paper's: texts are embedded by MiniLM, and networks,
most losses, learning and sampling are [ours](differences.md). No setting of its new concepts has enough tasks for a
[test](baselines.md#who-is-ahead) of differences. In a terminal: `python -m ftl_lightning report --paper "Table 4"`; `--run true`
measures a table's numbers again (not Figures 6 (right), 7 and 13).
"""


def section(item: Item) -> str:
    """An item with its table, included tables and pictures."""
    parts = [heading(item), *([f"    {item['command']}"] if "command" in item else [])]
    parts += [table(item, ROOT / "results")] if "rows" in item else []
    parts += [f"```{{include}} ../results/report/{name}\n```" for name in item.get("include", ())]
    return "\n\n".join([*parts, *([item["look"]] if "look" in item else [])]) + "\n"


def page() -> str:
    """The page."""
    every = items()
    counts = Counter(item["verdict"] for item in every)
    summary = ", ".join(f"{counts[verdict]} {text}" for verdict, text in VERDICTS.items())
    return "\n".join([HEAD, f"{len(every)} items: {summary}.", "", *map(section, every)])


if __name__ == "__main__":
    write_text(ROOT / "docs" / "paper.md", page())
