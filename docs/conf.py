"""How the documentation's pages are built: ``make docs``. Nothing is fetched from a network."""

import importlib.util
import io
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

import numpy as np
from sphinx.application import Sphinx

from ftl_lightning import __version__
from ftl_lightning.play.offline import write_offline
from ftl_lightning.play.requests import Learn
from ftl_lightning.play.workspace import Workspace
from ftl_lightning.reporting.html.page import write_page
from ftl_lightning.testing.strokes import strokes

project = "ftl-lightning"
author = "The ftl-lightning authors"
copyright = "The ftl-lightning authors, MIT licence"
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
nitpicky = False
suppress_warnings = ["ref.python"]  # two classes may have attributes of the same name

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the notebooks hold their output

autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_mock_imports = [name for name in ("minari", "pyarrow") if importlib.util.find_spec(name) is None]  # extras
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # Lightning's and torch's own documentation is theirs
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"ftl-lightning {__version__}"
html_show_sourcelink = False


# Links are written for readers of the repository. Pages below are links to files outside this folder, which Sphinx would not find.
OUTSIDE = ((r"(?:\.\./)+notebooks/([\w/]+)\.ipynb", "/notebooks"), (r"(?:\.\./)+pretrained/(\w+)/README\.md", "/cards"))
BACK, BESIDE = re.compile(r"\]\((?:\.\./)+docs/([^)]*\.md(?:#[^)]*)?)\)"), re.compile(r"\[([^][\n]*)\]\(([\w/]+)\.ipynb\)")
"""Notebooks' links to pages of this folder, and to one another."""
DOWNLOADS = re.compile(r"\]\(((?:\.\./)+(?:(?:results|ftl_lightning|examples|conf)/[^)]*|CHANGELOG|CONTRIBUTING)\.md)\)")


def _links(app: Sphinx, page: str, source: list[str]) -> None:
    """Turn links out of this folder into links to pages, or into downloads."""
    for pattern, folder in OUTSIDE:
        source[0] = re.sub(rf"\[([^]]*)\]\({pattern}\)", rf"{{doc}}`\1 <{folder}/\2>`", source[0])
    if page.startswith("notebooks/"):
        source[0] = BESIDE.sub(rf"{{doc}}`\1 </{page.rpartition('/')[0]}/\2>`", BACK.sub(r"](/\1)", source[0]))
    source[0] = DOWNLOADS.sub(r"](path:\1)", source[0])


def _watch(app: Sphinx, error: Exception | None) -> None:
    """Put the page to watch, which ``report --html`` writes, beside the pages of a site."""
    if error is None and app.builder.name == "html":
        write_page(Path(__file__).parent.parent / "results", Path(app.outdir) / "watch.html")


PLAYABLE = {
    "strokes": (("heart", "circle"), ("heart", "zigzag"), ("heart", "figure eight"), ("circle", "zigzag")),
    "mocap": (("jumping_jacks", "walk"), ("arm circle", "walk"), ("jumping_jacks", "arm circle")),
}
"""Models whose page of ``play`` needs no program, and what is mixed on it."""


def _playable(app: Sphinx, error: Exception | None) -> None:
    """Put pages of ``play`` that need no program beside the pages of a site, unless they are there."""
    if error is not None or app.builder.name != "html":
        return
    for model, pairs in PLAYABLE.items():
        if (path := Path(app.outdir) / f"play_{model}.html").exists():
            continue
        workspace = Workspace(model)
        if model == "strokes":
            five = io.BytesIO()
            np.savez(five, states=strokes("heart", 5, 1), concepts="heart")
            workspace.upload("heart.npz", five.getvalue())
            workspace.learn(Learn("heart"), lambda told: None, lambda: False)
        write_offline(workspace, path, pairs)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("build-finished", _playable)
    app.connect("source-read", _links)
    app.connect("build-finished", _watch)
