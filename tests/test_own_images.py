"""Images as data of one's own, through the command line: behaviour goes where a mark in a picture says."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ftl_lightning.cli.main import main
from ftl_lightning.few_shot.learner import FewShot
from tests.conftest import CONF

SIZE, TIME = 24, 8
TARGETS = {"to the mark": (1.0, 0.0), "away from the mark": (-1.0, 0.0), "above the mark": (1.0, 0.3)}
"""Where behaviour ends: so many times the mark's place, and so much higher."""


def behaviour(text: str, count: int, seed: int) -> dict[str, NDArray[np.generic]]:
    """Straight ways from the middle ``(count, TIME, 2)``, the picture of each, and the concept."""
    mark = np.random.default_rng(seed).uniform(-0.8, 0.8, (count, 2))
    factor, higher = TARGETS[text]
    states = np.linspace(0, 1, TIME)[None, :, None] * (factor * mark + (0, higher))[:, None]
    x, y = ((SIZE - 1) * (mark + 1) / 2).T[:, :, None, None]
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    picture = 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
    pictures = np.repeat(picture[:, None], 3, axis=1).astype(np.uint8)
    return {"states": states.astype(np.float32), "observed/camera": pictures, "concepts": np.repeat(text, count)}


def ends_apart(model: FewShot, name: str, text: str) -> float:
    """Mean distance between where samples end and where they should, for new pictures."""
    new = behaviour(text, 40, 7)
    concept = model.load(name) if name.endswith(".safetensors") else model[name]
    samples = model.sample(concept, observed={"camera": new["observed/camera"]}, seed=0).states
    return float((samples[:, -1] - torch.from_numpy(new["states"])[:, -1]).norm(dim=-1).mean())


@pytest.mark.slow
def test_a_concept_is_learned_from_five_pictures_and_followed_in_new_ones(tmp_path: Path) -> None:
    both = [behaviour(text, 100, seed) for seed, text in enumerate(("to the mark", "away from the mark"))]
    np.savez("many.npz", **{name: np.concatenate([one[name] for one in both]) for name in both[0]})
    np.savez("five.npz", **behaviour("above the mark", 5, 3))
    small = ["--model.denoiser_args", "{hidden_dim: 64, depth: 2, condition_dim: 64}", "--model.ema_decay=0.98"]
    options = [*small, "--trainer.max_steps=500", "--data.encoder=hashing", "--evaluation.figures=0"]
    assert main(["fit", "--config", str(CONF / "own.yaml"), "--data.demonstrations=many.npz", *options]) == 0
    options = ["--data.steps=100", "--evaluation.figures=0"]
    assert main(["invert", "--config", str(CONF / "own.yaml"), "--data.demonstrations=five.npz", *options]) == 0
    model = FewShot.from_pretrained("logs/own/fit/pretrained")
    apart = {text: ends_apart(model, text, text) for text in ("to the mark", "away from the mark")}
    apart["above the mark"] = ends_apart(model, "logs/own/invert/concepts/above_the_mark.safetensors", "above the mark")
    assert max(apart.values()) < 0.25, apart
    assert ends_apart(model, "to the mark", "away from the mark") > 0.8  # as the nearest demonstration's end is, too
