"""The order in which TensorBoard shows a run."""

from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.cli.main import main
from ftl_lightning.evaluation import evaluator
from ftl_lightning.training.board import Board, tag
from tests.conftest import ROOT


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("train/loss", "loss/train"),
        ("val/loss", "loss/val"),
        ("val/accuracy/new concept", "accuracy/new concept"),
        ("test/loss", "test results/loss"),
        ("optimizer/learning rate", "optimizer/learning rate"),
        ("train", "train"),
        ("training/mine", "training/mine"),
    ],
)
def test_what_is_measured_comes_first_in_a_tag_and_tests_stand_apart(name: str, expected: str) -> None:
    assert tag(name) == expected


def test_the_number_of_the_epoch_has_no_chart(tmp_path: Path) -> None:
    board = Board(str(tmp_path), name="here", version="fit")
    board.log_metrics({"train/loss": 0.5, "epoch": 0.0}, 3)
    board.finalize("success")
    events = EventAccumulator(str(tmp_path / "here" / "fit")).Reload()
    assert events.Tags()["scalars"] == ["loss/train"]
    assert [(event.step, event.value) for event in events.Scalars("loss/train")] == [(3, 0.5)]


def test_accuracy_has_a_point_before_the_first_validation_and_the_model_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = ["--data.samples_per_concept=2", "--data.validation_per_concept=1", "--data.steps_per_epoch=4", "--trainer.max_steps=4"]
    small += ["--model.denoiser_args={hidden_dim: 32, depth: 2, condition_dim: 16, dropout: 0.1}", "--evaluation.samples=2"]
    small = ["fit", f"--config={ROOT}/conf/object_rearrangement.yaml", *small, "--trainer.enable_progress_bar=false"]
    for first, steps in ((2, [2, 3]), (100, [3])):
        monkeypatch.setattr(evaluator, "FIRST", first)
        place = tmp_path / str(first)
        assert main([*small, f"--model.output={place}/model", f"--trainer.logger.init_args.save_dir={place}"]) == 0
        events = EventAccumulator(str(place / "object_rearrangement" / "fit")).Reload()
        assert [event.step for event in events.Scalars("accuracy/training concept")] == steps
    one, other = (tmp_path / name / "model" / "model.safetensors" for name in ("2", "100"))
    assert one.read_bytes() == other.read_bytes()
