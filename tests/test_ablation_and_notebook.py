"""The ablation and the notebook that shows it, in miniature."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest
import yaml

from ftl_lightning.apps.ablation.plan import Stage, part
from ftl_lightning.apps.ablation.record import read_record
from ftl_lightning.apps.ablation.run import check, known_hashes, planned, settings_of
from ftl_lightning.cli.main import main
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import UserError
from tests.apps.ablation.attempts import nothing_is_run  # noqa: F401
from tests.apps.ablation.raylets import QUICK
from tests.conftest import CONF, ROOT, refused, succeed


def test_cells_are_the_product_of_names_and_grid_and_are_named_by_what_their_configurations_do_not_say() -> None:
    options = {"model.pretrained": "p{seed}/{domain}"}, {"model.components": [1, 2], "model.omega": [1.2, "learned"]}
    cells = list(Stage("invert", "{domain}.yaml", {"domain": ["a", "b"]}, *options).cells(7))
    assert len(cells) == 8
    expected = ["--config=b.yaml", "--model.pretrained=p7/b", "--model.components=1", "--model.omega=learned"]
    assert cells[5].arguments == expected
    assert str(cells[5]) == "invert b, components 1, omega learned, seed 7"
    assert cells[5].folder == "invert_b_components_1_omega_learned_seed_7"
    assert cells[5].command == " ".join(["python -m ftl_lightning invert", *expected])
    stage = Stage("invert", "{method}/{domain}.yaml", {"method": ["bc"], "domain": ["agent"]}, name="flat")
    assert [str(cell) for cell in stage.cells(0)] == ["invert agent, bc, flat, seed 0"]


def test_a_stage_may_add_configurations_to_one_another_and_run_for_some_seeds_alone() -> None:
    (cell,) = Stage("invert", ["{domain}.yaml", "method/language.yaml"], {"domain": ["agent"]}).cells(0)
    assert cell.arguments == ["--config=agent.yaml", "--config=method/language.yaml"]
    assert str(cell) == "invert agent, language, seed 0"
    with pytest.raises(UserError, match="config: expected a configuration file or a list of them, found none"):
        list(Stage("invert", []).cells(0))
    assert [len(list(Stage("invert", "b.yaml", seeds=[0, 2]).cells(seed))) for seed in range(4)] == [1, 0, 1, 0]


def test_every_cell_of_an_ablation_has_a_name_of_its_own() -> None:
    for path in (CONF / "ablation").glob("*.yaml"):
        content = load(path)
        names = [str(cell) for stage in content["stages"] for seed in content["seeds"] for cell in Stage(**stage).cells(seed)]
        assert len(set(names)) == len(names), path.name


PLANS = [path for path in sorted((CONF / "ablation").glob("*.yaml")) if path.stem != "smoke"]


@pytest.mark.parametrize("path", PLANS, ids=lambda path: path.stem)
def test_of_a_committed_plan_nothing_is_to_run(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every inversion is recorded with rows that are in the results, and the first and the last with the settings of today."""
    monkeypatch.chdir(ROOT)
    content = load(path)
    stages = [Stage(**stage) for stage in content["stages"]]
    plan = list(planned(stages, content["seeds"]).values())
    cells = [cell for stage in plan for cell in stage if cell.verb == "invert"]
    record, known = read_record(content["results"]), known_hashes(content["results"])
    assert [cell.name for cell in cells if record[cell.name].config_hash not in known] == []
    for cell in (cells[0], cells[-1]):
        assert record[cell.name].settings == settings_of(cell)


@pytest.mark.notebook
def test_the_notebook_runs_an_ablation_that_skips_what_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content = yaml.safe_load((CONF / "ablation" / "smoke.yaml").read_text())
    fit, inversion = (stage["options"] for stage in content["stages"])
    fit |= {"trainer.max_steps": 10, "data.samples_per_concept": 10, "evaluation.samples": 1, "evaluation.figures": 0}
    inversion |= {"data.steps": 2, "evaluation.samples": 2, "evaluation.steps": 2, "evaluation.figures": 0}
    config = plan("small.yaml", *content["stages"], seeds=[1], results=content["results"])
    monkeypatch.setenv("FTL_ABLATION", config)
    executed = runpy.run_path(str(ROOT / "notebooks" / "execute.py"))["executed"]
    notebook = executed(ROOT / "notebooks" / "object_rearrangement.ipynb", tmp_path)
    tables = [output.get("data", {}).get("text/markdown", "") for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("| paper |" in text for text in tables) == 4
    path = content["results"]
    rows = read_rows(path)
    assert set(rows["seed"]) == {1}
    assert set(rows.loc[rows["K"] > 0, "K"]) == {1, 2}
    succeed("ablate", "--config", config)
    out = capsys.readouterr().out
    assert out.count("in the results already") == 4
    assert out.count("done before") == 1
    assert read_rows(path).equals(rows)


def plan(path: str, *stages: dict[str, Any], **more: object) -> str:
    """A configuration file of an ablation."""
    Path(path).write_text(yaml.safe_dump({"results": "r.csv", "stages": list(stages), **more}))
    return path


@pytest.fixture
def quick(tiny: Path) -> dict[str, Any]:
    """A stage of seconds."""
    return with_options(QUICK, **{"model.pretrained": str(tiny), "evaluation.diversity": True})


def with_options(stage: dict[str, Any], **more: object) -> dict[str, Any]:
    return stage | {"options": stage["options"] | more}


SHIPPED = {"verb": "invert", "config": str(CONF / "object_rearrangement.yaml")}
FAILED = """[1/2, about 0 min left] invert object_rearrangement, steep, seed 0: failed: the loss became nan
  python -m ftl_lightning invert --config={0} --model.omega=1
[2/2, about 0 min left] invert object_rearrangement, omega 1.2, seed 0: 3 rows
"""


@pytest.mark.usefixtures("nothing_is_run")
def test_a_failing_cell_is_told_at_the_end_with_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    steep, other = SHIPPED | {"options": {"model.omega": 1}, "name": "steep"}, SHIPPED | {"grid": {"model.omega": [1.2]}}
    assert main(["ablate", "--config", plan("a.yaml", steep, other)]) == 2
    told = capsys.readouterr()
    assert "1 of 2 cells failed: invert object_rearrangement, steep, seed 0: the loss became nan" in told.err
    assert told.out.startswith(FAILED.format(SHIPPED["config"]))
    assert len(read_rows("r.csv")) == 3


@pytest.mark.slow
def test_a_failing_cell_is_told_at_the_end_and_stops_no_other(quick: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    failing = with_options(quick, **{"model.budget.learning_rate": 1e30, "data.steps": 20})
    config = plan("a.yaml", failing, quick)
    assert main(["ablate", "--config", config]) == 2
    told = capsys.readouterr()
    assert "1 of 2 cells failed" in told.err
    for text in ("[1/2, about", "invert object_rearrangement, seed 0: failed: ", "--model.budget.learning_rate=1e+30"):
        assert text in told.out
    assert told.out.count("python -m ftl_lightning") == 1  # that of the cell that failed
    assert not Path("logs/object_rearrangement/invert_object_rearrangement_seed_0_1/results.csv").is_file()
    assert "the loss became" in told.err
    assert len(read_rows("r.csv")) > 0
    succeed("ablate", "--config", config, "--estimate", "true")
    assert "2 cells: 1 need not be run, 1 to run" in capsys.readouterr().out


DRIVING = {"verb": "invert", "config": f"{CONF}/{{method}}/driving.yaml", "options": {"model.pretrained": "models/{method}"}}
UNKNOWN_SUITE = """evaluation.suites: expected some of training, paper, components, validation, compositions, more \
(domain object_rearrangement), found exam"""
OF_ANOTHER_DOMAIN = (
    "expected a model of driving (diffusion or bc or regression or cvae), found one of object_rearrangement (diffusion)"
)
OF_ANOTHER_VERB = """agent.yaml, pretraining.yaml: expected the configuration of an adaptation (invert), \
found that of a pretraining (fit)"""
CANNOT: list[tuple[dict[str, Any], str]] = [
    (SHIPPED | {"options": {"model.pretrained": "nowhere"}}, "nowhere/config.json: expected a pretrained model"),
    (SHIPPED | {"options": {"evaluation.suites": ["paper", "exam"]}}, UNKNOWN_SUITE),
    (SHIPPED | {"options": {"model.tempo": 3}}, "tempo"),
    (SHIPPED | {"options": {"data.domain": "driving", "evaluation.closed_loop": True}}, OF_ANOTHER_DOMAIN),
    ({"verb": "invert", "config": [str(CONF / "agent.yaml"), "pretraining.yaml"]}, OF_ANOTHER_VERB),
    (
        SHIPPED | {"config": f"{CONF}/in_context/agent.yaml", "options": {"model.pretrained": f"{ROOT}/pretrained/agent"}},
        "expected a model of agent (in-context), found one of agent (diffusion)",
    ),
    (DRIVING | {"each": {"method": ["telepathy"]}}, "telepathy/driving.yaml: expected a configuration file, found nothing"),
    (DRIVING | {"each": {"method": ["telepathy"]}}, "holds ablation, agent.yaml, bc"),
    (DRIVING | {"each": {"method": ["bc"]}}, "models/bc/config.json: expected a pretrained model"),
]
"""Stages of a cell that cannot run, with a part of what is told."""


@pytest.mark.parametrize(("stage", "told"), CANNOT, ids=[told[:50] for _, told in CANNOT])
def test_what_cannot_run_is_told(stage: dict[str, Any], told: str) -> None:
    Path("pretraining.yaml").write_text("model: {class_path: ftl_lightning.methods.ftl_igm.pretraining.PretrainingModule}")
    with pytest.raises(UserError, match=f"1 of 1 cells cannot run, none was started: .*{re.escape(told)}"):
        check(list(Stage(**stage).cells(0)))


def test_what_cannot_run_is_told_before_anything_does(capsys: pytest.CaptureFixture[str]) -> None:
    config = plan("a.yaml", SHIPPED, {"verb": "invert", "config": "telepathy.yaml"})
    refused(capsys, ["ablate", "--config", config], "1 of 2 cells cannot run, none was started: telepathy.yaml: expected a conf")


@pytest.mark.usefixtures("nothing_is_run")
def test_shards_are_parts_of_the_plan(capsys: pytest.CaptureFixture[str]) -> None:
    stage = SHIPPED | {"grid": {"model.omega": [1.0, 1.1, 1.2]}}
    first, second, third = cells = list(Stage(**stage).cells(0))
    assert [part([cells], f"{number}/3") for number in (1, 2, 3)] == [[[first]], [[second]], [[third]]]
    for shard in ("0/3", "4/3", "half"):
        with pytest.raises(UserError, match="shard: expected 'number/shards' such as 3/8"):
            part([cells], shard)
    succeed("ablate", "--config", plan("a.yaml", stage, seeds=[0]), "--shard", "2/3")
    assert set(read_rows("r.csv")["omega"]) == {"1.1"}
    assert "[1/1" in capsys.readouterr().out


@pytest.mark.cluster
def test_a_ray_cluster_of_two_workers_measures_the_same(quick: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray", reason="needs the extra cluster")
    for name, value in {"PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}.items():
        monkeypatch.setenv(name, value)  # workers of the usual niceness starve beside the other tests
    stage = quick | {"grid": {"model.omega": [1.0, 1.2]}}
    succeed("ablate", "--config", plan("a.yaml", stage))
    failing = with_options(quick, **{"model.budget.learning_rate": 1e30, "data.steps": 20})
    config = plan("b.yaml", stage, failing, results="s.csv")
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        assert main(["ablate", "--config", config, "--executor", "ray"]) == 2  # the failing cell is told
    finally:
        ray.shutdown()
    columns = ["method", "form", "variant", "omega", "setting", "task"]
    one, other = (read_rows(name).sort_values(columns, ignore_index=True) for name in ("r.csv", "s.csv"))
    assert one.equals(other)
