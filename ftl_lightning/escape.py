"""Texts of strangers in what is written: every form has letters of its own that mean something, and here they mean themselves."""

import json
import re
from typing import Any

from ftl_lightning.errors import short
from ftl_lightning.printing import line

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "$": r"\$",
        "&": r"\&",
        "%": r"\%",
        "#": r"\#",
        "_": r"\_",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "`": r"\textasciigrave{}",
        "|": r"\textbar{}",
        "±": r"$\pm$",
        "<": "$<$",
        ">": "$>$",
    }
)
_MARKDOWN = re.compile(
    r"""[\\`*|~${}>&]
    | <(?=\S)  # a tag, a comment or a link; 'p < .001' is none
    | (?<=\])[(\[:] | \[(?=[\[^]) | !(?=\[)  # links, pictures and footnotes; '0.82 [0.67]' is none
    | (?<![^\W_])_ | _(?![^\W_])  # emphasis; 'a_name' has none
    | :(?=//) | (?<=www)\.  # addresses that become links by themselves
    """,
    re.VERBOSE | re.IGNORECASE,
)
_ENTITIES = {"<": "&lt;", ">": "&gt;", "&": "&amp;"}
_SCRIPT = str.maketrans({one: f"\\u{ord(one):04x}" for one in "<>&\u2028\u2029"})
MOST_DRAWN = 120
"""Letters of a name in a figure."""


def latex(text: str) -> str:
    """One line of text for LaTeX, in which no command and no formula begins.

    A row of a table that begins with a bracket or an asterisk needs an empty group before it, see :func:`latex_row`.
    """
    return line(text).translate(_LATEX)


def latex_row(cells: list[str]) -> str:
    r"""Cells of a LaTeX table. Without the empty group ``\\`` of the row before would take a bracket for its own argument."""
    row = " & ".join(map(latex, cells))
    return ("{}" if row.startswith(("[", "*")) else "") + row + r" \\"


def markdown(text: str) -> str:
    """One line of text for a cell or a caption of GitHub's Markdown: no HTML, link, picture, formula, code or other cell begins."""
    return _MARKDOWN.sub(lambda found: _ENTITIES.get(found[0], f"\\{found[0]}"), line(text))


def script_json(content: Any) -> str:
    """JSON within a ``script`` element of HTML: no word in it can end the element or begin a comment."""
    return json.dumps(content, ensure_ascii=False, separators=(",", ":")).translate(_SCRIPT)


def figure_text(text: str) -> str:
    """One line of text for a figure: matplotlib takes what stands between two dollars for a formula, and names with ``_`` first
    for ones that a legend leaves out.
    """
    told = short(line(text), MOST_DRAWN).replace("$", r"\$")
    return f" {told}" if told.startswith("_") else told
