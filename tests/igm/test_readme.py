"""The README of the method names code that exists, and the method stays short and pure."""

import ast
import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

FOLDER = ROOT / "ftl_lightning" / "igm"
HEART = ("guidance.py", "diffusion.py", "samplers.py", "model.py", "inversion.py")
ROWS = [line for line in (FOLDER / "README.md").read_text("utf-8").splitlines() if line.startswith("| ") and ".py)" in line]


def defined(path: Path) -> set[str]:
    """Functions, classes and methods ``Class.method`` of a file."""
    names: set[str] = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{inner.name}" for inner in node.body if isinstance(inner, ast.FunctionDef)}
    return names


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_each_equation_names_code_that_exists(row: str) -> None:
    code = row.split("|")[-2]
    links = [FOLDER / link for link in re.findall(r"\]\(([^)]+)\)", code)]
    assert links
    assert all(link.is_file() for link in links)
    names = {name for name in re.findall(r"`([\w.]+)`", code) if not name.startswith("__")}
    known = set().union(*map(defined, links))
    assert {name for name in names if name not in known} == set()


def test_the_method_is_short_and_imports_neither_lightning_nor_a_higher_layer() -> None:
    texts = {name: (FOLDER / name).read_text("utf-8") for name in HEART}
    assert sum(len(text.splitlines()) for text in texts.values()) <= 1000
    for path in FOLDER.rglob("*.py"):
        assert "lightning.pytorch" not in path.read_text("utf-8"), path
