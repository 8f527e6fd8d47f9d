"""A mistake in a configuration is told with the user's own file and the line that it stands in."""

from argparse import ArgumentError
from pathlib import Path

import pytest

from ftl_lightning.apps.lightning_cli import parse
from ftl_lightning.services.command_line import Arguments, one_line
from ftl_lightning.services.errors import LONGEST, UserError
from tests.conftest import refused

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


def line_of(verb: str, *arguments: str) -> str:
    """The one short line that the program prints of what the parser of a verb refuses."""
    with pytest.raises((ArgumentError, UserError)) as error:
        parse(verb, list(arguments))
    told = one_line(str(error.value), verb, Arguments.read(arguments))
    assert "\n" not in told
    assert len(f"error: {told}") <= LONGEST
    return told


@pytest.mark.parametrize(("text", "line", "expected"), MISTAKES, ids=lambda value: str(value)[:40])
def test_a_mistake_in_a_file_of_one_s_own_is_told_with_its_line(
    text: str, line: int, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    data = "{class_path: ftl_lightning.training.data.PretrainingData, init_args: {domain: object_rearrangement}}"
    Path("data.yaml").write_text(f"data: {data}\n")
    Path("own.yaml").write_text(f"defaults: [conf/method/ftl_igm.yaml, data.yaml]\n{text}\n")
    refused(capsys, ["fit", "--config=own.yaml"], f"error: own.yaml: line {line}: ", expected)


def test_a_mistake_is_told_with_the_file_or_the_section_that_it_stands_in_and_of_the_command_line_with_none(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("base.yaml").write_text("defaults: [conf/object_rearrangement.yaml]\n\ntrainer: {max_stepz: 3}\n")
    Path("own.yaml").write_text("defaults: [base.yaml]\ntrainer: {max_steps: 3}\n")
    assert "conf/verb" not in refused(capsys, ["fit", "--config=own.yaml"], "error: base.yaml: line 3: ")
    sections = "invert:\n  trainer: {max_stepz: 1}\nfit:\n  trainer: {max_stepz: 2}\n"
    Path("own.yaml").write_text(f"defaults: [conf/agent.yaml]\n{sections}")
    for verb, number in (("fit", 5), ("invert", 3)):
        assert line_of(verb, "--config=own.yaml").startswith(f"own.yaml: line {number}: ")
    Path("own.yaml").write_text("defaults: [conf/object_rearrangement.yaml]\ntrainer: {max_steps: 3}\n")
    told = line_of("fit", "--config=own.yaml", "--trainer.max_steps=abc")
    assert told == "key 'trainer.max_steps': expected int, found abc; see --help"
