"""The notebooks: whatever they show is what they show when they are run again."""

import base64
import io
import re
import runpy
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbformat import NotebookNode
from PIL import Image

from tests.conftest import ROOT
from tests.test_docs import targets

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXECUTE = runpy.run_path(str(ROOT / "notebooks" / "execute.py"))
PATHS: list[Path] = EXECUTE["notebooks"]()
TUTORIALS = ROOT / "notebooks" / "tutorial"
AGAIN = "run notebooks/execute.py"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
LARGEST = 1_000_000
LARGEST_TUTORIAL = 500_000
CROP = 0.05
"""Share by which the size of a picture may differ: it is cut to what is drawn, and where a point lies may be computed."""

everywhere = pytest.mark.parametrize("path", PATHS, ids=lambda path: str(path.relative_to(ROOT / "notebooks").with_suffix("")))

Part = tuple[str, Any]
"""A kind of content and a text, or the width and height of a picture."""


def parts(cell: NotebookNode) -> Iterator[Part]:
    """What a cell shows, one after another."""
    for output in cell.outputs:
        if output.output_type == "stream":
            yield output.name, output.text
        for kind, content in sorted(output.get("data", {}).items()):
            yield kind, Image.open(io.BytesIO(base64.b64decode(content))).size if kind.startswith("image/") else content


def nearly(kept: str, found: str) -> bool:
    """Whether two texts differ in the last digit of numbers at most."""
    if NUMBER.sub("#", kept) != NUMBER.sub("#", found):
        return False
    for one, other in zip(NUMBER.findall(kept), NUMBER.findall(found), strict=True):
        digits = len(one.partition(".")[2])
        if digits != len(other.partition(".")[2]) or abs(float(one) - float(other)) > 1.5 * 10**-digits:
            return False
    return True


def same(kept: Part, found: Part, tag: str) -> bool:
    """Whether two parts agree as far as a cell with this tag can."""
    if kept[0] != found[0]:
        return False
    if kept[0].startswith("image/"):
        return all(abs(one - other) <= CROP * one for one, other in zip(kept[1], found[1], strict=True))
    if tag == "varies":
        return bool(kept[1].strip()) == bool(found[1].strip())
    return nearly(kept[1], found[1]) if tag == "rounding" else bool(kept[1] == found[1])


def differences(kept: NotebookNode, found: NotebookNode) -> list[str]:
    """Cells that show something else than they did, each with what."""
    told = []
    for number, (old, new) in enumerate(zip(kept.cells, found.cells, strict=True)):
        if old.cell_type != "code":
            continue
        tag = next(iter(old.metadata.get("tags", [])), "")
        olds, news = list(parts(old)), list(parts(new))
        kinds, others = [kind for kind, _ in olds], [kind for kind, _ in news]
        if kinds != others:
            told.append(f"cell {number}: {kinds} became {others}")
            continue
        pairs = zip(olds, news, strict=True)
        told += [f"cell {number}: {one[1]} became {other[1]}" for one, other in pairs if not same(one, other, tag)]
    return told


@pytest.mark.notebook
@everywhere
def test_a_notebook_shows_what_it_shows_when_it_is_run_again(path: Path, tmp_path: Path) -> None:
    assert differences(nbformat.read(path, as_version=4), EXECUTE["executed"](path, tmp_path)) == [], AGAIN


@everywhere
def test_a_notebook_is_small_and_as_the_command_writes_it(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    assert path.stat().st_size <= (LARGEST_TUTORIAL if path.parent == TUTORIALS else LARGEST)
    every = [cell for cell in notebook.cells if cell.cell_type == "code"]
    code = [cell for cell in every if "skip-execution" not in cell.metadata.get("tags", [])]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), AGAIN
    assert {tag for cell in notebook.cells for tag in cell.metadata.get("tags", [])} <= set(EXECUTE["TAGS"])
    assert set(notebook.metadata) == {"kernelspec", "language_info"}, AGAIN
    assert "stderr" not in {kind for cell in code for kind, _ in parts(cell)}, AGAIN
    varying = [cell.source for cell in code if "varies" in cell.metadata.get("tags", [])]
    assert all("assert " in source or source.startswith("%%sh") for source in varying)  # a command asserts success
    if path.parent != TUTORIALS:  # no logic
        assert not any(word in cell.source for cell in every for word in ("def ", "class ", ".mean(", ".std("))


@everywhere
def test_every_link_of_a_notebook_points_to_something(path: Path) -> None:
    texts = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown"]
    links = [link for text in texts for link in targets(text)]
    assert [link for link in links if not (path.parent / link.partition("#")[0]).exists()] == []


def test_tutorials_link_to_the_next_and_end_with_exercises() -> None:
    tutorials = sorted(TUTORIALS.glob("*.ipynb"))
    assert len(tutorials) == 6
    for path, following in zip(tutorials, (*tutorials[1:], tutorials[0]), strict=True):
        last = nbformat.read(path, as_version=4).cells[-1].source
        assert "## Exercises" in last
        assert targets(last)[-1] == following.name


def test_five_cells_are_five_and_the_first_installs_this_package() -> None:
    every = nbformat.read(ROOT / "notebooks" / "five_cells.ipynb", as_version=4).cells
    cells = [cell for cell in every if cell.cell_type == "code"]
    assert [cell.source.split()[1].rstrip(":") for cell in cells] == ["Install", "Load", "Learn", "Mix", "Film"]
    assert f"%pip install --quiet {PROJECT['name']}" in cells[0].source
    assert not cells[0].outputs
    assert [kind for kind, _ in parts(cells[-1])] == ["image/gif", "text/plain"]


def shown(text: str, tag: str = "", kind: str = "text/plain") -> NotebookNode:
    """A notebook of one cell that shows a text."""
    cell = nbformat.v4.new_code_cell(outputs=[nbformat.v4.new_output("display_data", {kind: text})])
    cell.metadata["tags"] = [tag] if tag else []
    return nbformat.v4.new_notebook(cells=[cell])


def test_a_changed_digit_is_found() -> None:
    for kind in ("text/plain", "text/markdown", "text/html"):
        one, other = shown("weight 1.46: 0.84 walk", kind=kind), shown("weight 1.46: 0.85 walk", kind=kind)
        assert differences(one, one) == []
        assert differences(one, other) == ["cell 0: weight 1.46: 0.84 walk became weight 1.46: 0.85 walk"]


def test_a_changed_digit_of_a_committed_notebook_is_found() -> None:
    kept = nbformat.read(ROOT / "notebooks" / "agent.ipynb", as_version=4)
    changed = nbformat.read(ROOT / "notebooks" / "agent.ipynb", as_version=4)
    assert differences(kept, changed) == []
    output = next(one for cell in changed.cells for one in cell.get("outputs", []) if "text/markdown" in one.get("data", {}))
    output.data["text/markdown"] = output.data["text/markdown"].replace("1.00", "1.01", 1)
    assert len(differences(kept, changed)) == 1
    output.data.clear()
    assert "became" in differences(kept, changed)[0]


def test_tags_say_what_may_differ() -> None:
    kept = "explains 0.84, weight -1.46, 5 of them"
    for other, rounded in (("explains 0.85, weight -1.47, 5 of them", True), ("explains 0.86, weight -1.46, 5 of them", False)):
        assert (differences(shown(kept, "rounding"), shown(other)) == []) is rounded
        assert differences(shown(kept, "varies"), shown(other)) == []
        assert differences(shown(kept), shown(other)) != []
    assert differences(shown(kept, "rounding"), shown("explains 0.84, weight -1.46, 5 of us")) != []
    assert differences(shown(kept, "rounding"), shown("explains 0.840, weight -1.46, 5 of them")) != []
    assert differences(shown(kept, "varies"), shown(" ")) != []
    assert differences(shown(kept, "varies"), nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell()])) != []


def test_a_picture_is_compared_by_its_size() -> None:
    def picture(*size: int) -> NotebookNode:
        file = io.BytesIO()
        Image.new("RGB", size).save(file, format="PNG")
        return shown(base64.b64encode(file.getvalue()).decode(), kind="image/png")

    assert differences(picture(200, 100), picture(201, 100)) == []
    assert differences(picture(200, 100), picture(220, 100)) != []
    assert differences(picture(200, 100), shown("1")) != []


@pytest.mark.notebook
def test_running_a_notebook_leaves_out_what_differs_from_run_to_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    lines = ["import os, sys", "print(sorted(os.listdir()), os.environ['OMP_NUM_THREADS'])", "print('a warning', file=sys.stderr)"]
    cells = [
        nbformat.v4.new_code_cell("\n".join(lines)),
        nbformat.v4.new_code_cell("%%sh\npython -c 'import ftl_lightning as f; print(f.__file__)'"),
    ]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "a.ipynb")
    (tmp_path / "run").mkdir()
    found = EXECUTE["executed"](tmp_path / "a.ipynb", tmp_path / "run")
    assert list(parts(found.cells[0])) == [("stdout", "['conf', 'pretrained', 'results'] 1\n")]
    assert list(parts(found.cells[1])) == [("stdout", f"{ROOT / 'ftl_lightning' / '__init__.py'}\n")]
    assert [dict(cell.metadata) for cell in found.cells] == [{}, {}]
    assert "a warning" in capfd.readouterr().err
