"""Scripts that rewrite the hashes of committed rows, and that measure committed rows again."""

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.evaluation.results import Row, append_rows, read_rows
from tests.conftest import ROOT
from tests.evaluation.rows import REFERENCE
from tests.evaluation.rows import row as usual_row

PLACE = {"plan": "p.yaml", "results": "r.csv", "stage": 1, "domain": "object_rearrangement", "method": "FTL-IGM", "form": ""}
PLACE |= {
    "variant": "free",
    "K": 2,
    "omega": "1.2",
    "model_hash": "m",
    "samples": 50,
    "suites": "training, paper",
    "demonstrations": 5,
}
TASK = {"setting": "new concept", "task": "square diagonal to triangle"}


def script(name: str) -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "benchmarks" / "making" / f"{name}.py"))


def cells(*hashes: str) -> list[dict[str, Any]]:
    """Cells of the seeds 0, 1 and so on."""
    pairs = enumerate(hashes)
    return [
        {**PLACE, "cell": f"c{seed}", "seed": seed, "config_hash": text, "reference_hash": f"{text[:2]}r"} for seed, text in pairs
    ]


def rows() -> list[Row]:
    return [
        usual_row(**TASK, seed=0, config_hash="o0"),
        usual_row(**TASK, seed=1, config_hash="stale"),
        usual_row(**TASK, seed=2, config_hash="unplanned"),
        usual_row(**TASK | REFERENCE, seed=0, config_hash="o0r", method="chance"),
    ]


def test_hashes_are_rewritten_by_the_hash_before_or_the_columns_of_a_row_and_nothing_else_changes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    append_rows("r.csv", rows())
    known = read_rows("r.csv")
    Path("film.json").write_text('{"row": {"config_hash": "o0", "value": 1.0}}')
    for name, hashes in (("before", ("o0", "o1")), ("after", ("2:0", "2:1"))):
        Path(f"{name}.json").write_text(json.dumps(cells(*hashes)))
    script("rehash")["rewrite"](Path("before.json"), Path("after.json"), ["r.csv", "film.json"])
    table = read_rows("r.csv")
    assert table["config_hash"].tolist() == ["2:0", "2:1", "unplanned", "2:r"]
    assert table.drop(columns="config_hash").equals(known.drop(columns="config_hash"))
    assert Path("film.json").read_text() == '{"row": {"config_hash": "2:0", "value": 1.0}}'
    printed = capsys.readouterr().out
    assert "unplanned (1 rows, 0 cells)" in printed
    assert "r.csv: 4 rows: 2 same hash before, 1 same columns, 1 0 cells" in printed


def test_a_cell_that_was_run_again_is_compared_to_the_last_digit() -> None:
    rerun = script("rerun_cells")
    (results, cell), *_ = rerun["cells_of"](str(ROOT / "conf/ablation/tabletop.yaml"), r"invert tabletop, seed 0", "")
    assert "model.pretrained" not in cell.options
    append_rows("r.csv", rows()[:2])
    append_rows(Path("again", f"r_{cell.folder}", "results.csv"), rows()[:2])
    assert rerun["run"]("r.csv", cell, Path("again"))["state"] == "equal"
    append_rows("r.csv", [usual_row(**TASK, seed=0, config_hash="o0", value=0.25)])
    outcome = rerun["run"]("r.csv", cell, Path("again"))
    assert outcome["state"] == "differs"
    assert [(change["committed"], change["again"]) for change in outcome["different"]] == [("0.25", "0.5")]
    append_rows(Path("again", f"r_{cell.folder}", "results.csv"), [usual_row(**TASK, seed=5)])
    assert rerun["run"]("r.csv", cell, Path("again"))["state"] == "unknown rows"
