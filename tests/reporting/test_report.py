from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.cli.main import main
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.results import Row, append_rows, read_rows, read_study
from ftl_lightning.reporting.comparison import all_methods, comparison_table, short_overview
from ftl_lightning.reporting.figures import accuracy_bars
from ftl_lightning.reporting.report import BEGIN, END, _splice
from ftl_lightning.reporting.table import summarise
from ftl_lightning.reporting.tables import tables
from ftl_lightning.services.errors import UserError
from tests.conftest import ROOT, refused
from tests.evaluation.rows import REFERENCE
from tests.evaluation.rows import row as usual_row

DOMAIN = load_domain("object_rearrangement")


def row(setting: str, task: str, value: float, seed: int = 0, **changes: Any) -> Row:
    usual = {"setting": setting, "task": task, "value": value, "seed": seed, "config_hash": f"c{seed}"}
    return usual_row(**(usual | changes))


@pytest.fixture
def results(tmp_path: Path) -> Path:
    rows = [
        row(setting, task, value, seed)
        for setting, values in (("training composition", (0.8, 1.0)), ("new concept", (0.4, 0.6)))
        for task, value in zip(("one", "two"), values, strict=True)
        for seed in (0, 1)
    ]
    rows += [row("new concept", task, 0.1, method="random scenes", **REFERENCE) for task in ("one", "two")]
    rows += [row("new concept", "one", 0.7, omega="learned", K=1, config_hash="d")]
    append_rows(tmp_path / "r" / "rows.csv", rows)
    return tmp_path / "r"


def test_a_number_tells_error_over_tasks_from_spread_over_seeds(tmp_path: Path) -> None:
    values = (("a", 0, 0.2), ("a", 1, 0.4), ("b", 0, 0.6), ("b", 1, 0.8))
    append_rows(tmp_path / "r.csv", [row("s", task, value, seed) for task, seed, value in values])
    number = summarise(read_rows(tmp_path / "r.csv"))
    assert number.mean == pytest.approx(0.5)
    assert number.error == pytest.approx(0.2)  # task means 0.3 and 0.7
    assert number.spread == pytest.approx(0.2 / 2**0.5)  # seed means 0.4 and 0.6
    assert str(number) == "0.50 ± 0.20 (seeds 0.14)"


def test_a_figure_names_everything_once_and_shows_the_papers_number_of_two_components(tmp_path: Path) -> None:
    driving = {"domain": "driving", "omega": "learned", "metric": "closed loop success (step veto)"}
    places = (("training concept", "steps"), ("new initial state", "steps"), ("new initial state", "map"))
    rows = [row(setting, "a", 0.5, variant=variant, **driving) for setting, variant in places]
    append_rows(tmp_path / "r.csv", rows)
    trained, new = accuracy_bars(load_domain("driving"), read_rows(tmp_path / "r.csv"), driving["metric"]).axes
    assert [label.get_text() for label in trained.get_yticklabels()] == ["FTL-IGM (steps)"]
    assert [label.get_text() for label in new.get_yticklabels()] == ["paper", "FTL-IGM (map)", "FTL-IGM (steps)"]
    widths = {bars.get_label(): [bar.get_width() for bar in bars] for bars in new.containers if hasattr(bars, "patches")}
    assert widths["paper"] == [0.24]


def test_tables_stand_beside_the_papers_numbers(results: Path) -> None:
    found = {table.name: table for table in tables(DOMAIN, read_rows(results))}
    accuracy = found["accuracy"].cells.set_index("setting")
    assert accuracy.loc["training composition", "method"] == "FTL-IGM (free)"
    assert accuracy.loc["training composition", "paper"] == "0.90 ± 0.04"
    assert accuracy.loc["training composition", "measured"].startswith("0.90 ± 0.10")
    references = found["accuracy_references"].cells
    assert references.to_numpy().tolist() == [["new concept", "random scenes", "0.10 ± 0.00"]]
    count = found["concept_count"].cells
    assert count[["setting", "K", "paper"]].to_numpy().tolist() == [["new concept", "1", "0.49 ± 0.11"]]
    assert "omega" in found
    assert r"\toprule" in found["accuracy"].latex()
    assert r"\pm" in found["accuracy"].latex()
    assert "±" not in found["accuracy"].latex()


def test_the_report_writes_files_and_updates_a_readme(results: Path) -> None:
    changes = [row("new concept", "one", value, variant=name) for name, value in (("ours", 0.9), ("flat", 0.2))]
    append_rows(results / "changes.csv", changes)
    readme, folder = Path("README.md"), Path("out") / DOMAIN.name
    readme.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    options = [f"--results={results}", "--out=out", f"--readme={readme}"]
    assert main(["report", *options]) == 0
    text = readme.read_text()
    assert text.startswith("before\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    assert "| training composition | FTL-IGM (free) | 0.90 ± 0.10 (seeds 0.00) | 0.90 ± 0.04 | +0.00 |" in text
    assert {path.name for path in folder.iterdir()} >= {"accuracy.md", "accuracy.tex", "accuracy.png"}
    # What each change is worth has a table to itself, in the order of its rows.
    found = (folder / "changes.md").read_text()
    assert found.index("| ours | 0.90 |") < found.index("| flat | 0.20 |")
    assert "ours" not in (folder / "accuracy.md").read_text()


def test_a_file_to_update_that_is_missing_or_has_no_marks_is_told(capsys: pytest.CaptureFixture[str], results: Path) -> None:
    told = refused(capsys, ["report", f"--results={results}", "--out=report", "--readme=missing.md"])
    assert told == "error: missing.md: expected a Markdown file, found nothing\n"
    Path("README.md").write_text("no marks")
    with pytest.raises(UserError, match=r"^README\.md: expected the lines "):
        _splice(Path("README.md"), "")


@pytest.mark.slow
def test_the_readmes_table_is_what_the_committed_results_say() -> None:
    """What ``--readme`` writes, without the files of the whole report; that these are as committed is a test of outputs."""
    beside = all_methods(read_study(ROOT / "results", "comparison"), read_study(ROOT / "results"))
    copy = Path("README.md")
    copy.write_text((ROOT / "README.md").read_text())
    _splice(copy, short_overview(beside).markdown())
    assert copy.read_text() == (ROOT / "README.md").read_text()


def test_the_main_table_shows_what_there_is_and_says_how_it_was_learned(tmp_path: Path) -> None:
    append_rows(tmp_path / "r.csv", [row("new concept", "one", 0.7, omega="learned", K=1)])
    table = tables(DOMAIN, read_rows(tmp_path / "r.csv"))[0]
    assert table.caption.startswith("object_rearrangement: accuracy, K = 1, learned weights. ")
    assert table.cells["measured"].tolist() == ["0.70"]
    # Beside the usual ones, others say in brackets how they were learned.
    append_rows(tmp_path / "r.csv", [row("training composition", "one", 0.8), row("training composition", "one", 0.1, omega="1.4")])
    table = tables(DOMAIN, read_rows(tmp_path / "r.csv"))[0]
    assert table.caption.startswith("object_rearrangement: accuracy, K = 2, fixed omega 1.2. ")
    assert table.cells["measured"].tolist() == ["0.80", "0.70 (K = 1, learned weights)"]


def test_paired_episodes_have_a_line_for_each_policy_in_each_environment(tmp_path: Path) -> None:
    driving = load_domain("driving")
    shares = {"": (0.2, 0.1), " (step veto)": (0.0, 0.4)}
    rows = [
        row("new initial state", "roundabout", value, domain="driving", omega="learned", metric=f"{outcome} against FASTER{place}")
        for place, found in shares.items()
        for outcome, value in zip(("won", "lost"), found, strict=True)
    ]
    append_rows(tmp_path / "r.csv", rows)
    cells = next(table.cells for table in tables(driving, read_rows(tmp_path / "r.csv")) if table.name == "paired")
    assert cells["compared with"].tolist() == ["FASTER", "FASTER (step veto)"]
    assert set(cells["method"]) == {"FTL-IGM (free)"}
    assert [cell.split(" ")[0] for cell in cells["difference"]] == ["+0.10", "-0.40"]
    unpublished = replace(driving, comparison=replace(driving.comparison, paper=None))
    cells = next(table.cells for table in tables(unpublished, read_rows(tmp_path / "r.csv")) if table.name == "paired")
    assert [cell.split(" ")[0] for cell in cells["difference"]] == ["+0.10", "-0.40"]


def test_settings_of_ones_own_come_last_and_components_apart(tmp_path: Path) -> None:
    named = ("component 1", "own demonstrations", "another", "new concept", "training concept")
    append_rows(tmp_path / "r.csv", [row(setting, "one", 0.5) for setting in named])
    table = tables(DOMAIN, read_rows(tmp_path / "r.csv"))[0]
    assert table.cells["setting"].tolist() == ["training concept", "new concept", "own demonstrations", "another"]


def test_a_domain_without_a_paper_and_its_suites_has_tables_without_the_papers_columns(tmp_path: Path) -> None:
    concepts = replace(DOMAIN.concepts, suites={"mine": DOMAIN.concepts.suites["validation"]})
    alone = replace(DOMAIN, comparison=replace(DOMAIN.comparison, paper=None), concepts=concepts)
    rows = [row(setting, task, 0.5, K=K) for setting in ("mine", "new concept") for task in "ab" for K in (1, 2)]
    rows += [row("mine", "a", 0.1, method="random scenes", **REFERENCE)]
    append_rows(tmp_path / "r.csv", rows)
    results = read_rows(tmp_path / "r.csv")
    found = {table.name: table.cells for table in tables(alone, results)}
    assert found["accuracy"].columns.tolist() == ["setting", "method", "measured"]
    assert found["accuracy"]["setting"].tolist() == ["mine", "new concept"]
    assert found["omega"].columns.tolist() == ["setting", "omega", "metric", "method", "measured"]
    compared = comparison_table(alone, results).cells.columns.tolist()
    assert compared == ["setting", "metric", "method", "ours is", "measured", "spread over seeds"]
    titles = [axes.get_title(loc="left").replace("\n", " ").split(": ")[-1] for axes in accuracy_bars(alone, results).axes]
    assert titles == ["mine", "new concept"]


def test_captions_name_no_weighting_of_a_method_that_has_none_in_a_domain_without_a_paper(tmp_path: Path) -> None:
    alone = replace(DOMAIN, comparison=replace(DOMAIN.comparison, paper=None))
    metrics = ("accuracy", "closed loop success")
    append_rows(tmp_path / "r.csv", [row("mine", "a", 0.5, method="BC", K=0, omega="none", metric=name) for name in metrics])
    results = read_rows(tmp_path / "r.csv")
    captions = {table.name: table.caption for table in tables(alone, results)}
    assert captions["accuracy"].startswith("object_rearrangement: accuracy. Mean ")
    assert captions["outcomes"] == "object_rearrangement: what happened in closed loop"
    assert "omega" not in accuracy_bars(alone, results).axes[0].get_title(loc="left")


def test_own_data_have_captions_without_a_weighting_and_no_report_where_no_table_shows_their_metrics(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    own = {"domain": "own", "form": "form chosen"}
    chosen = [row("own demonstrations", "a", 0.9, metric=name, **own) for name in ("recognised", "novelty")]
    append_rows(tmp_path / "both.csv", chosen)
    assert main(["report", f"--results={tmp_path / 'both.csv'}", "--out=both"]) == 0
    assert (Path("both") / "own" / "accuracy.md").read_text().startswith("**own: recognised. Mean ")
    capsys.readouterr()
    append_rows(tmp_path / "novelty.csv", chosen[1:])
    told = refused(capsys, ["report", f"--results={tmp_path / 'novelty.csv'}", "--out=none"])
    assert told.endswith("novelty.csv: expected a metric that tables show, found novelty alone\n")
    assert not Path("none").exists()


def test_every_published_number_belongs_to_a_task_or_setting() -> None:
    tasks = {(task.setting, task.name) for suite in DOMAIN.concepts.suites.values() for task in suite.tasks}
    for published in DOMAIN.comparison.paper.numbers:
        assert published.setting in {setting for setting, _ in tasks}
        assert not published.task or (published.setting, published.task) in tasks
        assert 0 <= published.value <= 1


def test_what_a_killed_process_left_is_no_result_and_models_of_the_papers_size_stand_apart(tmp_path: Path) -> None:
    append_rows(tmp_path / "r.csv", [row("new concept", "one", 1.0)])
    whole = (tmp_path / "r.csv").read_text()
    (tmp_path / ".r.csv.abcd.csv").write_text(whole)
    (tmp_path / ".r.csv.efgh.csv").write_text(whole[:70])
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "r-checkpoint.csv").write_text(whole)
    assert len(read_rows(tmp_path)) == len(read_study(tmp_path)) == 1
    append_rows(tmp_path / "paper_size.csv", [row("new concept", "one", 0.5)])
    assert read_study(tmp_path)["value"].tolist() == [1.0]
    assert read_study(tmp_path, "paper_size")["value"].tolist() == [0.5]
