"""The files of accuracy over learning time and over coverage, their figures, and the benchmark that writes the former."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.cli.main import main
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.references import FRESH, REPLAYED
from ftl_lightning.evaluation.results import append_rows
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.reporting.figures import frontier, learning_time
from ftl_lightning.reporting.measurements import (
    ONE,
    PUBLISHED,
    TEN,
    Measured,
    frontier_table,
    reached,
    read_frontier,
    read_speed,
    write_frontier,
)
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.data import InversionData
from ftl_lightning.training.model_folder import read_model
from tests.conftest import ROOT
from tests.evaluation.rows import row as measured

CURVES = {
    PUBLISHED: [Measured(PUBLISHED, 10, 1.0, 0.5), Measured(PUBLISHED, 1000, 100.0, 0.97), Measured(PUBLISHED, 5000, 500.0, 0.98)],
    ONE: [Measured(ONE, 10, 0.1, 0.2), Measured(ONE, 20, 0.2, 0.96), Measured(ONE, 40, 0.5, 1.0)],
    TEN: [Measured(TEN, 10, 1.0, 0.97), Measured(TEN, 40, 2.0, 0.97)],
}


def write_speed(path: Path) -> None:
    rows = [vars(point) for curve in CURVES.values() for point in curve]
    path.write_text(json.dumps({"curves": rows}))


@pytest.fixture(scope="module")
def benchmark() -> dict[str, Callable[..., Any]]:
    return runpy.run_path(str(ROOT / "benchmarks" / "speed" / "speed.py"))


def test_curves_are_read_from_a_file_or_its_folder_and_there_are_none_without(tmp_path: Path) -> None:
    assert read_speed(tmp_path) == {}
    write_speed(tmp_path / "speed.json")
    assert read_speed(tmp_path) == read_speed(tmp_path / "speed.json") == CURVES


@pytest.mark.parametrize("content", ["{}", "no JSON", '{"curves": [{"curve": "a", "steps": "many", "seconds": 1, "accuracy": 1}]}'])
def test_a_file_of_something_else_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "speed.json").write_text(content)
    with pytest.raises(UserError, match=r"speed.json: expected "):
        read_speed(tmp_path)


def test_the_figure_has_a_line_for_each_curve_and_all_reach_a_little_less_than_the_least_final_accuracy() -> None:
    (axes,) = learning_time(CURVES).axes
    drawn = {str(line.get_label()): line.get_xydata().tolist() for line in axes.lines}  # type: ignore[union-attr]
    assert drawn[ONE] == [[0.1, 0.2], [0.2, 0.96], [0.5, 1.0]]
    assert drawn[TEN] == [[1.0, 0.97], [2.0, 0.97]]
    assert set(CURVES) <= set(drawn)
    assert reached(CURVES) == pytest.approx(0.95)


def test_ratios_are_of_the_ends_and_of_when_the_common_accuracy_is_first_reached(benchmark: dict[str, Callable[..., Any]]) -> None:
    found = benchmark["ratios"](CURVES)
    assert found["ratio"] == {
        f"{ONE}, to the end": 1000.0,
        f"{ONE}, to equal accuracy": 500.0,
        f"{TEN}, to the end": 2500.0,
        f"{TEN}, to equal accuracy": 1000.0,
    }
    assert found["to equal accuracy"][ONE] == {"steps": 20, "seconds": 0.2}


def test_the_published_procedure_learns_the_same_of_many_concepts_in_a_batch(
    benchmark: dict[str, Callable[..., Any]], tiny: Path
) -> None:
    model = read_model(GenerativeModel, tiny)
    data = InversionData("object_rearrangement", suite="validation").demonstrations
    states = [data.select(name).states for name in dict.fromkeys(data.concepts)][:3]
    together = benchmark["published_together"](model, states, [generator("cpu", place) for place in range(3)], (1, 5))
    assert list(together) == [1, 5]
    for place, own in enumerate(states):
        alone = benchmark["published"](model, own, 5, generator("cpu", place))
        start = benchmark["published"](model, own, 0, generator("cpu", place))
        moved = (alone.embeddings - start.embeddings).abs().max()
        assert moved > 5e-4
        torch.testing.assert_close(together[5][place].embeddings, alone.embeddings, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_curve_of_ours_ends_where_every_run_has_stopped(benchmark: dict[str, Callable[..., Any]], tiny: Path) -> None:
    model = read_model(GenerativeModel, tiny)
    data = InversionData("object_rearrangement", suite="validation").demonstrations
    names = tuple(dict.fromkeys(data.concepts))[:2]
    judge = benchmark["Judge"](model, names)
    settings = InversionSettings().changed(samples=4, tolerance=0.9)  # stops as soon as it can
    curve = benchmark["our_curve"]("ours", judge, [data.select(name) for name in names], settings, 400, 1)
    steps = [point.steps for point in curve]
    assert steps == sorted(set(steps))
    assert steps[-1] < 400
    assert all(point.seconds > 0 and 0 <= point.accuracy <= 1 for point in curve)


DOMAIN = load_domain("object_rearrangement")


def row(method: str, temperature: float | None, accuracy: float, coverage: float | None, **changes: object) -> dict[str, object]:
    what = {"domain": DOMAIN.name, "suite": "validation", "setting": "new concept", "task": "t", "seed": 0, "n": 9}
    what |= {"form": "", "variant": ""}
    values = {"method": method, "temperature": temperature, "accuracy": accuracy, "novelty": None, "coverage": coverage}
    return {**what, **values, **changes}


ROWS = [
    row("FTL-IGM", 1.0, 0.5, 1.0, variant="one"),
    row("FTL-IGM", 0.1, 0.9, 2.0, variant="one"),
    row("FTL-IGM", 0.1, 0.7, 2.2, variant="one", task="u"),
    row("BC", None, 1.0, 3.0),
    row(REPLAYED, None, 1.0, 2.5),
    row(FRESH, None, 1.0, 0.5),
]


def test_measurements_are_added_the_same_are_replaced_and_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frontier.json"
    assert read_frontier(path).empty
    write_frontier(path, ROWS)
    write_frontier(path, [row("BC", None, 0.8, 3.1), row("BC", None, 0.7, 3.0, seed=1)])
    found = read_frontier(tmp_path)
    assert len(found) == 7
    assert found.loc[found["method"] == "BC", "accuracy"].tolist() == [0.8, 0.7]
    assert found["novelty"].isna().all()
    assert found.loc[found["method"] == "FTL-IGM", "temperature"].tolist() == [1.0, 0.1, 0.1]
    path.write_text('{"speed": 3}')
    with pytest.raises(UserError, match=r"frontier.json: expected rows of domain, suite"):
        read_frontier(tmp_path)


def test_the_same_measurement_is_replaced_and_others_stay(tmp_path: Path) -> None:
    path = tmp_path / "frontier.json"
    write_frontier(path, [row("FTL-IGM", 0.1, 0.5, 1.0, form="with modes"), row("FTL-IGM", 0.1, 0.4, 1.5)])
    write_frontier(path, [row("FTL-IGM", 0.1, 0.75, 1.0, form="with modes")])
    found = read_frontier(path)
    assert found[["method", "form", "accuracy"]].to_numpy().tolist() == [["FTL-IGM", "", 0.4], ["FTL-IGM", "with modes", 0.75]]
    cells = frontier_table(DOMAIN, found).cells
    assert cells["method"].tolist() == ["FTL-IGM", "FTL-IGM with modes"]


def test_the_frontier_is_a_line_of_means_in_the_order_of_temperatures_with_both_reference_points(tmp_path: Path) -> None:
    write_frontier(tmp_path / "frontier.json", ROWS)
    figure = frontier(DOMAIN, read_frontier(tmp_path))
    (axes,) = figure.axes
    drawn = {str(line.get_label()): line.get_xydata().tolist() for line in axes.lines}  # type: ignore[union-attr]
    assert drawn["FTL-IGM (one)"] == [pytest.approx([2.1, 0.8]), pytest.approx([1.0, 0.5])]
    assert drawn["BC"] == [[3.0, 1.0]]
    assert drawn[REPLAYED] == [[2.5, 1.0]]
    assert drawn[FRESH] == [[0.5, 1.0]]
    write_frontier(tmp_path / "frontier.json", [row("BC", None, 1.0, 3.0, suite="paper")])
    titles = [axes.get_title(loc="left") for axes in frontier(DOMAIN, read_frontier(tmp_path)).axes]
    assert titles == ["new concept, validation", "new concept, paper"]


@pytest.mark.slow
def test_the_report_draws_it_and_seconds_of_learning_where_their_files_are(tmp_path: Path) -> None:
    append_rows(tmp_path / "r" / "own.csv", [measured(method="BC", variant="")])
    pictures = [Path("out") / DOMAIN.name / "frontier.png", Path("out") / "speed.png"]
    for there in (False, True):
        if there:
            write_frontier(tmp_path / "r" / "frontier.json", ROWS)
            write_speed(tmp_path / "r" / "speed.json")
        assert main(["report", "--results=r", "--out=out"]) == 0
        assert [path.exists() for path in pictures] == [there, there]
    assert min(path.stat().st_size for path in pictures) > 1000
