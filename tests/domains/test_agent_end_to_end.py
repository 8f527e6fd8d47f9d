"""Navigation through the command line: inversion, closed loop, sampling, mistakes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.agent.scenes import OBSERVED
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.methods.ftl_igm.model import build_denoiser
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.data import InversionData, PretrainingData
from ftl_lightning.training.model_folder import load_model
from tests import tiny
from tests.conftest import CONF, ROOT, refused, succeed

SHIPPED = ROOT / "pretrained" / "agent"


@pytest.fixture
def model(tiny_of: Callable[[str], Path], drawn: None) -> Path:
    """Folder of a small pretrained model."""
    return tiny_of("agent")


@pytest.fixture
def invert(model: Path) -> list[str]:
    """Arguments of an inversion through it."""
    quick = ["--model.budget.samples=2", "--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.replan=64"]
    return ["invert", f"--config={CONF / 'agent.yaml'}", f"--model.pretrained={model}", *quick, *tiny.QUIET]


@pytest.mark.slow
def test_invert_judges_plans_and_executes_them(invert: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftl_lightning.domains.agent.rendering.FRAMES", 2)
    succeed(*invert, "--data.steps=2", "--data.demonstrations_per_concept=2", "--evaluation.figures=1")
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
    tag = "3 rollouts/new initial state/go to red bowl"
    assert events.Images(tag)[0].encoded_image_string.startswith(b"GIF89a")
    assert "1 pictures/new initial state/go to red bowl" in events.Tags()["images"]
    assert "test results/closed loop success/new initial state" in events.Tags()["scalars"]


@pytest.mark.slow
def test_sample_starts_from_new_or_given_initial_states(capsys: pytest.CaptureFixture[str]) -> None:
    common = ["sample", f"--pretrained={SHIPPED}", "--compose=go to bowl:1.6", "--steps=2"]
    succeed(*common, "--goal=go to bowl", "--count=3", "--figure=plans.png")
    drawn = Demonstrations.load("states.safetensors")
    assert drawn.states.shape == (3, 128, 13)
    assert drawn.observed[OBSERVED].shape == (3, 52)
    assert drawn.scenes is not None
    assert torch.equal(drawn.scenes, drawn.observed[OBSERVED])
    assert Path("plans.png").is_file()
    succeed(*common, "--initial=states.safetensors", "--out=again.safetensors")
    assert (Demonstrations.load("again.safetensors").states == drawn.states).all()
    succeed(*common, "--count=3", "--out=own.safetensors")  # the composed text names a task to start from
    assert (Demonstrations.load("own.safetensors").states == drawn.states).all()
    refused(capsys, ["sample", f"--pretrained={SHIPPED}"], "goal, initial: expected")


def test_mistakes_and_demonstrations_without_observed_features(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match=r"data.horizon: expected 1 or more"):
        PretrainingData("agent", horizon=0)
    with pytest.raises(UserError, match=r"evaluation.replan: expected 1 or more"):
        Evaluator(replan=0)
    config = load_model(SHIPPED).config
    deep = {"denoiser_args": config.denoiser_args | {"initial_encoder": "deep"}}
    for changes, expected in (
        ({"horizon": 60}, "horizon: expected a multiple of 8"),
        ({"prediction": "x"}, "prediction: expected one of epsilon, v, clean, displacement"),
        (deep, "initial_encoder: expected one of flat, joint, entities"),
    ):
        with pytest.raises(UserError, match=expected):
            build_denoiser(replace(config, **changes))
    np.savez("plain.npz", states=np.zeros((2, 150, 13), dtype=np.float32))
    expected = "plain.npz: key 'observed/world': expected float32 of shape (52,) each, found none"
    with pytest.raises(UserError) as found:
        InversionData("agent", demonstrations="plain.npz")
    assert expected in str(found.value)
    refused(capsys, ["sample", f"--pretrained={SHIPPED}", "--compose=go to bowl", "--initial=plain.npz"], expected)


@pytest.mark.slow
def test_a_checkpoint_of_another_horizon_is_refused(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, fit = model.parent / "checkpoints" / "last.ckpt", tiny.fit(Path("agent.yaml"), "--data.horizon=64")
    refused(capsys, [*fit, f"--ckpt_path={checkpoint}"], "key 'horizon': expected 64, found 128")


@pytest.fixture
def first_seen() -> Path:
    """A file of drives of which the first observation alone is known."""
    succeed("generate", "agent", "--task=go to red bowl", "--count=2", "--out=whole.safetensors")
    whole = Demonstrations.load("whole.safetensors")
    first = whole.observed[OBSERVED][:, 0]
    assert torch.equal(whole.initial_states.observed[OBSERVED], first)
    replace(whole, observed={OBSERVED: first}, per_step=()).save("first.safetensors")
    return Path("first.safetensors")


def test_demonstrations_whose_first_observations_alone_are_known(first_seen: Path) -> None:
    found = InversionData("agent", demonstrations=str(first_seen)).demonstrations
    assert torch.equal(found.initial_states.observed[OBSERVED], Demonstrations.load("whole.safetensors").observed[OBSERVED][:, 0])


@pytest.mark.slow
def test_first_observations_are_enough_to_learn_from(first_seen: Path, invert: list[str]) -> None:
    plain = ["--evaluation.closed_loop=false", "--evaluation.suites=[]", "--evaluation.diversity=false", "--evaluation.figures=0"]
    succeed(*invert, f"--data.demonstrations={first_seen}", "--data.steps=2", *plain)
