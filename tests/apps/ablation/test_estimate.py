"""What a grid will cost, by what was measured, and the record of what became of its cells."""

from pathlib import Path

import pytest

from ftl_lightning.apps.ablation import run
from ftl_lightning.apps.ablation.plan import Cell, Stage
from ftl_lightning.apps.ablation.record import CellRecord, Outcome, estimate, makespan, read_record, record_path, seconds_of, tell
from ftl_lightning.cli.main import main
from ftl_lightning.services.errors import UserError
from tests.apps.ablation.attempts import nothing_is_run  # noqa: F401
from tests.apps.ablation.raylets import write_plan
from tests.conftest import files, succeed

STAGE = Stage("invert", "a.yaml", grid={"model.omega": [1.0, 1.2]})


def cells(*seeds: int) -> list[Cell]:
    return [cell for seed in seeds for cell in STAGE.cells(seed)]


def test_cells_go_to_the_worker_that_is_free_and_stages_wait_for_one_another() -> None:
    assert [makespan([[3, 2, 1], [4]], workers) for workers in (1, 2, 9)] == [10, 7, 7]
    assert makespan([[]], 2) == 0


def test_a_cell_is_measured_by_itself_or_else_by_its_nearest() -> None:
    one, other = cells(0)
    entries = {one.name: CellRecord("done", one.configs, seconds=100), other.name: CellRecord("done", other.configs, seconds=300)}
    assert seconds_of(one, entries) == seconds_of(cells(1)[0], entries) == 100
    new = next(Stage("invert", "a.yaml", name="new").cells(0))
    assert seconds_of(new, entries) == 200
    for stage in (Stage("fit", "a.yaml"), Stage("invert", "b.yaml")):
        assert seconds_of(next(stage.cells(0)), entries) is None


def test_an_estimate_says_what_it_does_not_know() -> None:
    first, *_ = plan = cells(0, 1)
    assert estimate([[]], {}, 4) == ["4 cells: 4 need not be run, 0 to run"]
    assert "not known, as no similar cell was measured" in estimate([plan], {}, 4)[-1]
    other = next(Stage("fit", "a.yaml").cells(0))
    lines = estimate([[other], plan], {first.name: CellRecord("done", first.configs, seconds=3600)}, 9)
    assert lines == [
        "9 cells: 4 need not be run, 5 to run",
        "not known: 1 of them, without a similar measured cell, such as fit a, seed 0; their time is added",
        "measured: 1 of them before, 3 estimated from other seeds or options of the same files",
        "1 at a time: 4.0 hours",
        "2 at a time: 2.0 hours",
        "4 at a time: 1.0 hours",
        "8 at a time: 1.0 hours",
    ]


def test_the_record_keeps_what_was_measured_and_refuses_what_it_did_not_write(tmp_path: Path) -> None:
    one, other = cells(0)
    tell("r.csv", [one, other], "queued")
    tell("r.csv", [one], "running", Outcome(node="n1"))
    tell("r.csv", [one], "again", Outcome(node="n1", note="lost\nits node"))
    tell("r.csv", [one], "running", Outcome(node="n2"))
    tell("r.csv", [one], "done", Outcome(note="4 rows", seconds=12.345, settings="1:a", config_hash="2:b"))
    entry = CellRecord("done", ("a.yaml",), "n2", 2, 12.35, "4 rows", "1:a", "2:b")
    assert read_record("r.csv") == {one.name: entry, other.name: CellRecord("queued", ("a.yaml",))}
    tell("r.csv", [one], "queued")
    assert read_record("r.csv")[one.name] == CellRecord("queued", ("a.yaml",), seconds=12.35, settings="1:a", config_hash="2:b")
    record_path("r.csv").write_text('{"kind": "cells of an ablation", "format": 2, "cells": {}}')
    with pytest.raises(UserError, match=r"r.cells.json: expected cells of an ablation of format 1, found another file; remove it"):
        read_record("r.csv")


@pytest.mark.usefixtures("nothing_is_run")
def test_a_grid_is_shown_in_one_table_and_estimated_from_its_own_cells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    failing = {"verb": "invert", "config": "c.yaml", "options": {"model.omega": 1.1}, "name": "steep"}
    grid = {"verb": "invert", "config": "c.yaml", "grid": {"model.omega": [1.0, 1.2]}, "resources": {"cpus": 1}}
    config = str(write_plan(tmp_path / "a.yaml", grid, failing))
    succeed("ablate", "--config", config, "--estimate", "true")
    assert "3 cells: 0 need not be run, 3 to run\nhours: not known" in capsys.readouterr().out
    succeed("ablate", "--config", config, "--shard", "1/3")
    assert main(["ablate", "--config", config, "--only", "[2]"]) == 2
    capsys.readouterr()
    succeed("ablate", "--config", config, "--status", "true")
    told = capsys.readouterr().out
    assert "3 cells: 1 queued, 1 done, 1 failed" in told
    rows = {line.split("|")[1].strip(): line.split("|")[2:] for line in told.splitlines() if line.startswith("| invert")}
    state, node, runs, seconds, note, _ = map(str.strip, rows["invert c, omega 1.0, seed 0"])
    assert (state, runs, seconds, note) == ("done", "1", "1", "3 rows")
    assert f"{node}: 2 cells: 1 done, 1 failed" in told
    assert "the loss became" in rows["invert c, steep, seed 0"][4]
    before = files()
    succeed("ablate", "--config", config, "--estimate", "true", "--workers", "2")
    assert files() == before
    told = capsys.readouterr().out
    assert "3 cells: 1 need not be run, 2 to run" in told
    assert "measured: 0 of them before, 2 estimated from other seeds or options of the same files" in told
    assert "2 at a time: " in told
    assert "1 at a time: " not in told


def test_what_was_measured_is_known_without_the_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """In another checkout pretrained models are missing: rows and the record of their settings decide."""
    fit = next(Stage("fit", "a.yaml", options={"model.output": "logs/m"}, done="logs/m/config.json").cells(0))
    reads, other = (next(Stage("invert", "a.yaml", name=name, options={"model.pretrained": "logs/m"}).cells(0)) for name in "ab")
    plan = [[fit], [reads, other]]
    monkeypatch.setattr(run, "settings_of", lambda cell: f"settings of {cell.name}")
    monkeypatch.setattr(run, "known_hashes", lambda results: {"2:a", "2:b"})

    def measured(cell: Cell, config_hash: str) -> None:
        tell("r.csv", [cell], "done", Outcome(settings=f"settings of {cell.name}", config_hash=config_hash))

    measured(reads, "2:a")
    assert run.to_run(run.outcomes(plan, "r.csv")) == [[fit], [other]]
    measured(other, "2:c")
    assert run.to_run(run.outcomes(plan, "r.csv")) == [[fit], [other]]
    measured(other, "2:b")
    assert run.to_run(run.outcomes(plan, "r.csv")) == [[], []]
    assert run.to_run(run.outcomes([[fit]], "r.csv")) == [[fit]]
    monkeypatch.setattr(run, "settings_of", lambda cell: "changed")
    assert run.to_run(run.outcomes(plan, "r.csv")) == plan
