import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
import pytest
import torch
from matplotlib.text import Text

from ftl_lightning.cli.main import main
from ftl_lightning.domains.comparison import Compared
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.results import Row, append_rows, read_rows, read_study
from ftl_lightning.igm.concept import Concept, Origin
from ftl_lightning.reporting.comparison import (
    LINES,
    all_methods,
    comparison_table,
    overview,
    overview_tables,
    references_table,
    short_overview,
)
from ftl_lightning.reporting.concept_figures import concept_map
from ftl_lightning.reporting.figures import COLOURS, OF_METHODS, colours, comparison_bars, growth, overview_dots
from ftl_lightning.reporting.report import BEGIN, END
from ftl_lightning.reporting.table import MOST_COLUMNS, Table, select
from ftl_lightning.reporting.tables import changes_table, curves_table, tables
from ftl_lightning.training.model_folder import load_model
from tests.conftest import ROOT
from tests.evaluation.rows import REFERENCE
from tests.evaluation.rows import row as usual_row

DOMAIN = load_domain("object_rearrangement")
METHODS = {"FTL-IGM": (0.9, 0.7), "BC": (0.8, 0.2), "CVAE": (0.1, 0.1), "language": (0.3, 0.1)}


def row(method: str, task: str, value: float, **changes: Any) -> Row:
    variant = "" if method == "language" else "free"
    usual = {"method": method, "task": task, "value": value, "variant": variant, "K": 1, "omega": "1.0", "config_hash": method}
    return usual_row(**(usual | changes))


@pytest.fixture
def results(tmp_path: Path) -> Path:
    rows = [row(method, task, value) for method, values in METHODS.items() for task, value in zip("ab", values, strict=True)]
    rows += [row("random scenes", task, 0.15, **REFERENCE) for task in "ab"]
    append_rows(tmp_path / "r" / "comparison.csv", rows)
    grown = [row("FTL-IGM", "a", 0.1 * count, K=2, omega="1.2", demonstrations=count) for count in (1, 2, 5)]
    wider = [row("FTL-IGM", "a", value, K=K, omega="learned") for K, value in ((2, 0.5), (4, 0.7))]
    few = row("FTL-IGM", "b", 0.0, K=2, omega="1.2", n=5)  # starts where the demonstrations did
    append_rows(tmp_path / "r" / "curves.csv", [*grown, *wider, few])
    return tmp_path / "r"


@pytest.fixture(scope="module")
def committed() -> pd.DataFrame:
    """What the repository's results say of all methods."""
    return all_methods(read_study(ROOT / "results", "comparison"), read_study(ROOT / "results"))


@pytest.fixture(scope="module")
def whole(committed: pd.DataFrame) -> Table:
    """The overview of them, in which hundreds of cells are compared."""
    return overview(committed)


def test_every_number_stands_beside_the_papers_with_their_difference(results: Path) -> None:
    table = comparison_table(DOMAIN, read_study(results, "comparison")).cells.set_index("method")
    assert list(table.index) == ["FTL-IGM", "BC", "CVAE", "language"]
    told = ["new concept", "accuracy", "+0.30, undecided (2 tasks)", "0.50 ± 0.30", "-", "0.67 ± 0.15", "-0.17"]
    assert table.loc["BC"].tolist() == told
    assert list(table.columns[:3]) == ["setting", "metric", "ours is"]  # the verdict is right beside the method
    references = references_table(DOMAIN, read_study(results, "comparison")).cells
    assert references.to_numpy().tolist() == [["new concept", "accuracy", "random scenes", "0.15 ± 0.00", "-"]]
    assert table.loc["FTL-IGM", ["paper", "difference"]].tolist() == ["0.82 ± 0.09", "-0.02"]


def test_the_overview_fits_on_one_screen_and_names_the_best_baseline(results: Path) -> None:
    cells = overview(read_study(results, "comparison")).cells
    assert len(cells) == 1
    line = cells.iloc[0]
    assert line["FTL-IGM"] == "0.80 ± 0.10 [0.82]"
    assert "in-context" not in cells
    assert line["lead"] == "+0.30 against BC, undecided (2 tasks)"
    short = short_overview(read_study(results, "comparison")).cells.iloc[0]
    assert short["FTL-IGM"] == line["FTL-IGM"]
    assert short["lead"] == "+0.30, undecided (2 tasks)"  # against the best baseline, which has a column
    assert short["best pretrained baseline"].startswith("BC 0.50")
    assert short["best without pretraining; oracle"] == "random scenes 0.15"
    *_, references = overview_tables(read_study(results, "comparison"))
    assert references.cells["references"].tolist() == ["random scenes 0.15"]


@pytest.mark.slow
def test_the_short_overview_has_all_domains_with_the_best_baseline_and_reference(committed: pd.DataFrame) -> None:
    cells = short_overview(committed).cells.set_index("domain: setting, metric")
    assert len(cells) == LINES
    names = [subject.partition(":")[0] for subject in cells.index]
    assert list(dict.fromkeys(names)) == ["navigation", "driving", "motion", "rearrangement", "tabletop"]
    push = cells.loc["tabletop: new concept, closed loop success"]
    assert push["best without pretraining; oracle"] == "straight push 0.98, expert (oracle) 1.00"
    assert push["best pretrained baseline"].startswith("LoRA fine-tuning 0.96")


def test_domains_whose_methods_were_all_measured_in_their_ablation_are_compared_too(committed: pd.DataFrame) -> None:
    assert "tabletop_wide" not in set(committed["domain"])  # no baseline was measured there
    learned = select(committed, domain="tabletop", role="method", setting="new concept")
    assert set(learned["demonstrations"]) == {10}  # and not from fewer
    assert set(learned.loc[learned["method"] == "FTL-IGM", "K"]) == {1, 2}  # with an adapter, and in the paper's form
    assert set(learned.loc[(learned["method"] == "FTL-IGM") & (learned["form"] == ""), "K"]) == {2}


@pytest.mark.slow
def test_the_overview_takes_in_domains_whose_methods_were_all_measured_in_their_ablation(whole: Table) -> None:
    assert "networks, representations, most losses and some guidance weights are not the paper's" in whole.caption
    lines = whole.cells.set_index(whole.cells.columns[0])
    pushed = lines.loc["tabletop: new concept, closed loop success"]
    kept = select(read_study(ROOT / "results"), domain="tabletop", setting="new concept", metric="closed loop success")
    tuned = select(kept, method="LoRA fine-tuning")["value"].mean()
    assert pushed["LoRA fine-tuning"] == f"{tuned:.2f}"
    assert "[" not in pushed["FTL-IGM"]  # the paper's number is a robot's
    moved = lines.loc["motion: new concept, rule"]
    assert moved["lead"].startswith("with modes, with knots, with adapter: ")
    assert re.search(r"with modes, with knots \d.*with knots, form chosen \d", moved["FTL-IGM"])


def expect_narrow(rows: pd.DataFrame, whole: Table) -> list[Table]:
    """The overview's tables, which are narrow and together say what it says."""
    first, *methods, _ = found = overview_tables(rows)
    for table in found:
        assert len(table.cells.columns) <= MOST_COLUMNS
        assert table.cells.iloc[:, 0].tolist() == whole.cells.iloc[:, 0].tolist()
    beside_each_other = pd.concat([first.cells, *(table.cells.iloc[:, 1:] for table in methods)], axis=1)
    assert set(whole.cells.columns) == set(beside_each_other.columns)
    return found


@pytest.mark.slow
def test_tables_of_the_overview_are_narrow_and_together_say_what_it_says(committed: pd.DataFrame, whole: Table) -> None:
    expect_narrow(committed, whole)


def test_many_methods_take_several_tables(results: Path) -> None:
    few = read_study(results, "comparison")
    many = pd.concat([few, *(select(few, method="BC").assign(method=f"mine {count}") for count in range(9))])
    found = expect_narrow(many, overview(many))
    assert max(len(table.cells.columns) for table in found) == MOST_COLUMNS
    assert {table.name for table in found} >= {"overview_methods", "overview_methods_2"}


def test_a_method_of_ones_own_stands_beside_the_others(results: Path) -> None:
    append_rows(results / "comparison.csv", [row("mine", task, 1.0, variant="") for task in "ab"])
    rows = read_study(results, "comparison")
    cells = overview(rows).cells
    assert list(cells.columns[2:]) == ["FTL-IGM", "BC", "CVAE", "language", "mine"]
    assert cells.iloc[0]["lead"] == "-0.20 against mine, undecided (2 tasks)"
    assert "mine" in comparison_table(DOMAIN, rows).cells["method"].tolist()


def test_forms_of_another_method_share_its_column(results: Path) -> None:
    mine = [row("MY-METHOD", task, value, form=form) for form, value in (("", 0.1), ("with prompts", 1.0)) for task in "ab"]
    append_rows(results / "comparison.csv", mine)
    append_rows(results / "own.csv", mine)
    rows = read_study(results, "comparison")
    cells = overview(rows).cells
    assert list(cells.columns[5:]) == ["language", "MY-METHOD"]
    assert cells.iloc[0]["MY-METHOD"] == "0.10 ± 0.00, with prompts 1.00 ± 0.00"
    assert cells.iloc[0]["lead"] == "-0.20 against MY-METHOD with prompts, undecided (2 tasks)"
    told = comparison_table(DOMAIN, rows).cells.set_index("method")["measured"]
    assert told[["MY-METHOD", "MY-METHOD with prompts"]].tolist() == ["0.10 ± 0.00", "1.00 ± 0.00"]
    accuracy = next(table.cells for table in tables(DOMAIN, read_study(results)) if table.name == "accuracy")
    assert set(accuracy["method"]) == {"MY-METHOD (free)", "MY-METHOD with prompts (free)"}
    labels = [label.get_text() for label in comparison_bars(DOMAIN, rows).axes[0].get_yticklabels()]
    assert {"MY-METHOD", "MY-METHOD with prompts"} < set(labels)


def test_a_form_of_ours_is_no_baseline_and_others_are_compared_with_the_domains_own(results: Path) -> None:
    append_rows(results / "comparison.csv", [row("FTL-IGM", task, 1.0, form="with modes") for task in "ab"])
    rows = read_study(results, "comparison")
    line = overview(rows).cells.iloc[0]
    assert line["FTL-IGM"].endswith(", with modes 1.00 ± 0.00")  # the paper has no number of it
    assert line["lead"] == "+0.30 against BC, undecided (2 tasks)"
    by_modes = replace(DOMAIN, comparison=replace(DOMAIN.comparison, ours=Compared("FTL-IGM", "with modes")))
    told = comparison_table(by_modes, rows).cells.set_index("method")["ours is"]
    assert told[["FTL-IGM", "FTL-IGM with modes", "BC"]].tolist() == ["-", "-", "+0.50, undecided (2 tasks)"]


def test_the_overview_says_who_is_ahead_by_the_paired_test(results: Path) -> None:
    # Eight tasks and three baselines: all signs agree against each of them, p = 3 * 2 / 2^8.
    levels = {"FTL-IGM": 0.9, "BC": 0.5, "CVAE": 0.6, "language": 0.1}
    append_rows(results / "comparison.csv", [row(name, task, value) for name, value in levels.items() for task in "abcdefgh"])
    line = overview(read_study(results, "comparison")).cells.iloc[0]
    assert line["lead"] == "+0.30 [+0.30, +0.30] against CVAE, ahead (p = .024)"


def test_where_a_policy_of_no_learning_ends_as_ours_does_the_overview_says_in_how_many_episodes(tmp_path: Path) -> None:
    driving = {"domain": "driving", "setting": "new initial state", "task": "roundabout"}
    strict = {**driving, "metric": "closed loop strict success"}
    rows = [row("FTL-IGM", seed=seed, value=0.5, **strict) for seed in (0, 1)]
    for policy, lost in (("FASTER", 0.02), ("IDLE", 0.5)):
        rows += [row(policy, seed=seed, value=0.4, **REFERENCE, **strict) for seed in (0, 1)]
        for seed in (0, 1):
            rows += [row("FTL-IGM", seed=seed, value=0.0, **(driving | {"metric": f"won against {policy}"}))]
            rows += [row("FTL-IGM", seed=seed, value=lost * seed, **(driving | {"metric": f"lost against {policy}"}))]
    append_rows(tmp_path / "comparison.csv", rows)
    beside = read_study(tmp_path, "comparison")
    *_, references = overview_tables(beside)
    assert references.cells["references"].tolist() == ["FASTER 0.40 (same outcome in 99 of 100), IDLE 0.40"]
    assert overview(beside).cells.iloc[0]["lead"] == "-"


def test_figures_show_measured_bars_and_the_papers_diamonds(results: Path) -> None:
    axes = comparison_bars(DOMAIN, read_study(results, "comparison")).axes[0]
    bars = {c.get_label(): [bar.get_width() for bar in c] for c in axes.containers if hasattr(c, "patches")}
    assert bars["BC"] == [pytest.approx(0.5)]
    assert sorted(line.get_xdata()[0] for line in axes.lines if line.get_marker() == "D") == [0.08, 0.20, 0.67, 0.82]
    left, right = growth(DOMAIN, read_study(results, "curves")).axes
    assert left.containers[0].lines[0].get_ydata().tolist() == pytest.approx([0.1, 0.2, 0.5])
    assert right.containers[0].lines[0].get_xdata().tolist() == [2, 4]
    plt.close("all")


def test_curves_keep_the_other_axis_as_usual(results: Path) -> None:
    cells = curves_table(DOMAIN, read_study(results, "curves")).cells.set_index("of")
    assert cells.loc["demonstrations", ["1", "2", "4", "5"]].tolist() == ["0.10", "0.20", "-", "0.50"]
    assert cells.loc["K", ["1", "2", "4", "5"]].tolist() == ["-", "0.50", "0.70", "-"]


def test_curves_are_of_the_headline_where_it_was_measured(tmp_path: Path) -> None:
    driven = {"domain": "driving", "setting": "new initial state", "task": "roundabout", "K": 2, "omega": "learned"}
    rows = [
        row("FTL-IGM", value=value, metric=metric, demonstrations=count, config_hash=f"{count}", **driven)
        for count in (1, 5)
        for metric, value in (("closed loop success", 0.9), ("closed loop strict success", count / 10))
    ]
    append_rows(tmp_path / "curves.csv", rows)
    table = curves_table(load_domain("driving"), read_study(tmp_path, "curves"))
    assert table.cells.set_index("of").loc["demonstrations", ["1", "5"]].tolist() == ["0.10", "0.50"]
    assert table.caption.startswith("driving: closed loop strict success by demonstrations (K = 2, omega learned)")


def test_what_does_not_grow_is_what_most_points_were_measured_with(tmp_path: Path) -> None:
    pushed = {"domain": "tabletop", "setting": "new concept", "task": "push", "metric": "closed loop success", "omega": "1.0"}
    for count, shown, value in ((1, 1, 0.1), (1, 10, 0.5), (2, 10, 0.6), (3, 10, 0.7)):
        grown = row("FTL-IGM", value=value, K=count, demonstrations=shown, config_hash=f"{count} {shown}", **pushed)
        append_rows(tmp_path / "curves.csv", [grown])
    found = curves_table(load_domain("tabletop"), read_study(tmp_path, "curves")).cells.set_index("of")
    assert found.loc["demonstrations", ["1", "10"]].tolist() == ["0.10", "0.50"]
    assert found.loc["K", ["1", "2", "3"]].tolist() == ["0.50", "0.60", "0.70"]


def test_changes_stand_in_their_order_with_the_headline_if_it_was_measured(tmp_path: Path) -> None:
    told = [("ours", 0.9), ("noise is predicted", 0.4), ("flat", 0.5)]
    rows = [row("FTL-IGM", task, value + shift, variant=name) for name, value in told for task, shift in (("a", 0.0), ("b", 0.02))]
    append_rows(tmp_path / "changes.csv", [*rows, row("expert (oracle)", "a", 1.0, **REFERENCE)])
    found = changes_table(DOMAIN, read_study(tmp_path, "changes")).cells
    assert found["variant"].tolist() == [name for name, _ in told]
    assert found["new concept"].tolist() == ["0.91 ± 0.01", "0.41 ± 0.01", "0.51 ± 0.01"]
    assert read_study(tmp_path).empty  # not among ablations
    driven = [replace(one, domain="driving", metric=name) for one in rows[:1] for name in ("closed loop success", "crash")]
    append_rows(tmp_path / "changes.csv", [*driven, replace(driven[0], metric="closed loop strict success", value=0.1)])
    driving = load_domain("driving")
    assert changes_table(driving, read_study(tmp_path, "changes")).cells["new concept"].tolist() == ["0.10"]


@pytest.mark.slow
def test_ablations_comparison_and_curves_are_not_mixed(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    append_rows(results / "own.csv", [row("FTL-IGM", "a", 0.33, K=2, omega="1.2")])
    assert set(read_study(results)["value"]) == {0.33}
    assert len(read_study(results, "comparison")) == 10
    assert len(read_rows(results)) == 17
    assert read_study(results, "nothing").empty
    Path("README.md").write_text(f"{BEGIN}\n{END}")
    assert main(["report", f"--results={results}", "--out=out", "--readme=README.md"]) == 0
    short = short_overview(all_methods(read_study(results, "comparison"), read_study(results))).markdown()
    assert Path("README.md").read_text() == f"{BEGIN}\n{short}{END}"
    written = {path.name for path in Path("out").rglob("*")}
    assert written >= {f"{name}.md" for name in ("overview", "comparison", "curves", "accuracy")}
    assert written >= {"comparison.tex", "comparison_accuracy.png", "curves.png"}
    assert "0.33" in (Path("out") / DOMAIN.name / "accuracy.md").read_text()


def test_the_map_of_concepts_names_them_all() -> None:
    model = load_model(ROOT / "pretrained" / "agent")
    origin = Origin("go to green cone", "agent", "e", "p", "d", 5, "fixed", 0.1)
    concept = Concept(torch.randn(2, 1, model.config.concept_dim), torch.ones(2), origin)
    texts = {text.get_text() for text in concept_map(model, [concept]).axes[0].texts}
    assert texts == {*model.config.training_concepts, "go to green cone [1]", "go to green cone [2]"}


def test_the_papers_numbers_of_driving_stand_beside_the_same_planner_alone() -> None:
    driving = load_domain("driving")
    committed = read_study(ROOT / "results", "comparison")
    cells = comparison_table(driving, committed).cells
    ours = cells[cells["method"] == "FTL-IGM"].set_index("metric")
    papers = {"success": "-", "crash": "-", "strict success": "-", "success (step veto)": "0.24", "crash (step veto)": "0.32"}
    assert ours["paper"].to_dict() == {f"closed loop {name}": value for name, value in papers.items()}
    # Fewer crashes are better, with every planner: the CVAE crashes less than ours with the paper's.
    theirs = cells[cells["method"] == "CVAE"].set_index("metric")
    crash = "closed loop crash (step veto)"
    assert float(ours.loc[crash, "measured"]) > float(theirs.loc[crash, "measured"])
    assert theirs.loc[crash, "ours is"].startswith("-0.")


@pytest.mark.slow
def test_the_overviews_figure_has_a_panel_for_each_domain_and_diamonds_where_settings_are_the_same(committed: pd.DataFrame) -> None:
    panels = {axes.get_title(loc="left"): axes for axes in overview_dots(committed).get_axes()}
    assert set(panels) == {"agent", "driving", "mocap", "object_rearrangement", "tabletop"}
    diamonds = {
        name: sorted(round(float(line.get_xdata()[0]), 2) for line in axes.lines if line.get_marker() == "D")  # type: ignore[arg-type]
        for name, axes in panels.items()
    }
    assert diamonds["driving"] == diamonds["mocap"] == diamonds["tabletop"] == []
    assert diamonds["object_rearrangement"] == [0.08, 0.13, 0.2, 0.2, 0.67, 0.8, 0.82, 0.9]
    texts = [text.get_text() for text in panels["driving"].texts]
    assert texts == [
        f"{setting}, closed loop strict success" for setting in ("training concept", "new initial state", "new scenario")
    ]
    plt.close("all")


NARROW, LEAST = 358, 12  # pixels of a figure's width on a phone, and of its text


def test_text_of_figures_is_readable_on_a_phone_and_nothing_is_cut_off(committed: pd.DataFrame) -> None:
    rows = committed[committed["domain"] == "agent"]
    for figure in (overview_dots(rows), comparison_bars(load_domain("agent"), rows, "closed loop success")):
        figure.draw_without_rendering()
        for text in (text for text in figure.findobj(Text) if text.get_text()):
            assert text.get_fontsize() / 72 / figure.get_figwidth() * NARROW >= LEAST, text.get_text()
        drawn = figure.get_tightbbox()  # in inches
        assert -0.02 < drawn.x0 < drawn.x1 < figure.get_figwidth() + 0.02


def test_every_method_has_a_colour_of_its_own_in_all_figures() -> None:
    named = [(" ".join(method), method) for method in OF_METHODS if "form chosen" not in method.form]
    found = colours(named)
    assert len(set(found.values())) == len(named)
    assert colours(reversed(named)) == found
    two = colours([("one", Compared("BC")), ("two", Compared("BC")), ("mine", Compared("MINE"))])
    assert two["one"] == OF_METHODS[Compared("BC")]
    assert len(set(two.values())) == 3
    many = colours([(str(count), Compared("MINE", str(count))) for count in range(2 * len(COLOURS))])
    assert set(many.values()) == set(COLOURS)
