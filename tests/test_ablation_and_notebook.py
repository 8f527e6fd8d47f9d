"""The ablation and the notebook that shows it, in miniature."""

import runpy
from pathlib import Path

import pytest
import yaml

from ftl_lightning.ablation import Stage
from ftl_lightning.cli import main
from ftl_lightning.configuration import load
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.results import read_rows
from tests.conftest import CONF, ROOT


def test_cells_are_the_product_of_names_and_grid() -> None:
    stage = Stage(
        "invert",
        "{domain}.yaml",
        {"domain": ["a", "b"]},
        {"model.pretrained": "p{seed}/{domain}"},
        {"model.components": [1, 2], "model.omega": [1.2, "learned"]},
    )
    cells = list(stage.cells(7))
    assert len(cells) == 8
    expected = ["--config=b.yaml", "--model.pretrained=p7/b", "--model.components=1", "--model.omega=learned"]
    assert cells[5].arguments == expected
    assert str(cells[5]) == "invert b, components 1, omega learned, seed 7"
    assert cells[5].folder == "invert_b_components_1_omega_learned_seed_7"
    assert cells[5].command == " ".join(["python -m ftl_lightning invert", *expected])


def test_a_cell_is_named_by_what_its_configuration_does_not_say() -> None:
    stage = Stage("invert", "{method}/{domain}.yaml", {"method": ["bc"], "domain": ["agent"]}, name="flat")
    assert [str(cell) for cell in stage.cells(0)] == ["invert agent, bc, flat, seed 0"]


def test_a_stage_may_add_configurations_to_one_another() -> None:
    stage = Stage("invert", ["{domain}.yaml", "method/language.yaml"], {"domain": ["agent"]})
    (cell,) = stage.cells(0)
    assert cell.arguments == ["--config=agent.yaml", "--config=method/language.yaml"]
    assert str(cell) == "invert agent, language, seed 0"
    with pytest.raises(UserError, match="config: expected a configuration file or a list of them, found none"):
        list(Stage("invert", []).cells(0))


def test_a_stage_may_run_for_some_seeds_alone() -> None:
    stage = Stage("invert", "b.yaml", seeds=[0, 2])
    assert [len(list(stage.cells(seed))) for seed in range(4)] == [1, 0, 1, 0]


@pytest.mark.parametrize("path", sorted((CONF / "ablation").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_cell_of_an_ablation_has_a_name_of_its_own(path: Path) -> None:
    plan = load(path)
    names = [str(cell) for stage in plan["stages"] for seed in plan["seeds"] for cell in Stage(**stage).cells(seed)]
    assert len(set(names)) == len(names)


def test_the_notebook_runs_an_ablation_that_skips_what_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = "conf/ablation/smoke.yaml"
    monkeypatch.setenv("FTL_ABLATION", config)
    executed = runpy.run_path(str(ROOT / "notebooks" / "execute.py"))["executed"]
    notebook = executed(ROOT / "notebooks" / "object_rearrangement.ipynb", tmp_path)
    tables = [output.get("data", {}).get("text/markdown", "") for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("| paper |" in text for text in tables) == 4
    path = yaml.safe_load((CONF / "ablation" / "smoke.yaml").read_text())["results"]
    rows = read_rows(path)
    assert set(rows["seed"]) == {0, 1}
    assert set(rows.loc[rows["K"] > 0, "K"]) == {1, 2}
    rows.drop(columns="form").to_csv(path, index=False)  # as older files are
    assert main(["ablate", "--config", config]) == 0
    out = capsys.readouterr().out
    assert out.count("in the results already") == 8
    assert out.count("done before") == 2
    assert read_rows(path).equals(rows)


def plan(path: str, *stages: dict[str, object], **more: object) -> str:
    """A configuration file of an ablation."""
    Path(path).write_text(yaml.safe_dump({"results": "r.csv", "stages": list(stages), **more}))
    return path


@pytest.fixture
def quick(tiny: Path) -> dict[str, object]:
    """A stage of seconds."""
    options = {
        "model.pretrained": str(tiny),
        "data.steps": 2,
        "model.budget.samples": 2,
        "evaluation.samples": 2,
        "evaluation.steps": 2,
        "evaluation.figures": 0,
        "evaluation.suites": ["paper"],
        "trainer.enable_progress_bar": False,
        "trainer.accelerator": "cpu",
        "trainer.logger.init_args.version": None,
    }
    return {"verb": "invert", "config": str(CONF / "object_rearrangement.yaml"), "options": options}


def with_options(stage: dict[str, object], **more: object) -> dict[str, object]:
    return stage | {"options": stage["options"] | more}  # type: ignore[operator]


def test_a_failing_cell_is_told_at_the_end_and_stops_no_other(quick: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    failing = with_options(quick, **{"model.budget.learning_rate": 1e30, "data.steps": 20})
    assert main(["ablate", "--config", plan("a.yaml", failing, quick)]) == 2
    told = capsys.readouterr()
    assert "1 of 2 cells failed" in told.err
    # The failed one with its command, the other without.
    assert "[1/2, about" in told.out
    assert "invert object_rearrangement, seed 0: failed: " in told.out
    assert "--model.budget.learning_rate=1e+30" in told.out
    assert told.out.count("python -m ftl_lightning") == 1
    assert (Path("logs") / "object_rearrangement" / "invert_object_rearrangement_seed_0_1" / "results.csv").is_file() is False
    assert "the loss became" in told.err
    assert len(read_rows("r.csv")) > 0


def test_what_cannot_run_is_told_before_anything_does(quick: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    method = {
        "verb": "invert",
        "config": f"{CONF}/{{method}}/driving.yaml",
        "each": {"method": ["bc", "telepathy"]},
        "options": {"model.pretrained": "models/{method}"},
    }
    Path("pretraining.yaml").write_text("model: {class_path: ftl_lightning.learning.PretrainingModule}")
    wrong = [
        with_options(quick, **{"model.pretrained": "nowhere"}),
        with_options(quick, **{"evaluation.suites": ["paper", "exam"]}),
        with_options(quick, **{"model.tempo": 3}),
        with_options(quick, **{"data.domain": "driving", "evaluation.closed_loop": True}),
        {"verb": "invert", "config": [str(CONF / "agent.yaml"), "pretraining.yaml"]},
        {
            "verb": "invert",
            "config": f"{CONF}/in_context/agent.yaml",
            "options": {"model.pretrained": f"{ROOT}/pretrained/agent"},
        },
        method,
    ]
    assert main(["ablate", "--config", plan("a.yaml", quick, *wrong)]) == 2
    told = capsys.readouterr().err
    assert "8 of 9 cells cannot run, none was started" in told
    for part in (
        "nowhere/config.json: expected a pretrained model",
        "evaluation.suites: expected some of training, paper, components, validation, compositions "
        "(domain object_rearrangement), found exam",
        "tempo",
        "expected a model of driving (diffusion or bc or cvae), found one of object_rearrangement (diffusion)",
        "agent.yaml, pretraining.yaml: expected the configuration of an adaptation (invert), found that of a pretraining (fit)",
        "expected a model of agent (in-context), found one of agent (diffusion)",
        "telepathy/driving.yaml: expected a configuration file, found nothing",
        "holds ablation, agent.yaml, bc, cvae",
        "models/bc/config.json: expected a pretrained model",
    ):
        assert part in told, part
    assert told.count("\n") == 1
    assert not Path("r.csv").exists()


def test_shards_are_parts_of_the_plan(quick: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    stage = quick | {"grid": {"model.omega": [1.0, 1.1, 1.2]}}
    config = plan("a.yaml", stage, seeds=[0])
    assert main(["ablate", "--config", config, "--shard", "2/3"]) == 0
    assert set(read_rows("r.csv").query("K > 0")["omega"]) == {"1.1"}
    assert "[1/1" in capsys.readouterr().out
    assert main(["ablate", "--config", config, "--shard", "1/3"]) == 0
    assert main(["ablate", "--config", config, "--shard", "3/3"]) == 0
    assert set(read_rows("r.csv").query("K > 0")["omega"]) == {"1.0", "1.1", "1.2"}
    for shard in ("0/3", "4/3", "half"):
        assert main(["ablate", "--config", config, "--shard", shard]) == 2
        assert "shard: expected 'number/shards' such as 3/8" in capsys.readouterr().err


def test_a_ray_cluster_of_two_workers_measures_the_same(quick: dict[str, object], monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray", reason="needs the extra cluster")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # else they starve beside the other tests
    stage = quick | {"grid": {"model.omega": [1.0, 1.2]}}
    assert main(["ablate", "--config", plan("a.yaml", stage)]) == 0
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        Path("b.yaml").write_text(Path("a.yaml").read_text().replace("r.csv", "s.csv"))
        failing = with_options(quick, **{"model.budget.learning_rate": 1e30, "data.steps": 20})
        content = yaml.safe_load(Path("b.yaml").read_text())
        Path("b.yaml").write_text(yaml.safe_dump(content | {"stages": [*content["stages"], failing]}))
        assert main(["ablate", "--config", "b.yaml", "--executor", "ray"]) == 2  # the failing cell is told
    finally:
        ray.shutdown()
    one, other = (
        read_rows(name).sort_values(["method", "form", "variant", "omega", "setting", "task"], ignore_index=True)
        for name in ("r.csv", "s.csv")
    )
    assert one.equals(other)
