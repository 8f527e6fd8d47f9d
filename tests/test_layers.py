"""Which part of the package may import which: never one of a layer above its own, not even where it is used."""

import ast
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGE = ROOT / "ftl_lightning"
LAYERS = (
    ("concepts", "demonstrations"),
    ("diffusion",),
    ("domains",),
    ("learning", "methods"),
    ("evaluation",),
    ("reporting", "study"),
    ("few_shot", "trainer", "training_bar"),
    ("play",),
    ("lightning_cli",),
    ("ablation",),
    ("benchmark",),
    ("commands",),
    ("cli",),
)
"""From the lowest; what is named in no layer, such as ``errors``, serves all of them."""
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
    return {name.split(".")[1] for name in names if name.startswith("ftl_lightning.")}


FILES = [path for path in sorted(PACKAGE.rglob("*.py")) if part_of(path) in LEVEL]


def test_imports_are_found_wherever_they_stand() -> None:
    text = "import ftl_lightning.study.page\nfrom ftl_lightning import few_shot\n"
    text += "def call():\n    from ftl_lightning.domains.data import OwnData\n"
    assert imported(text) == {"study", "few_shot", "domains"}


@pytest.mark.parametrize("part", sorted({part_of(path) for path in FILES}))
def test_nothing_imports_a_layer_above_its_own(part: str) -> None:
    found = {
        f"{path.relative_to(ROOT)}: {other}"
        for path in FILES
        if part_of(path) == part
        for other in imported(path.read_text("utf-8"))
        if LEVEL.get(other, 0) > LEVEL[part]
    }
    assert found == set()


def test_what_serves_all_layers_imports_none_that_learns_or_evaluates() -> None:
    serving = (
        "errors",
        "escape",
        "extras",
        "inputs",
        "limits",
        "printing",
        "progress",
        "ranges",
        "schema",
        "targets",
        "tensor_file",
    )
    for name in serving:
        assert not imported((PACKAGE / f"{name}.py").read_text("utf-8")) & LEVEL.keys(), name
