"""Print, describe and escape texts.

Names come from files, which others may have written. All printed text goes through :func:`say`, all text in a line of a table, a
figure or a message through :func:`line`.
"""

import html
import io
import json
import os
import re
import stat
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any
from unicodedata import category, normalize

from ftl_lightning.services.errors import LONGEST, short, shown


def plain(text: str) -> str:
    """Replace unprintable characters by question marks, but for line breaks and tabs, and wide spaces by plain ones."""
    return "".join(char if char.isprintable() or char in "\n\t" else " " if category(char) == "Zs" else "?" for char in text)


def line(text: str) -> str:
    """:func:`plain` in a single line, with single spaces."""
    return plain(" ".join(text.split()))


def folded(text: str) -> str:
    """A text without differences by case, spaces or Unicode normal form, for comparison."""
    return " ".join(normalize("NFKC", text).casefold().split())


def alike(texts: Iterable[str]) -> Iterator[str]:
    """A line for each two different ``texts`` that are equal once :func:`folded`."""
    first: dict[str, str] = {}
    for text in dict.fromkeys(texts):
        before = first.setdefault(folded(text), text)
        if before != text:
            letters = normalize("NFC", before) != normalize("NFC", text)
            show: Callable[[str], str] = shown if letters else lambda name: short(ascii(name))
            pair = f"{show(before)} and {show(text)}"
            yield f"{pair} are different concepts, but their names differ only by case, spaces or Unicode form; is one a slip?"


_silent = False


def silence() -> None:
    """Print nothing from now on: of several processes of a run only the first prints."""
    global _silent
    _silent = True


def say(*parts: object, error: bool = False) -> None:
    """Print values by :func:`plain` at once, separated by spaces, to standard output or standard error.

    Errors and notes are shortened to a line of twice :data:`~ftl_lightning.services.errors.LONGEST`.
    """
    if not _silent:
        text = " ".join(map(str, parts))
        text = short(text, 2 * LONGEST) if error and len(text) > 2 * LONGEST else text
        print(plain(text), file=sys.stderr if error else sys.stdout, flush=True)


class _Pipe(io.FileIO):
    """A pipe whose reader may end before the program, as ``head`` does; text without a reader is dropped."""

    def write(self, content: Any) -> int:
        try:
            return super().write(content)
        except BrokenPipeError:
            return memoryview(content).nbytes


def any_terminal() -> None:
    """Let standard output replace characters that its encoding lacks, such as ± in ASCII, by question marks, and let a pipe end."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is getattr(sys, f"__{name}__") and stream is not None and stat.S_ISFIFO(os.fstat(stream.fileno()).st_mode):
            pipe = io.BufferedWriter(_Pipe(stream.fileno(), "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(pipe, stream.encoding, stream.errors, line_buffering=True))
    if isinstance(sys.stdout, io.TextIOWrapper):  # not a notebook's
        sys.stdout.reconfigure(errors="replace")


MOST_NUMBERS = 6
"""Maximum number of values shown of a list."""


class Shown(ABC):
    """Object with a short representation."""

    @abstractmethod
    def _words(self) -> Iterable[str]:
        """Descriptive words, most important first."""

    def __repr__(self) -> str:
        return short(f"{type(self).__name__}({', '.join(map(short, self._words()))})", LONGEST)

    def _repr_html_(self) -> str:
        """HTML for notebooks; names come from files, so they are escaped."""
        items = "".join(f"<li>{html.escape(short(word))}</li>" for word in self._words())
        return f"<b>{html.escape(type(self).__name__)}</b><ul>{items}</ul>"


def numbers(values: Sequence[float]) -> str:
    """Short text of numbers."""
    text = ", ".join(f"{value:.2f}" for value in values[:MOST_NUMBERS])
    return text if len(values) <= MOST_NUMBERS else f"{text}, ..."


def counted(count: int, what: str) -> str:
    """Count with a noun, such as ``'1 mode'`` and ``'5 modes'``."""
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


_LATEX = str.maketrans(
    {letter: f"\\{letter}" for letter in "{}$&%#_"}
    | {letter: f"${letter}$" for letter in "<>"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "`": r"\textasciigrave{}"}
    | {"|": r"\textbar{}", "±": r"$\pm$"}
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
_BEGINNING = re.compile(r"^(\d*)([#+=.)-])")
_ENTITIES = {"<": "&lt;", ">": "&gt;", "&": "&amp;"}
_SCRIPT = str.maketrans({letter: f"\\u{ord(letter):04x}" for letter in "<>&\u2028\u2029"})
MOST_DRAWN = 120
"""Maximum characters of a name in a figure."""


def latex(text: str) -> str:
    """Escape a text for LaTeX on a single line, without commands and formulas; for a row of a table see :func:`latex_row`."""
    return line(text).translate(_LATEX)


def latex_row(cells: list[str]) -> str:
    r"""Cells of a LaTeX table row. Without the empty group, ``\\`` of the previous row would take a bracket as its argument."""
    row = " & ".join(map(latex, cells))
    return ("{}" if row.startswith(("[", "*")) else "") + row + r" \\"


def markdown(text: str) -> str:
    """Escape a text for a cell or caption in GitHub's Markdown: no line break, HTML, link, picture, formula, code or new cell."""
    return _MARKDOWN.sub(lambda match: _ENTITIES.get(match[0], f"\\{match[0]}"), line(text))


def markdown_item(text: str) -> str:
    """:func:`markdown` for an item of a list, which begins no heading, line or list."""
    return _BEGINNING.sub(r"\1\\\2", markdown(text))


def script_json(content: Any) -> str:
    """JSON for a ``script`` element of HTML, which can neither end the element nor begin a comment."""
    return json.dumps(content, ensure_ascii=False, separators=(",", ":")).translate(_SCRIPT)


def filled(page: str, parts: Mapping[str, str]) -> str:
    """Replace ``%NAME%`` in a page by the part of this name, in a single pass, so that a title '%DATA%' is kept."""
    return re.sub(f"%({'|'.join(parts)})%", lambda match: parts[match[1]], page)


def figure_text(text: str) -> str:
    """Escape a text for a figure. Dollars are formulas to Matplotlib; legends omit names that begin with ``_``."""
    label = short(line(text), MOST_DRAWN).replace("$", r"\$")
    return f" {label}" if label.startswith("_") else label
