"""The order in which TensorBoard shows a run."""

from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.training.board import Board, tag


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
