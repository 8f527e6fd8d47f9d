"""Tables of the paper beside results: ``report --paper``."""

from pathlib import Path

import pytest

from ftl_lightning.apps import paper
from ftl_lightning.apps.paper import alike, cells_of, items, measure_again, printed
from ftl_lightning.cli.main import main
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT

RESULTS = ROOT / "results"


def test_items_are_named_by_words_and_numbers() -> None:
    assert [item["item"] for item in items("table 1")] == ["Table 1"]
    assert [item["item"] for item in items("7")] == ["Figures 6 (right), 7 and 13"]
    assert len(items()) > 10
    with pytest.raises(UserError, match=r"paper: expected one of Figures 1 and 2.*; or all, found Table 99"):
        items("Table 99")


def test_no_folder_of_results_is_one_clear_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--paper=Table 4", "--results=none"]) == 2
    assert (
        capsys.readouterr()
        .err.strip()
        .endswith("none: expected a folder of results, found nothing; run this in a checkout, or add --results FOLDER")
    )


def test_an_item_is_printed_with_the_papers_numbers_and_without_links(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--paper=Table 1", f"--results={RESULTS}"]) == 0
    out = capsys.readouterr().out
    assert "| BC | people 40 % | 0.00" in out
    assert "**Not reproduced.**" in out
    assert "](" not in out
    included = printed(items("Table 4")[0], RESULTS)
    assert "navigation" in included
    assert (RESULTS / "report" / "agent" / "omega.md").read_text().strip() in included


def test_rows_of_several_settings_are_no_number() -> None:
    rows = read_rows(RESULTS / "tabletop.csv")
    with pytest.raises(UserError, match=r"here: expected rows with .*, found none"):
        alike(rows, {"method": "BC", "metric": "accuracy"}, "here")
    with pytest.raises(UserError, match="here: expected rows of one setting, found"):
        alike(rows, {"method": "FTL-IGM", "metric": "closed loop success"}, "here")


def test_the_cells_behind_an_item_run_again_into_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    cells = cells_of(items("Section 5.2"), RESULTS)
    assert list(cells) == ["comparison.csv"]
    assert {cell.verb for cell in cells["comparison.csv"]} == {"invert"}
    assert all("conf/method/language.yaml" in cell.configs for cell in cells["comparison.csv"])
    weights = cells_of(items("Table 4"), RESULTS)
    assert {cell.options.get("model.omega") for cell in weights["agent.csv"]} > {"1.2", "1.6"}
    fits = [cell.verb for cell in weights["driving.csv"]].count("fit")
    assert fits == len({cell.options["model.pretrained"] for cell in weights["driving.csv"] if cell.verb == "invert"})
    ran = []
    monkeypatch.setattr(paper, "run_ablation", lambda plan, results: ran.append((len(plan), results)))
    measure_again(items("Section 5.2"), RESULTS, tmp_path)
    assert ran == [(len(cells["comparison.csv"]), str(tmp_path / "comparison.csv"))]
    with pytest.raises(UserError, match="paper: expected an item with measured numbers, found Appendices"):
        measure_again(items("Appendices"), RESULTS, tmp_path)
