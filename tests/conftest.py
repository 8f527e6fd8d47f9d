"""Fixtures and helpers that all tests share."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from filelock import FileLock

from ftl_lightning.cli.main import main
from ftl_lightning.services.errors import LONGEST
from tests.suites import *  # noqa: F403
from tests.suites import of_no_test

if TYPE_CHECKING:
    from ftl_lightning.training.inversion_module import InversionModule

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes that tests start, too

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


def succeed(*arguments: str) -> None:
    """Run a verb in this process, to its end without an error."""
    assert main(arguments) == 0


def python(*arguments: str | Path, folder: Path | None = None, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a fresh interpreter on this checkout: ``python("-c", code)``, ``python("-m", "ftl_lightning", verb)``."""
    return subprocess.run([sys.executable, *arguments], env=environment(**variables), cwd=folder, capture_output=True, text=True)


def started(*arguments: str | Path, **variables: str) -> "subprocess.Popen[str]":
    """Start the program as people start it."""
    command = [sys.executable, "-m", "ftl_lightning", *arguments]
    return subprocess.Popen(command, env=environment(**variables), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def environment(**variables: str) -> dict[str, str]:
    """Variables of processes that tests start: this checkout, one thread."""
    return os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | variables


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], *expected: str, longest: int = LONGEST) -> str:
    """Run a verb and expect one line with these texts, and no new file; returns what went to standard error."""
    capsys.readouterr()
    before = files()
    assert main(arguments) == 2
    told = capsys.readouterr().err
    lines = [line for line in told.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert "Traceback" not in told
    assert len(lines[0]) <= longest
    for text in expected:
        assert text in lines[0]
    assert files() == before
    return told


def files() -> dict[Path, int]:
    """When each file below the current folder was written, but for the cache."""
    return {path: path.lstat().st_mtime_ns for path in Path().rglob("*") if "cache" not in path.parts}


def inversion_module(pretrained: Path, **options: Any) -> "InversionModule":
    """The module of ``invert`` with some options, given by their flat names."""
    from ftl_lightning.igm.settings import InversionSettings
    from ftl_lightning.training.inversion_module import InversionModule

    settings = InversionSettings().changed(**options)
    return InversionModule(str(pretrained), **{field.name: getattr(settings, field.name) for field in fields(settings)})


# Fixtures


def pytest_collection_finish(session: pytest.Session) -> None:
    """Import what most tests need before the first of them, whose work it would be."""
    import ftl_lightning.apps.lightning_cli  # noqa: F401


@pytest.fixture(autouse=True)
def _in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # what a test logs and writes is of no other test
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))  # no concepts of the person who runs the tests
    import torch  # not above: the process that hands out the tests needs no torch

    torch.set_num_threads(1)


Once = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Make a folder once for all processes of a test run: ``once(name, make)`` calls ``make(folder)`` in it, and returns it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"), pytest.MonkeyPatch.context() as patch, of_no_test():
            if not done.exists():
                folder.mkdir(exist_ok=True)
                patch.chdir(folder)
                patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def tiny(once: Once) -> Path:
    """Folder of a small pretrained model of object rearrangement that has learned something; its log folder is the parent."""
    fit = ["fit", f"--config={CONF / 'object_rearrangement.yaml'}", *TINY, "--trainer.max_steps=150"]
    fit += ["--data.steps_per_epoch=75", "--trainer.logger.init_args.save_dir=.", "--evaluation.samples=4"]
    return once("tiny", lambda folder: succeed(*fit)) / "object_rearrangement" / "fit" / "pretrained"


@pytest.fixture(scope="session")
def tiny_of(once: Once) -> Callable[[str], Path]:
    """Folder of a tiny pretrained model of a domain that ships, of a few steps; its log folder is the parent."""
    from tests import tiny

    def model(domain: str) -> Path:
        def fit(folder: Path) -> None:
            few = ["--trainer.max_steps=5", "--data.steps_per_epoch=5", "--data.batch_size=8", "--evaluation.samples=1"]
            few += ["--evaluation.steps=2", "--evaluation.figures=0", "--evaluation.diversity=false"]
            with pytest.MonkeyPatch.context() as patch:
                draw_once(patch, once)
                succeed(*tiny.fit(Path(f"{domain}.yaml"), *few))

        return once(f"tiny_{domain}", fit) / "logs" / domain / "fit" / "pretrained"

    return model


@pytest.fixture
def drawn(once: Once, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take demonstrations that other tests of this run have drawn from a common cache; make up those of the table-top."""
    draw_once(monkeypatch, once)


def draw_once(patch: pytest.MonkeyPatch, once: Once) -> None:
    """Share drawn demonstrations between the tests of a run."""
    from ftl_lightning.domains.tabletop.source import Expert
    from tests.domains.tabletop_samples import made_up

    patch.setenv("XDG_CACHE_HOME", str(once("drawn", lambda folder: None)))
    patch.setattr(Expert, "draw", made_up)  # the simulator takes ten seconds for the demonstrations of a tiny fit


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
