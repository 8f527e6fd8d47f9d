"""Pages of a site that Sphinx does not make: the page to watch, and pages of ``play`` that need no program.

    python docs/pages.py docs/_build/html

``make docs`` runs it beside Sphinx. A page of ``play`` that is there already is kept.
"""

import io
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

import numpy as np

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.apps.play.page import WEIGHTS, write_offline
from ftl_lightning.apps.play.requests import Learn
from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.reporting.page import write_page

PLAYABLE = {
    "strokes": (("heart", "circle"), ("heart", "zigzag"), ("heart", "figure eight"), ("circle", "zigzag")),
    "mocap": (("jumping_jacks", "walk"), ("arm circle", "walk"), ("jumping_jacks", "arm circle")),
}
"""Models whose page of ``play`` needs no program, and what is mixed on it."""


def playable(model: str, path: Path) -> None:
    """Write a page of ``play``."""
    workspace, pairs = Workspace(model), PLAYABLE[model]
    if model == "strokes":
        five = io.BytesIO()
        np.savez(five, states=strokes("heart", 5, 1), concepts="heart")
        workspace.upload("heart.npz", five.getvalue())
        workspace.learn(Learn("heart"), lambda progress: None, lambda: False)
    count = len(pairs) * len(WEIGHTS) ** 2
    numbers = iter(range(1, count + 1))
    write_offline(workspace, path, pairs, lambda: print(f"{path.name}: {next(numbers)} of {count} mixes", flush=True))


def main(folder: Path) -> None:
    """Write all pages to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    print("watch.html: films of results", flush=True)
    write_page(Path(__file__).parent.parent / "results", folder / "watch.html")
    for model in PLAYABLE:
        if not (path := folder / f"play_{model}.html").exists():
            print(f"{path.name}: samples of mixes", flush=True)
            playable(model, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
