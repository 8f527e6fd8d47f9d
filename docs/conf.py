"""How the documentation's pages are built: ``make docs``. Nothing is fetched from a network."""

import importlib.util
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from sphinx.application import Sphinx

from ftl_lightning import __version__

project = "ftl-lightning"
author = "The ftl-lightning authors"
copyright = "The ftl-lightning authors, MIT licence"
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "sphinx_copybutton"]
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
autodoc_use_type_comments = False  # there are none
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

toc_object_entries = False  # two thousand entries, which every page would build anew

html_theme = "furo"
html_title = f"ftl-lightning {__version__}"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]


# Links are written for readers of the repository. Pages below are links to files outside this folder, which Sphinx would not find.
OUTSIDE = ((r"(?:\.\./)+notebooks/([\w/]+)\.ipynb", "/notebooks"), (r"(?:\.\./)+pretrained/(\w+)/README\.md", "/cards"))
BACK, BESIDE = re.compile(r"\]\((?:\.\./)+docs/([^)]*\.md(?:#[^)]*)?)\)"), re.compile(r"\[([^][\n]*)\]\(([\w/]+)\.ipynb\)")
"""Notebooks' links to pages of this folder, and to one another."""
DOWNLOADS = re.compile(r"\]\(((?:\.\./)+(?:(?:results|ftl_lightning|examples|conf)/[^)]*|CHANGELOG|CONTRIBUTING)\.(?:md|ipynb))\)")


def _links(app: Sphinx, page: str, source: list[str]) -> None:
    """Turn links out of this folder into links to pages, or into downloads."""
    for pattern, folder in OUTSIDE:
        source[0] = re.sub(rf"\[([^]]*)\]\({pattern}\)", rf"{{doc}}`\1 <{folder}/\2>`", source[0])
    if page.startswith("notebooks/"):
        source[0] = BESIDE.sub(rf"{{doc}}`\1 </{page.rpartition('/')[0]}/\2>`", BACK.sub(r"](/\1)", source[0]))
    source[0] = DOWNLOADS.sub(r"](path:\1)", source[0])


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _links)
