"""The ablation and the notebook that shows it, in miniature."""

from pathlib import Path

import nbformat
import pytest
import yaml
from nbclient import NotebookClient

from ftl_lightning.ablation import Stage
from ftl_lightning.cli import main
from ftl_lightning.evaluation.results import read_rows
from tests.conftest import CONF, ROOT

NOTEBOOKS = ROOT / "notebooks"


def run(name: str, folder: Path) -> list[str]:
    """Tables that a notebook shows when it is run in a folder."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    return [output.get("data", {}).get("text/markdown", "") for cell in notebook.cells for output in cell.get("outputs", [])]


def test_cells_are_the_product_of_the_grid() -> None:
    stage = Stage(
        "invert", "c.yaml", {"model.pretrained": "p{seed}"}, {"model.components": [1, 2], "model.omega": [1.2, "learned"]}
    )
    cells = list(stage.cells(7))
    assert len(cells) == 4
    assert cells[1] == ["--config=c.yaml", "--model.pretrained=p7", "--model.components=1", "--model.omega=learned"]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The folders that the commands' relative paths name."""
    for name in ("conf", "notebooks"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def test_the_notebook_runs_an_ablation_that_skips_what_is_known(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = "conf/ablation/smoke.yaml"
    monkeypatch.setenv("FTL_ABLATION", config)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert sum("| paper |" in text for text in run("object_rearrangement", checkout)) == 4
    path = yaml.safe_load((CONF / "ablation" / "smoke.yaml").read_text())["results"]
    rows = read_rows(path)
    assert set(rows["seed"]) == {0, 1}
    assert set(rows.loc[rows["K"] > 0, "K"]) == {1, 2}
    assert main(["ablate", "--config", config]) == 0
    out = capsys.readouterr().out
    assert out.count("in the results already") == 8
    assert out.count("done before") == 2
    assert read_rows(path).equals(rows)


@pytest.mark.parametrize(("name", "tables"), [("agent", 5), ("driving", 4)])
def test_a_notebook_shows_the_committed_results(name: str, tables: int, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (checkout / "results").symlink_to(ROOT / "results")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert sum("| paper |" in text for text in run(name, checkout)) == tables


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_holds_no_logic(path: Path) -> None:
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert not any(word in source for source in code for word in ("def ", "class ", ".mean(", ".std("))


def test_a_failing_cell_is_told_at_the_end_and_stops_no_other(checkout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage = {"verb": "invert", "config": str(CONF / "invert" / "object_rearrangement.yaml")}
    stages = [stage | {"options": {"model.pretrained": name}} for name in ("nowhere", "elsewhere")]
    Path("a.yaml").write_text(yaml.safe_dump({"results": "r.csv", "stages": stages}))
    assert main(["ablate", "--config", "a.yaml"]) == 2
    told = capsys.readouterr()
    assert "2 of 2 cells failed" in told.err
    assert "elsewhere/config.json" in told.err
