"""Which folder of the package may import which: never one on the same or a higher layer, not even inside a function."""

import ast
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGE = ROOT / "ftl_lightning"
LAYERS = (
    ("services", "version"),
    ("data",),
    ("igm", "networks", "domains"),
    ("training",),
    ("methods", "evaluation"),
    ("few_shot", "reporting"),
    ("apps",),
    ("cli", "__init__"),
    ("__main__",),
)
"""From the lowest. Folders on one layer do not import each other."""
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}


def part_of(path: Path) -> str:
    """The folder or module of the package to which a file belongs."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(text: str) -> set[str]:
    """Folders and modules of the package that a file's text imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("ftl_lightning.")} & LEVEL.keys()


FILES = sorted(PACKAGE.rglob("*.py"))


def test_imports_are_found_wherever_they_stand() -> None:
    text = "import ftl_lightning.apps.study.page\nfrom ftl_lightning import few_shot\n"
    text += "def call():\n    from ftl_lightning.domains.domain import Domain\n"
    assert imported(text) == {"apps", "few_shot", "domains"}


def test_every_module_has_a_layer() -> None:
    assert {part_of(path) for path in FILES} == LEVEL.keys()


@pytest.mark.parametrize("part", sorted(LEVEL))
def test_nothing_imports_its_own_layer_or_a_higher_one(part: str) -> None:
    allowed = {other for other in LEVEL if LEVEL[other] < LEVEL[part] or other == part}
    violations = {
        f"{path.relative_to(ROOT)}: {other}"
        for path in FILES
        if part_of(path) == part
        for other in imported(path.read_text("utf-8")) - allowed
    }
    assert violations == set()
