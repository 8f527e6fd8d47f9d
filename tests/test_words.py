"""The English of the documentation, of help texts, docstrings and errors: words and turns that are out."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT

OUT = (
    "told", "tells", "untold", "unsaid", "odd", "oddness", "stretches", "puts out", "says nothing", "say nothing", "how many-th",
    "what nobody", "own terms", "looked at", "anew", "likewise", "reference line", "reference lines", "such a one", "the one that",
    "the ones", "this one", "that one", "each one", "every one", "another one", "these alone", "comes to", "says of", "said of",
    "wherein", "thereby", "hence", "lest", "hitherto", "nothing like it", "what came", "kept apart", "taken away", "does without",
    "makes of", "of its own", "of one's own", "of their own", "as it is", "as they are", "all that", "the others'",
    "the empty concept's", "in the span(?! of the training)", "leads astray", "by hand or",
)  # fmt: skip
"""Patterns of whole words: no terms of the field, or a second reading is needed."""
PATTERN = re.compile(rf"(?<![\w'-])(?:{'|'.join(OUT)})(?![\w-])", re.IGNORECASE)
UNREAD = re.compile(
    r"^( *)(`{3,})[^\n]*\n.*?^ *\2`*$|(?<=\n\n)(?: {4}[^\n]*\n)+|`+[^`]+`+|\]\([^)\s]*\)|<[^>]*>", re.DOTALL | re.MULTILINE
)
"""Code, literals, targets of links, and tags."""
PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts)]
MODULES = sorted((ROOT / "ftl_lightning").rglob("*.py"))


def texts(module: Path) -> Iterator[str]:
    """Docstrings and other text of several words in a module."""
    for node in ast.walk(ast.parse(module.read_text("utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.value


def words_out(text: str) -> list[str]:
    """Words and turns of :data:`OUT` in a text, with their surroundings."""
    plain = " ".join(UNREAD.sub(" ", text).split())
    return [plain[max(0, match.start() - 30) : match.end() + 30] for match in PATTERN.finditer(plain)]


def test_the_list_is_read_and_code_is_not() -> None:
    assert len(OUT) >= 40
    assert words_out("what is told by `told` and\n\n    told\n") == ["what is told by and"]
    assert words_out("in the span of the training embeddings; a model of one's own") == [
        " training embeddings; a model of one's own"
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_have_none_of_them(page: Path) -> None:
    assert words_out(page.read_text("utf-8")) == []


def test_docstrings_help_texts_and_errors_have_none_of_them() -> None:
    found = {str(module.relative_to(ROOT)): [out for text in texts(module) for out in words_out(text)] for module in MODULES}
    assert {name: out for name, out in found.items() if out} == {}
