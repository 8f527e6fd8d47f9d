import io
from typing import Any

import pytest
from rich.console import Console

from ftl_lightning.evaluation.results import Row
from ftl_lightning.evaluation.summary import plain, show, summary_table
from tests.evaluation.rows import REFERENCE
from tests.evaluation.rows import row as usual_row


def row(setting: str, task: str, metric: str, value: float, **changes: Any) -> Row:
    usual = {"domain": "agent", "omega": "0.6", "setting": setting, "task": task, "metric": metric, "value": value}
    return usual_row(**(usual | changes))


RANDOM = REFERENCE | {"method": "random"}
ROWS = [
    *(row("training", task, "accuracy", value) for task, value in (("a", 0.2), ("b", 0.4))),
    row("own demonstrations", "my way", "accuracy", 0.9),
    row("own demonstrations", "my way", "closed loop success", 0.7),
    row("own demonstrations", "my way", "won against random", 0.6),
    row("new", "their way", "accuracy", 0.5),
    *(row("training", task, "accuracy", 0.1, **RANDOM) for task in "ab"),
    row("own demonstrations", "my way", "accuracy", 0.3, **RANDOM),
]


def cells(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]


def test_own_concepts_come_first_and_settings_are_means_over_tasks() -> None:
    text = plain(summary_table(ROWS, ["my way"]))
    assert text.splitlines()[0].strip() == "agent: FTL-IGM (free), K = 2, omega 0.6"
    assert cells(text)[0] == ["mean ± error over tasks", "accuracy", "closed loop success", "n"]
    assert cells(text)[2:] == [
        ["my way", "0.90", "0.70", "50"],
        ["- random", "0.30", "", ""],
        ["training", "0.30 ± 0.10", "", "2x50"],
        ["- random", "0.10", "", ""],
        ["new", "0.50", "", "50"],
    ]


def test_the_title_names_no_weighting_where_the_form_of_own_data_is_chosen() -> None:
    """Chosen forms of own data have one component or none, whatever ``model.components`` says."""
    chosen = row("own demonstrations", "my way", "novelty", 0.4, domain="own", form="form chosen")
    assert plain(summary_table([chosen], ["my way"])).splitlines()[0].strip() == "own: FTL-IGM form chosen (free)"
    asked = row("own demonstrations", "my way", "novelty", 0.4, domain="own", form="with adapter")
    assert plain(summary_table([asked], ["my way"])).splitlines()[0].strip().endswith("K = 2, omega 0.6")
    simulated = row("own demonstrations", "my way", "accuracy", 0.4, form="form chosen")
    assert plain(summary_table([simulated], ["my way"])).splitlines()[0].strip().endswith("K = 2, omega 0.6")


def test_a_task_of_a_suite_may_be_ones_own_too() -> None:
    lines = cells(plain(summary_table(ROWS, ["their way", "b"])))[2:]
    own = ["their way (new)", "b (training)", "- random"]
    assert [line[0] for line in lines] == [*own, "training", "- random", "own demonstrations", "- random"]
    assert lines[3] == ["training", "0.20", "", "50"]


def test_a_terminal_of_eighty_columns_holds_it_and_a_pipe_gets_markdown(capsys: pytest.CaptureFixture[str]) -> None:
    table = summary_table(ROWS, ["my way"])
    show(table)
    assert "| training " in capsys.readouterr().out
    file = io.StringIO()
    Console(file=file, width=80, force_terminal=True, color_system=None).print(table)
    assert max(map(len, file.getvalue().splitlines())) <= 80
    assert "0.30 ± 0.10" in file.getvalue()
    assert "nothing was evaluated" in plain(summary_table([]))
