"""Scripts that rewrite the hashes of committed rows, and that measure committed rows again."""

import json
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.evaluation.results import Row, append_rows, read_rows
from tests.conftest import ROOT
from tests.evaluation.rows import REFERENCE
from tests.evaluation.rows import row as usual_row

CELL: dict[str, Any] = {"plan": "p.yaml", "results": "r.csv", "stage": 1, "cell": "c", "seeds": [0, 1], "missing": False}
CELL |= {"form": "", "variant": "free", "K": 2, "omega": "1.2", "data/domain": "object_rearrangement"}
CONFIGURATION = {
    "domain": "object_rearrangement",
    "method": "FTL-IGM",
    "model/pretrained": "m",
    "model/knots": 1,
    "data/demonstrations_per_concept": 5,
    "evaluation/samples": 50,
    "evaluation/suites": "training, paper",
    "evaluation/replan": None,
    "environment": "",
}
TASK = {"setting": "new concept", "task": "square diagonal to triangle"}


def script(name: str) -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "benchmarks" / "making" / f"{name}.py"))


def rows() -> list[Row]:
    described = CELL | {"configuration": CONFIGURATION | dict.fromkeys(("model/seed", "data/seed", "evaluation/sample_seed"), 0)}
    before = script("rehash")["version_1"](described)
    return [
        usual_row(**TASK, seed=0, config_hash=before["config_hash"]),
        usual_row(**TASK, seed=1, config_hash="stale"),
        usual_row(**TASK, seed=2, config_hash="unplanned"),
        usual_row(**TASK | REFERENCE, seed=0, config_hash=before["reference_hash"], method="chance"),
    ]


def test_hashes_are_rewritten_by_the_hash_before_or_the_columns_of_a_row_and_nothing_else_changes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    append_rows("r.csv", rows())
    known = read_rows("r.csv")
    Path("film.json").write_text(json.dumps({"domain": "d", "row": {"config_hash": known["config_hash"][0], "value": 1.0}}))
    Path("cells.json").write_text(json.dumps([CELL | {"configuration": CONFIGURATION}]))
    script("rehash")["rewrite"]([Path("cells.json")], ["r.csv", "film.json"])
    table = read_rows("r.csv")
    hashes = table["config_hash"].tolist()
    assert [text[:2] for text in hashes] == ["2:", "2:", "un", "2:"]
    assert len(set(hashes)) == 4
    assert table.drop(columns="config_hash").equals(known.drop(columns="config_hash"))
    assert json.loads(Path("film.json").read_text()) == {"domain": "d", "row": {"config_hash": hashes[0], "value": 1.0}}
    printed = capsys.readouterr().out
    assert "unplanned (1 rows, 0 cells)" in printed
    assert "r.csv: 4 rows: 2 same hash before, 1 same columns, 1 0 cells" in printed


def test_a_cell_that_was_run_again_is_compared_to_the_last_digit() -> None:
    rerun = script("rerun_cells")
    (_results, cell), *_ = rerun["cells_of"](str(ROOT / "conf/ablation/tabletop.yaml"), r"invert tabletop, seed 0", "")
    assert "model.pretrained" not in cell.options
    again = Path("again", f"r_{cell.folder}", "results.csv")
    committed, *_, chance = rows()
    append_rows("r.csv", [committed, chance])
    append_rows(again, [committed, chance, replace(committed, metric="newer")])
    outcome = rerun["run"]("r.csv", cell, Path("again"))
    assert (outcome["state"], outcome["compared"], outcome["not committed"]) == ("equal", 2, 1)
    append_rows("r.csv", [replace(committed, value=0.25)])
    outcome = rerun["run"]("r.csv", cell, Path("again"))
    assert outcome["state"] == "differs"
    assert [(change["committed"], change["again"]) for change in outcome["different"]] == [("0.25", "0.5")]
    append_rows("r.csv", [replace(committed, metric="older")])
    assert rerun["run"]("r.csv", cell, Path("again"))["state"] == "missing rows"
