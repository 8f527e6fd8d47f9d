"""Driving through the command line: pretraining, inversion, closed loop, mistakes."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from ftl_lightning.cli import main
from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.driving.domain import DOMAIN
from ftl_lightning.domains.driving.policies import POLICIES
from ftl_lightning.domains.driving.shipped import training_set
from ftl_lightning.domains.driving.traffic import SCENARIO, STATE, TRAFFIC, origin
from ftl_lightning.domains.driving.views import VIEWS
from ftl_lightning.evaluation.closed_loop import planner
from ftl_lightning.learning.model_folder import read_model
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.seeding import generator
from tests.conftest import CONF, ROOT

FIT = ["--config", str(CONF / "driving.yaml")]
INVERT = ["--config", str(CONF / "driving.yaml")]
SMALL = [
    "--model.denoiser_args={hidden_dim: 16, depth: 2}",
    "--data.samples_per_concept=6",
    "--data.validation_per_concept=2",
    "--data.batch_size=16",
    "--data.steps_per_epoch=10",
    "--trainer.max_steps=20",
]
QUICK = ["--evaluation.samples=2", "--evaluation.steps=2", "--evaluation.figures=2"]
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small pretrained model."""
    folder = tmp_path_factory.mktemp("driving")
    assert main(["fit", *FIT, *SMALL, *QUICK, *QUIET, f"--trainer.logger.init_args.save_dir={folder}"]) == 0
    return folder / "driving" / "fit" / "pretrained"


def test_the_shipped_demonstrations() -> None:
    train, held_out = training_set("train", 100), training_set("validation", 10)
    assert len(train) == 400
    assert len(held_out) == 40
    starts = {origin(row) for part in (train, held_out) for row in part.initial_states.require_scenes().numpy()}
    assert len(starts) == 440
    assert {name for name, _ in starts} == set(DOMAIN.concepts.training)
    source = DOMAIN.source(None)
    assert torch.equal(source.split("train", 3, 7).states, source.split("train", 3, 0).states)
    for part in (train, held_out):
        assert part.per_step == (TRAFFIC, SCENARIO)
        assert torch.equal(part.observed[TRAFFIC][..., :7], part.states)
        scenario = part.initial_states.require_scenes()[:, None, -2]
        assert torch.equal(part.observed[SCENARIO][..., 0], scenario.expand(part.states.shape[:2]))
    # Each is where the seed in its card puts it.
    again = source.starts("exit", 40, 0)
    assert again is not None
    first = train.select("exit").initial_states.require_scenes()[0]
    assert any(torch.allclose(first, row, atol=1e-3) for row in again.require_scenes())


def test_invert_learns_the_roundabout_and_drives_it(model: Path) -> None:
    options = ["--data.steps=3", "--model.budget.samples=2", "--data.demonstrations_per_concept=2", "--evaluation.suites=[paper]"]
    beside = "--evaluation.environments=[step veto]"
    assert main(["invert", *INVERT, f"--model.pretrained={model}", *options, *QUICK, *QUIET, beside]) == 0
    rows = pd.read_csv("logs/driving/invert/results.csv", keep_default_na=False)
    ours = rows[rows["K"] == 2]
    names = ("success", "strict success", "crash", "return", "length")
    outcomes = {f"closed loop {name}{veto}" for name in names for veto in ("", " (step veto)")}
    assert outcomes <= set(ours["metric"])
    assert {metric for metric in set(ours["metric"]) - outcomes if not metric.startswith(("won against", "lost against"))} == {
        "novelty"
    }
    regressions = ("nearest demonstration", "ridge regression", "MLP regression")
    policies = ("IDLE", "random", "FASTER", *regressions, "expert (oracle)")
    for outcome in ("won", "lost"):
        shown = {metric for metric in set(ours["metric"]) if metric.startswith(outcome)}
        assert shown == {f"{outcome} against {name}{veto}" for name in policies for veto in ("", " (step veto)")}
    value = rows.set_index(["method", "metric"])["value"]
    for veto in ("", " (step veto)"):
        for name in policies:  # what only the one wins, less what only the other does, is the difference of their rates
            won, lost = (value["FTL-IGM", f"{outcome} against {name}{veto}"] for outcome in ("won", "lost"))
            rates = [value[method, f"closed loop strict success{veto}"] for method in ("FTL-IGM", name)]
            assert won - lost == pytest.approx(rates[0] - rates[1])
        oracle = rows[(rows["method"] == "expert (oracle)") & (rows["metric"] == f"closed loop strict success{veto}")]
        assert oracle["value"].tolist() == [1.0]


def test_an_environment_that_there_is_not(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = ["invert", *INVERT, f"--model.pretrained={model}", *QUIET, "--data.demonstrations_per_concept=2"]
    assert main([*run, "--evaluation.environments=[crystal ball]"]) == 2
    told = "evaluation.environments: expected one of simulation veto, step veto, found 'crystal ball'"
    assert told in capsys.readouterr().err


def test_cells_share_what_reference_policies_did(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inverting again, with another K, drives none of them again."""
    made: list[str] = []

    def recorded(name: str, make: Any) -> Any:
        return lambda goal, *rest: (made.append(name), make(goal, *rest))[1]

    for name, make in list(POLICIES.items()):
        monkeypatch.setitem(POLICIES, name, recorded(name, make))
    options = ["--data.steps=2", "--model.budget.samples=2", "--data.demonstrations_per_concept=2", "--evaluation.suites=[paper]"]
    for components in (1, 2):
        run = ["invert", *INVERT, f"--model.pretrained={model}", *options, *QUICK, *QUIET, "--seed_everything=5"]
        assert main([*run, f"--model.components={components}", "--evaluation.samples=1", "--evaluation.results=r.csv"]) == 0
    assert sorted(made) == sorted(POLICIES)
    rows = pd.read_csv("r.csv", keep_default_na=False)
    assert set(rows[rows["K"] > 0]["K"]) == {1, 2}
    assert set(rows[rows["K"] == 0]["method"]) == set(POLICIES)


def test_the_shipped_model_knows_the_training_scenarios() -> None:
    """On held-out episodes its next states are nearer than those of a vehicle that keeps its speed."""
    shipped = read_model(GenerativeModel, ROOT / "pretrained" / "driving")
    assert DOMAIN.closed_loop is not None
    assert planner(shipped, DOMAIN.closed_loop) is VIEWS["steps"].act
    for name in ("highway", "merge"):
        held = training_set("validation", 10).select(name)
        rows = [(row, time) for row, length in enumerate(held.lengths.tolist()) for time in range(length - 1)]
        at, when = torch.tensor(rows).T
        now = {name: values[at, when] for name, values in held.observed.items()}
        following = torch.stack([held.states[row, time + 1] for row, time in rows])
        concept, draw = [Composition(shipped.concept(name)[None, None], torch.tensor([1.2]))], [generator("cpu", 0)]
        plans = shipped.sample(concept, len(rows), Sampling("dpm_solver", 5, 0.0), draw, now)[0]
        kept = now[TRAFFIC][:, :STATE].clone()
        kept[:, 1:3] += kept[:, 3:5]  # decisions are a second apart
        assert (plans[:, 1] - following).norm(dim=1).mean() < 0.9 * (kept - following).norm(dim=1).mean()


def test_generate_writes_what_invert_reads(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "driving", "--task=merge", "--count=2", "--out=demos.safetensors"]) == 0
    found = Demonstrations.load("demos.safetensors")
    assert found.states.shape[2] == 7
    assert {name: values.shape[2:] for name, values in found.observed.items()} == {TRAFFIC: (35,), SCENARIO: (1,)}
    assert found.scenes is not None
    assert found.scenes.shape == (2, 37)
    capsys.readouterr()
    for arguments, expected in (
        (["generate", "driving", "--task=motorway"], "driving task: expected one of highway"),
        (["generate", "driving", "--task=merge", "--workers=0"], "workers: expected 1 or more"),
        (["fit", *FIT, *SMALL, *QUIET, "--data.samples_per_concept=101"], "expected at most 100 episodes"),
        (["fit", *FIT, *SMALL, *QUIET, "--model.view=map", "--model.perturb=true"], "model.perturb: expected a view that can"),
        (["fit", *FIT, *SMALL, *QUIET, "--model.view=mirror"], "model.view: expected one of '', 'map', 'steps'"),
    ):
        assert main(arguments) == 2
        assert expected in capsys.readouterr().err


def test_a_file_whose_states_do_not_fit(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wide = Demonstrations(
        states=torch.zeros(1, 9, 8),
        lengths=torch.tensor([9]),
        domain="driving",
        state_names=tuple("abcdefgh"),
        state_units=("",) * 8,
        concepts=("roundabout",),
        observed={TRAFFIC: torch.zeros(1, 9, 35), SCENARIO: torch.zeros(1, 9, 1)},
        per_step=(TRAFFIC, SCENARIO),
        scenes=torch.zeros(1, 37),
    )
    wide.save("wide.safetensors")
    assert main(["invert", *INVERT, *QUIET, f"--model.pretrained={model}", "--data.demonstrations=wide.safetensors"]) == 2
    assert "expected shape (demo, time, 7), found (1, 9, 8)" in capsys.readouterr().err
