"""Navigation through the command line: pretraining, inversion, closed loop, sampling, mistakes."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.cli import main
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.agent.scenes import OBSERVED
from tests.conftest import CONF

FIT = ["--config", str(CONF / "agent.yaml")]
INVERT = ["--config", str(CONF / "agent.yaml")]
SMALL = [
    "--model.denoiser_args={width: 8, multipliers: [1, 2], initial_encoder: entities}",
    "--data.samples_per_concept=4",
    "--data.validation_per_concept=1",
    "--data.batch_size=8",
    "--data.steps_per_epoch=10",
    "--trainer.max_steps=20",
]
QUICK = ["--evaluation.samples=2", "--evaluation.steps=2", "--evaluation.replan=32", "--evaluation.figures=2"]
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small pretrained model."""
    folder = tmp_path_factory.mktemp("agent")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        assert main(["fit", *FIT, *SMALL, *QUICK, *QUIET, f"--trainer.logger.init_args.save_dir={folder}"]) == 0
    return folder / "agent" / "fit" / "pretrained"


def test_invert_judges_plans_and_executes_them(model: Path) -> None:
    options = ["--data.steps=3", "--model.budget.samples=2", "--data.demonstrations_per_concept=2"]
    assert main(["invert", *INVERT, f"--model.pretrained={model}", *options, *QUICK, *QUIET]) == 0
    rows = pd.read_csv("logs/agent/invert/results.csv", keep_default_na=False)
    ours = rows[rows["K"] == 2]
    executed = {"closed loop success", "closed loop distractor", "closed loop progress"}
    assert set(ours["metric"]) == {"accuracy", "novelty", "coverage"} | executed
    assert set(ours["setting"]) == {"training concept", "training composition", "new initial state"}
    assert set(zip(ours["method"], ours["variant"], strict=True)) == {("FTL-IGM", "entities, free")}
    assert len(ours) == 4 * (4 + 5 + 5) + 4 + 2 * 5  # coverage of training concepts; both from new initial states
    oracle = rows[rows["method"] == "expert (oracle)"]
    assert (oracle.loc[oracle["metric"] == "accuracy", "value"] == 1).all()
    assert oracle.loc[oracle["metric"] == "closed loop success", "value"].mean() > 0.9
    events = EventAccumulator("logs/agent/invert", size_guidance={"images": 0})
    events.Reload()
    tag = "rollouts/new initial state/go to red bowl"
    assert events.Images(tag)[0].encoded_image_string.startswith(b"GIF89a")
    assert "pictures/new initial state/go to red bowl" in events.Tags()["images"]
    assert "test results/closed loop success/new initial state" in events.Tags()["scalars"]


def test_sample_starts_from_new_or_given_initial_states(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["sample", f"--pretrained={model}", "--compose=go to bowl:1.6", "--steps=2"]
    assert main([*common, "--goal=go to bowl", "--count=3", "--figure=plans.png"]) == 0
    drawn = Demonstrations.load("states.safetensors")
    assert drawn.states.shape == (3, 128, 13)
    assert drawn.observed[OBSERVED].shape == (3, 52)
    assert drawn.scenes is not None
    assert torch.equal(drawn.scenes, drawn.observed[OBSERVED])
    assert Path("plans.png").is_file()
    assert main([*common, "--initial=states.safetensors", "--out=again.safetensors"]) == 0
    again = Demonstrations.load("again.safetensors")
    assert (again.states == drawn.states).all()
    assert main([*common, "--count=3", "--out=own.safetensors"]) == 0  # the composed text names a task to start from
    assert (Demonstrations.load("own.safetensors").states == drawn.states).all()
    capsys.readouterr()
    assert main(["sample", f"--pretrained={model}"]) == 2
    assert "goal, initial: expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--data.horizon=60"], "horizon: expected a multiple of 8"),
        (["--data.horizon=0"], "data.horizon: expected 1 or more"),
        (["--evaluation.replan=0"], "evaluation.replan: expected 1 or more"),
        (["--model.prediction=x"], "prediction: expected one of epsilon, v, clean, displacement"),
        (["--model.denoiser_args={initial_encoder: deep}"], "initial_encoder: expected one of flat, joint, entities"),
    ],
)
def test_mistakes(options: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    small = [one for one in SMALL if "denoiser_args" not in one]
    assert main(["fit", *FIT, *small, *QUIET, *options]) == 2
    assert expected in capsys.readouterr().err


def test_a_checkpoint_of_another_horizon_is_refused(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = model.parent / "checkpoints" / "last.ckpt"
    assert main(["fit", *FIT, *SMALL, *QUIET, "--data.horizon=64", f"--ckpt_path={checkpoint}"]) == 2
    assert "key 'horizon': expected 64, found 128" in capsys.readouterr().err


def test_demonstrations_without_observed_features_are_refused(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np

    np.savez("plain.npz", states=np.zeros((2, 150, 13), dtype=np.float32))
    assert main(["invert", *INVERT, f"--model.pretrained={model}", "--data.demonstrations=plain.npz", *QUIET]) == 2
    expected = "plain.npz: key 'observed/world': expected float32 of shape (52,) each, found none"
    assert expected in capsys.readouterr().err
    assert main(["sample", f"--pretrained={model}", "--compose=go to bowl", "--initial=plain.npz"]) == 2
    assert expected in capsys.readouterr().err
    assert not Path("states.safetensors").exists()


def test_demonstrations_whose_first_observations_alone_are_known(model: Path) -> None:
    assert main(["generate", "agent", "--task=go to red bowl", "--count=3", "--out=whole.safetensors"]) == 0
    whole = Demonstrations.load("whole.safetensors")
    first = whole.observed[OBSERVED][:, 0]
    replace(whole, observed={OBSERVED: first}, per_step=()).save("first.safetensors")
    assert torch.equal(whole.initial_states.observed[OBSERVED], first)
    assert torch.equal(Demonstrations.load("first.safetensors").initial_states.observed[OBSERVED], first)
    options = ["--data.steps=2", "--model.budget.samples=2", "--evaluation.suites=[paper]", "--evaluation.closed_loop=false"]
    own = ["--data.demonstrations=first.safetensors"]
    assert main(["invert", *INVERT, f"--model.pretrained={model}", *own, *options, *QUICK, *QUIET]) == 0
