"""Behaviour cloning with our network: plans by regression."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.few_shot.learner import FewShot
from tests.conftest import CONF, refused, succeed

FIT = ["fit", f"--config={CONF / 'own.yaml'}", f"--config={CONF / 'method' / 'regression.yaml'}", "--data.demonstrations=d.npz"]
SMALL = ["--model.denoiser_args={hidden_dim: 32, depth: 2, condition_dim: 16}", "--trainer.enable_progress_bar=false"]


@pytest.fixture
def two_slopes(tmp_path: Path) -> None:
    """Rising and falling lines, which begin between 0 and .2."""
    begin = np.linspace(0, 0.2, 20)[:, None, None]
    states = np.concatenate([begin + slope * np.linspace(0, 1, 8)[None, :, None] for slope in (1.0, -1.0)])
    np.savez("d.npz", states=states, concepts=np.repeat(["rise", "fall"], 20))


@pytest.mark.slow
@pytest.mark.usefixtures("two_slopes")
def test_a_plan_is_the_conditional_mean_and_a_new_slope_is_learned() -> None:
    succeed(*FIT, *SMALL, "--model.prediction=clean", "--trainer.max_steps=150", "--model.output=m")
    model = FewShot.from_pretrained("m")
    assert model.model.method.name == "BC, our network"
    drawn = [model.sample(model["rise"], count=3, seed=seed, temperature=1.0).states for seed in (0, 1)]
    assert torch.equal(drawn[0], drawn[1])
    assert torch.equal(drawn[0][0], drawn[0][1])
    mean = 0.1 + torch.linspace(0, 1, 8)
    assert (drawn[0][0, :, 0] - mean).abs().max() < 0.1
    half = np.linspace(0.05, 0.15, 5)[:, None, None] + 0.5 * np.linspace(0, 1, 8)[None, :, None]
    learned = model.learn(half, name="half", form="paper")
    assert np.abs(model.sample(learned, count=1).states[0, :, 0].numpy() - half[2, :, 0]).max() < 0.15


@pytest.mark.usefixtures("two_slopes")
@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--model.diffusion_steps=2", "model.diffusion_steps: expected 1 for a regression, found 2"),
        ("--model.prediction=v", "model.prediction: expected clean, displacement or cosines for a regression, found v"),
    ],
)
def test_what_is_no_regression_is_refused(option: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, [*FIT, *SMALL, "--model.prediction=clean", option], message)
