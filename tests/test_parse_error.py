"""A mistake in a configuration is told with the user's own file and the line that it stands in."""

from pathlib import Path

import pytest

from ftl_lightning.cli import main
from ftl_lightning.errors import LONGEST

CALLBACKS = "lightning.pytorch.callbacks"
MISTAKES = [
    ("trainer:\n  max_stepz: 3", 3, "'trainer.max_stepz' is not accepted"),
    ("trainer:\n  max_steps: abc", 3, "key 'trainer.max_steps': expected int, found abc"),
    ("trainer: {max_steps: 2}\nmodell: {}", 3, "'modell' is not accepted"),
    ("trainer: {max_steps: 2}\nmodell: {a: 1}", 3, "modell"),
    ("model:\n  init_args:\n    denoiser: MLPDenoiser\n    learning_ratee: 3", 5, "'learning_ratee' is not accepted"),
    ("model:\n  init_args: {learning_rate: fast}", 3, "key 'learning_rate': expected float, found fast"),
    ("model: {class_path: lightning.pytorch.callbacks.ModelCheckpoint}", 2, "expected a LightningModule"),
    ("data:\n  init_args:\n    batch_sizes: 3", 4, "'batch_sizes' is not accepted"),
    ("evaluation:\n  # how many\n  sample: 3", 4, "'evaluation.sample' is not accepted"),
    (
        "trainer:\n  callbacks:\n  - class_path: lightning.pytorch.callbacks.ModelCheckpoint\n    init_args: {monitorr: x}",
        5,
        "monitorr",
    ),
    ("trainer:\n  callbacks: [{class_path: os.system}]", 3, "os.system is not taken from a configuration"),
]


@pytest.mark.parametrize(("text", "line", "expected"), MISTAKES, ids=lambda value: str(value)[:40])
def test_a_mistake_in_a_file_of_one_s_own_is_told_with_its_line(
    text: str, line: int, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.yaml").write_text(f"defaults: [conf/object_rearrangement.yaml]\n{text}\n")
    assert main(["fit", "--config=own.yaml"]) == 2
    (told,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("error: "))
    assert told.startswith(f"error: own.yaml: line {line}: ")
    assert expected in told
    assert "conf/verb" not in told
    assert len(told) <= LONGEST


def test_a_mistake_in_a_file_that_another_builds_on_is_told_with_that_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("base.yaml").write_text("defaults: [conf/object_rearrangement.yaml]\n\ntrainer: {max_stepz: 3}\n")
    Path("own.yaml").write_text("defaults: [base.yaml]\ntrainer: {max_steps: 3}\n")
    assert main(["fit", "--config=own.yaml"]) == 2
    assert "error: base.yaml: line 3: " in capsys.readouterr().err


def test_a_mistake_on_the_command_line_names_no_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("own.yaml").write_text("defaults: [conf/object_rearrangement.yaml]\ntrainer: {max_steps: 3}\n")
    assert main(["fit", "--config=own.yaml", "--trainer.max_steps=abc"]) == 2
    told = capsys.readouterr().err
    assert "error: key 'trainer.max_steps': expected int, found abc; see --help" in told
