"""The file of accuracy over coverage, and its figure."""

from pathlib import Path

import pytest

from ftl_lightning.cli.main import main
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.references import FRESH, REPLAYED
from ftl_lightning.evaluation.results import append_rows
from ftl_lightning.reporting.figures import frontier
from ftl_lightning.reporting.frontier import frontier_table, read_frontier, write_frontier
from ftl_lightning.services.errors import UserError
from tests.evaluation.rows import row as measured
from tests.reporting.test_speed import write as write_speed

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
    titles = [axes.get_title() for axes in frontier(DOMAIN, read_frontier(tmp_path)).axes]
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
