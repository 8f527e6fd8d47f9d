"""Fixtures: a small model trained once a session, through the command line that users have."""

import os
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch

from ftl_lightning.cli import main
from ftl_lightning.errors import LONGEST

if TYPE_CHECKING:
    from ftl_lightning.learning import InversionModule

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

ROOT = Path(__file__).parent.parent
CONF = ROOT / "conf"
TINY = [
    "--model.denoiser_args={hidden_dim: 64, depth: 2, condition_dim: 32}",
    "--data.samples_per_concept=50",
    "--data.validation_per_concept=4",
    "--data.batch_size=64",
    "--trainer.enable_progress_bar=false",
    "--trainer.accelerator=cpu",
]
"""Options that make any fit of object rearrangement a matter of seconds."""


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], *expected: str) -> str:
    """Run a verb and expect one line that says something, and no new file; returns what went to standard error."""
    capsys.readouterr()
    before = {path: path.lstat().st_mtime_ns for path in Path().rglob("*")}
    assert main(arguments) == 2
    told = capsys.readouterr().err
    lines = [line for line in told.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert "Traceback" not in told
    assert len(lines[0]) <= LONGEST
    for text in expected:
        assert text in lines[0]
    assert {path: path.lstat().st_mtime_ns for path in Path().rglob("*") if "cache" not in path.parts} == before
    return told


def inversion_module(pretrained: Path, **options: Any) -> "InversionModule":
    """The module of ``invert`` with some options, given by their flat names."""
    from ftl_lightning.learning import InversionModule
    from ftl_lightning.learning.inversion_settings import InversionSettings

    settings = InversionSettings().changed(**options)
    return InversionModule(str(pretrained), **{field.name: getattr(settings, field.name) for field in fields(settings)})


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Say at once what failed: a run that is stopped from outside never comes to its summary."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        told = f"{report.nodeid[:200]} ({report.when}, after {report.duration:.0f} s)"
        print(f"\nFAILED {told}\n{report.longreprtext[-3000:]}", flush=True)


@pytest.fixture(autouse=True)
def _in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # logs and outputs of a test stay its own
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))  # no concepts of the person who runs the tests
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small pretrained model; its log folder is the parent."""
    folder = tmp_path_factory.mktemp("tiny")
    arguments = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *TINY, "--trainer.max_steps=150"]
    arguments += ["--data.steps_per_epoch=75", f"--trainer.logger.init_args.save_dir={folder}", "--evaluation.samples=4"]
    assert main(arguments) == 0
    return folder / "object_rearrangement" / "fit" / "pretrained"


@pytest.fixture(scope="session")
def shipped() -> Path:
    """Folder of the model that ships with the repository."""
    return ROOT / "pretrained" / "object_rearrangement"


@pytest.fixture
def invert(tiny: Path, tmp_path: Path) -> Callable[..., Path]:
    """Run a short inversion through the tiny model; returns its log folder."""

    def run(*options: str) -> Path:
        arguments = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), f"--model.pretrained={tiny}"]
        arguments += ["--data.steps=5", "--model.budget.samples=4", "--evaluation.samples=3", "--evaluation.steps=3"]
        arguments += ["--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu", *options]
        assert main(arguments) == 0
        return tmp_path / "logs" / "object_rearrangement" / "invert"

    return run
