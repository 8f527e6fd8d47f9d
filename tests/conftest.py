"""Fixtures that all tests share, the markers of the three suites, and the limit of work for a test without one."""

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import torch
from filelock import FileLock

from ftl_lightning.cli import main
from ftl_lightning.errors import LONGEST

if TYPE_CHECKING:
    from ftl_lightning.learning import InversionModule

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


# The three suites


MARKERS = {
    "slow": "takes more than five seconds of work",
    "browser": "opens a page in Chromium",
    "release": "builds or installs the package, or checks types of its users",
    "notebook": "executes a notebook",
    "cluster": "starts processes that exchange gradients, or a Ray cluster",
    "fuzz": "reads damaged and hostile input by the hundred",
}
"""Kinds of tests that are not in ``make test``."""


def pytest_configure(config: pytest.Config) -> None:
    for name, what in MARKERS.items():
        config.addinivalue_line("markers", f"{name}: {what}; not in `make test`")


def marked(item: pytest.Item) -> list[str]:
    """The markers of a test that keep it out of ``make test``."""
    return [name for name in MARKERS if item.get_closest_marker(name)]


LEFT_OUT, SECONDS = pytest.StashKey[Counter[str]](), pytest.StashKey[float]()
LIMIT = 5.0
"""Seconds of work of a test without a marker: of processors, child processes included, and of ``time.sleep``.

Nothing here looks at the clock on the wall, which goes on while a machine does something else.
"""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with the most marked tests first, since a file is the work of one process: so all end at about the same time."""
    heavy = Counter(item.path for item in items if marked(item))
    items.sort(key=lambda item: (-heavy[item.path], item.path))


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Count what a marker leaves out, by its marker."""
    for item in items:
        item.config.stash.setdefault(LEFT_OUT, Counter()).update(marked(item)[:1])


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the counts to the process that prints."""
    if output := getattr(session.config, "workeroutput", None):
        output["left out"] = dict(session.config.stash.get(LEFT_OUT, Counter()))


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the counts of a process; those of all processes are the same."""
    node.config.stash[LEFT_OUT] = Counter(getattr(node, "workeroutput", {}).get("left out", {}))


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print how many tests were left out, and how to run them."""
    if config.option.markexpr and (left := config.stash.get(LEFT_OUT, Counter[str]())):
        kinds = ", ".join(f"{count} {name}" for name, count in left.most_common())
        terminalreporter.write_line(f"{left.total()} tests left out ({kinds}): `make test-all` runs all, `pytest -m NAME` one kind")


def work() -> float:
    """Seconds of work that this process and the child processes that ended have done."""
    return sum(os.times()[:4]) + slept[0]


slept = [0.0]
sleep = time.sleep


def counted(seconds: float) -> None:
    slept[0] += seconds
    sleep(seconds)


time.sleep = counted


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Measure the work of a test's fixtures, which are made for the first test that needs them."""
    item.stash[SECONDS] = work()
    return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Measure the work of a test."""
    item.stash[SECONDS] = work()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[pytest.TestReport]:
    """Fail a test that takes long and has no marker."""
    report: pytest.TestReport = yield
    seconds = work() - item.stash[SECONDS]
    if call.when != "teardown" and report.passed and seconds > LIMIT and not marked(item):
        expected = f"at most {LIMIT:.0f} s of work, or one of the markers {', '.join(MARKERS)}"
        report.outcome, report.longrepr = "failed", f"{item.nodeid}: {call.when}: expected {expected}, found {seconds:.1f} s"
    return report


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Print a failure at once: a run that is stopped from outside never comes to its summary."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        print(f"\nFAILED {report.nodeid[:200]} ({report.when}, {report.duration:.0f} s)\n{report.longreprtext[-3000:]}", flush=True)


# Fixtures


@pytest.fixture(autouse=True)
def _in_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # logs and outputs of a test stay its own
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))  # no concepts of the person who runs the tests
    torch.set_num_threads(1)


Once = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Make a folder once for all processes of a test run: ``once(name, make)`` calls ``make(folder)`` in it, and returns it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"), pytest.MonkeyPatch.context() as patch:
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
            few = ["--trainer.max_steps=10", "--data.steps_per_epoch=5", "--data.batch_size=8", "--evaluation.samples=1", "--evaluation.steps=2"]
            succeed(*tiny.fit(Path(f"{domain}.yaml"), *few, "--evaluation.figures=0", "--evaluation.diversity=false"))

        return once(f"tiny_{domain}", fit) / "logs" / domain / "fit" / "pretrained"

    return model


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
