"""Escape untrusted texts for each output format."""

import json
import re
from typing import Any

from ftl_lightning.services.errors import short
from ftl_lightning.services.printing import line

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
_SCRIPT = str.maketrans({letter: f"\\u{ord(letter):04x}" for letter in "<>&\u2028\u2029"})
MOST_DRAWN = 120
"""Maximum characters of a name in a figure."""


def latex(text: str) -> str:
    """Escape a text for LaTeX in one line, without commands and formulas.

    A table row that begins with a bracket or an asterisk needs an empty group before it, see :func:`latex_row`.
    """
    return line(text).translate(_LATEX)


def latex_row(cells: list[str]) -> str:
    r"""Cells of a LaTeX table row. Without the empty group, ``\\`` of the previous row would take a bracket as its argument."""
    row = " & ".join(map(latex, cells))
    return ("{}" if row.startswith(("[", "*")) else "") + row + r" \\"


def markdown(text: str) -> str:
    """Escape a text for a cell or caption in GitHub's Markdown: one line, no HTML, link, picture, formula, code or new cell."""
    return _MARKDOWN.sub(lambda match: _ENTITIES.get(match[0], f"\\{match[0]}"), line(text))


def script_json(content: Any) -> str:
    """JSON for a ``script`` element of HTML, which can neither end the element nor begin a comment."""
    return json.dumps(content, ensure_ascii=False, separators=(",", ":")).translate(_SCRIPT)


def figure_text(text: str) -> str:
    """Escape a text for a figure in one line: matplotlib reads text between dollars as a formula, and a legend omits names that
    begin with ``_``.
    """
    label = short(line(text), MOST_DRAWN).replace("$", r"\$")
    return f" {label}" if label.startswith("_") else label
