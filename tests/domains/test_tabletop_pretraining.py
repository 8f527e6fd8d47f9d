"""Pretraining on the table-top: demonstrations that begin elsewhere, corrections from a file, and eyes that are taught places."""

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed
from ftl_lightning.domains.tabletop import source
from ftl_lightning.domains.tabletop.interface import (
    AROUND_BOWL,
    BLUR,
    HALF,
    IMAGE,
    MIDDLE,
    NAME,
    PLACES,
    POSE,
    PUSH,
    PUSH_ON_BOOK,
    RAISED,
    VIEWS,
    keypoint_loss,
    noisy_keypoints,
)
from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
from ftl_lightning.networks.image_encoder import ImageEncoders
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.data import PretrainingData
from ftl_lightning.training.model_folder import load_model
from ftl_lightning.training.trainer import Trainer
from tests.conftest import ROOT
from tests.domains.tabletop_samples import made_up

perturb = VIEWS["points"].perturb
assert perturb is not None
SIZES: dict[str, Any] = {"samples_per_concept": 1, "validation_per_concept": 1, "batch_size": 8, "steps_per_epoch": 4}
POINTS = {"widths": [8], "stride": 2, "head": "points", "keypoints": 8, "points": 5, "origin": "origin"}
SMALL: dict[str, Any] = {
    "denoiser_args": {"hidden_dim": 16, "depth": 1, "condition_dim": 8, "initial_dim": 8, "initial_encoder": "points"},
    "image_encoder": POINTS,
    "view": "points",
    "perturb": True,
    "prediction": "clean",
}


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch) -> PretrainingData:
    """A small training set that needs no simulator."""
    monkeypatch.setattr(source.Expert, "draw", made_up)
    found = PretrainingData(domain=NAME, **SIZES)
    found.setup("fit")
    return found


def trainer(**options: Any) -> Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    return Trainer(accelerator="cpu", default_root_dir="logs", **(quiet | options))


@pytest.mark.usefixtures("data")
def test_what_begins_elsewhere_and_corrections_join_the_training_set() -> None:
    data = PretrainingData(domain=NAME, recoveries=1, **SIZES)
    data.setup("fit")
    assert [data.training.concepts.count(task) for task in (PUSH, AROUND_BOWL)] == [5, 2]
    assert len(data.training) == 9
    batch = data.batch(0)
    assert batch.observed[PLACES].shape == (8, 5, 4)
    data.training.rows([0, 1]).save("more.safetensors")
    longer = PretrainingData(domain=NAME, more="more.safetensors", **SIZES)
    longer.setup("fit")
    assert len(longer.training) == 9
    replace(data.training.rows([0]), concepts=(PUSH_ON_BOOK,)).save("strange.safetensors")
    with pytest.raises(UserError, match=r"strange.safetensors: expected demonstrations of training concepts, found 'push"):
        PretrainingData(domain=NAME, more="strange.safetensors", **SIZES).setup("fit")
    with pytest.raises(UserError, match="recoveries: expected 0, as domain object_rearrangement has none, found 1"):
        PretrainingData(domain="object_rearrangement", recoveries=1).setup("fit")


@pytest.mark.slow
def test_eyes_are_taught_places(tmp_path: Path) -> None:
    data = PretrainingData(domain=NAME, **SIZES)
    losses: list[float] = []
    module = PretrainingModule(privileged={PLACES: 1.0}, draws=2, output=str(tmp_path / "model"), learning_rate=5e-3, **SMALL)
    module.log = lambda name, value, **_: losses.append(float(value.detach())) if name == "train/places" else None  # type: ignore[method-assign]
    trainer(max_steps=200).fit(module, datamodule=data)
    assert len(losses) == 200
    assert sum(losses[-20:]) < 0.85 * sum(losses[:20])
    model = load_model(tmp_path / "model")
    assert model.config.plane == (0, 1)
    start = data.training.initial_states
    read = model.of_images(start.observed)
    assert read is not None
    assert read.shape == (len(data.training), 20)
    assert float(keypoint_loss(read, start.observed[PLACES]).mean()) < losses[0]


def test_an_error_is_that_of_what_is_seen() -> None:
    places = torch.zeros(2, 5, 4)
    places[:, 0] = torch.tensor([1.0, MIDDLE[0] + 0.1, MIDDLE[1], 0.015])
    right = torch.zeros(2, 4, 5)
    right[:, 0, 0], right[:, 2, 0] = 0.1 / HALF, 0.015 / HALF
    right[:, 3] = torch.tensor([20.0, *[-20.0] * 4])
    right[:, :3, 1:] = 7.0  # nobody knows where what is not seen is
    assert keypoint_loss(right.flatten(1), places).tolist() == pytest.approx([0, 0], abs=1e-6)
    right[1, 1, 0] += 0.5
    assert keypoint_loss(right.flatten(1), places).tolist() == pytest.approx([0, 0.5], abs=1e-6)


def test_noisy_keypoints_are_near_the_true_places(data: PretrainingData) -> None:
    places = data.batch(0).observed[PLACES].repeat(200, 1, 1)
    read = noisy_keypoints(places, generator("cpu", 0))
    there = places[..., 0] > 0.5
    wrong = read.unflatten(1, (4, 5)).transpose(1, 2)[..., :3] * HALF - (places[..., 1:] - torch.tensor([*MIDDLE, 0.0]))
    assert wrong[there].std(dim=0).tolist() == pytest.approx(list(BLUR), rel=0.1)
    assert wrong[there].mean(dim=0).abs().max() < 1e-3
    assert torch.equal(read[:, 15:] > 0, there)


def test_pictures_are_looked_at_in_part_of_the_windows_alone(
    tmp_path: Path, data: PretrainingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    plain = ImageEncoders.forward

    def counted(self: ImageEncoders, observed: Observed) -> torch.Tensor:
        looked.append(len(observed[IMAGE]))
        return plain(self, observed)

    monkeypatch.setattr(ImageEncoders, "forward", counted)
    module = PretrainingModule(privileged={PLACES: 1.0}, unencoded=0.75, output=str(tmp_path / "model"), **SMALL)
    trainer(max_steps=3, limit_val_batches=0).fit(module, datamodule=data)
    assert looked == [2, 2, 2]
    plan = {name: value.grad for name, value in module.raw.named_parameters() if value.grad is not None}
    assert any(name.startswith("denoiser") for name in plan)
    assert load_model(tmp_path / "model").config.training["model"]["unencoded"] == 0.75


def test_places_move_with_the_picture_and_what_has_none_is_also_seen_higher(data: PretrainingData) -> None:
    batch = data.batch(1)
    states, seen = perturb(batch.states, batch.observed, generator("cpu", 0))
    hand, before = seen[POSE][:, :2], batch.observed[POSE][:, :2]
    for number in range(5):
        there = (seen[PLACES][:, number, 0] > 0.5) & (batch.observed[PLACES][:, number, 0] > 0.5)
        away = (seen[PLACES][there, number, 1:3] - hand[there]).norm(dim=1)
        was = (batch.observed[PLACES][there, number, 1:3] - before[there]).norm(dim=1)
        torch.testing.assert_close(away, was, atol=1e-5, rtol=0)
    assert seen[IMAGE].dtype == torch.uint8
    assert torch.equal(seen[POSE][:, 2], batch.observed[POSE][:, 2])
    assert states.shape == batch.states.shape
    unseen = {name: values for name, values in batch.observed.items() if name != IMAGE}
    states, seen = perturb(batch.states, unseen, generator("cpu", 0))
    heights = (states[..., 2] - batch.states[..., 2])[:, 0]
    assert (heights == 0).any()
    assert (heights > 0.005).any()
    assert heights.max() <= RAISED + 1e-6
    for moved, before in (
        (states[..., 2], batch.states[..., 2]),
        (seen[POSE][:, 2:3], batch.observed[POSE][:, 2:3]),
        (seen[PLACES][..., 3], batch.observed[PLACES][..., 3]),
    ):
        torch.testing.assert_close(moved - before, heights[:, None].expand_as(moved), atol=1e-6, rtol=0)


def test_invalid_options_are_refused(data: PretrainingData) -> None:
    plain = {"image_encoder": {"origin": "origin"}}
    reads = "model.privileged.places: expected image_encoder of 5 points, found 96 outputs"
    for options, message in (
        ({"privileged": {"depth": 1.0}}, r"model.privileged: expected places \(domain tabletop\), found 'depth'"),
        ({"privileged": {PLACES: 1.0}, "denoiser_args": {}, **plain}, reads),
        (plain, "initial_encoder: expected flat, found points"),
        ({"privileged": {PLACES: -1.0}}, r"model.privileged.places: expected a number from 0"),
        ({"unencoded": 0.5}, "model.unencoded: expected less than 1, and one name in model.privileged, found 0.5"),
        ({"unencoded": 1.0, "privileged": {PLACES: 1.0}}, "model.unencoded: expected less than 1"),
        ({"unencoded": 1.5, "privileged": {PLACES: 1.0}}, "model.unencoded: expected a number from 0 to 1"),
        ({"draws": 0}, "model.draws: expected a number from 1|model.draws: expected 1"),
    ):
        with pytest.raises(UserError, match=message):
            trainer(max_steps=1).fit(PretrainingModule(**(SMALL | options)), datamodule=data)


@pytest.mark.slow
def test_a_model_is_corrected_by_the_expert(tiny_of: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    script = runpy.run_path(str(ROOT / "benchmarks" / "experiments" / "tabletop_dagger.py"))
    pretrained = tiny_of("tabletop")
    monkeypatch.setattr("sys.argv", ["x", f"--pretrained={pretrained}", f"--task={PUSH}", "--count=2", "--out=made.safetensors"])
    script["main"]()
    made = Demonstrations.load("made.safetensors")
    assert made.concepts == (PUSH, PUSH)
    assert set(made.observed) == {IMAGE, POSE, PLACES}
    longer = PretrainingData(domain=NAME, more="made.safetensors", **SIZES)
    longer.setup("fit")
    assert len(longer.training) == 9
