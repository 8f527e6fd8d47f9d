"""What a grid will cost, by what was measured, and the record of what became of its cells."""

from pathlib import Path

import pytest

from ftl_lightning.ablation.estimate import estimate, makespan, seconds_of
from ftl_lightning.ablation.plan import Cell, Stage
from ftl_lightning.ablation.record import Entry, read_record, record_path, tell
from ftl_lightning.cli import main
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.results import read_rows
from tests.ablation.raylets import QUICK, write_plan

STAGE = Stage("invert", "a.yaml", grid={"model.omega": [1.0, 1.2]})


def cells(*seeds: int) -> list[Cell]:
    return [cell for seed in seeds for cell in STAGE.cells(seed)]


def test_cells_go_to_the_worker_that_is_free_and_stages_wait_for_one_another() -> None:
    assert makespan([[3, 2, 1], [4]], 1) == 10
    assert makespan([[3, 2, 1], [4]], 2) == 7
    assert makespan([[3, 2, 1], [4]], 9) == 7
    assert makespan([[]], 2) == 0


def test_a_cell_is_measured_by_itself_or_else_by_its_nearest() -> None:
    one, other = cells(0)
    again = cells(1)[0]
    entries = {one.name: Entry("done", one.configs, seconds=100), other.name: Entry("done", other.configs, seconds=300)}
    assert seconds_of(one, entries) == 100
    assert seconds_of(again, entries) == 100
    new = next(Stage("invert", "a.yaml", name="new").cells(0))
    assert seconds_of(new, entries) == 200
    assert seconds_of(next(Stage("fit", "a.yaml").cells(0)), entries) is None
    assert seconds_of(next(Stage("invert", "b.yaml").cells(0)), entries) is None


def test_an_estimate_says_what_it_does_not_know() -> None:
    plan = cells(0, 1)
    (first, *_) = plan
    assert estimate([[]], {}, 4) == ["4 cells: 4 need not be run, 0 to run"]
    assert "not known, as no cell like them was measured" in estimate([plan], {}, 4)[-1]
    other = next(Stage("fit", "a.yaml").cells(0))
    lines = estimate([[other], plan], {first.name: Entry("done", first.configs, seconds=3600)}, 9)
    assert lines == [
        "9 cells: 4 need not be run, 5 to run",
        "not known: 1 of them, none like which was measured, such as fit a, seed 0; their time comes on top",
        "measured: 1 of them before, 3 estimated from other seeds or options of the same files",
        "1 at a time: 4.0 hours",
        "2 at a time: 2.0 hours",
        "4 at a time: 1.0 hours",
        "8 at a time: 1.0 hours",
    ]


def test_the_record_keeps_what_was_measured_and_refuses_what_it_did_not_write(tmp_path: Path) -> None:
    one, other = cells(0)
    tell("r.csv", [one, other], "queued")
    tell("r.csv", [one], "running", "n1")
    tell("r.csv", [one], "again", "n1", "lost\nits node")
    tell("r.csv", [one], "running", "n2")
    tell("r.csv", [one], "done", "", "4 rows", 12.345)
    entry = Entry("done", ("a.yaml",), "n2", 2, 12.35, "4 rows")
    assert read_record("r.csv") == {one.name: entry, other.name: Entry("queued", ("a.yaml",))}
    tell("r.csv", [one], "queued")
    assert read_record("r.csv")[one.name] == Entry("queued", ("a.yaml",), seconds=12.35)
    record_path("r.csv").write_text('{"kind": "cells of an ablation", "format": 2, "cells": {}}')
    with pytest.raises(UserError, match=r"r.cells.json: expected cells of an ablation of format 1, found another file; remove it"):
        read_record("r.csv")


def test_a_grid_is_shown_in_one_table_and_estimated_from_its_own_cells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    failing = QUICK | {"options": {**QUICK["options"], "model.budget.learning_rate": 1e30, "data.steps": 20}, "name": "steep"}
    grid = QUICK | {"grid": {"model.omega": [1.0, 1.2]}, "resources": {"cpus": 1}}
    config = str(write_plan(tmp_path / "a.yaml", grid, failing))
    assert main(["ablate", "--config", config, "--estimate", "true"]) == 0
    assert "3 cells: 0 need not be run, 3 to run\nhours: not known" in capsys.readouterr().out
    assert main(["ablate", "--config", config, "--shard", "1/3"]) == 0
    assert main(["ablate", "--config", config, "--only", "[2]"]) == 2
    capsys.readouterr()
    assert main(["ablate", "--config", config, "--status", "true"]) == 0
    told = capsys.readouterr().out
    assert "3 cells: 1 queued, 1 done, 1 failed" in told
    rows = {line.split("|")[1].strip(): line.split("|")[2:] for line in told.splitlines() if line.startswith("| invert")}
    state, node, runs, seconds, note, _ = map(str.strip, rows["invert object_rearrangement, omega 1.0, seed 0"])
    assert (state, runs, note) == ("done", "1", f"{len(read_rows('r.csv'))} rows")
    assert f"{node}: 2 cells: 1 done, 1 failed" in told
    assert int(seconds) < 100
    assert "the loss became" in rows["invert object_rearrangement, steep, seed 0"][4]
    before = {path: path.stat().st_mtime_ns for path in Path().rglob("*") if path.is_file()}
    assert main(["ablate", "--config", config, "--estimate", "true", "--workers", "2"]) == 0
    assert {path: path.stat().st_mtime_ns for path in Path().rglob("*") if path.is_file()} == before
    told = capsys.readouterr().out
    assert "3 cells: 1 need not be run, 2 to run" in told
    assert "measured: 0 of them before, 2 estimated from other seeds or options of the same files" in told
    assert "2 at a time: " in told
    assert "1 at a time: " not in told
