"""``fit`` in two processes: the losses of one with the doubled batch, one that writes, and one line when one of them ends."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ftl_lightning.cli import main
from ftl_lightning.processes import Dropout, drawn, rows_of
from tests.conftest import CONF, ROOT, TINY, refused
from tests.learning.test_resume import DATA, NETWORK

STEPS = 50
FIT = ["--data.steps_per_epoch=25", f"--trainer.max_steps={STEPS}", "--trainer.log_every_n_steps=1", "--trainer.accelerator=cpu"]
FIT += ["--evaluation.samples=2", "--evaluation.steps=2", "--evaluation.figures=0", "--trainer.enable_progress_bar=false"]
TWO = ["--trainer.devices=2", "--trainer.strategy=ddp"]
OURS = ["--model.codes={share: 0.5, knots: 1}", "--model.draws=2"]
CASES = {
    "object_rearrangement.yaml": [*OURS, "--evaluation.samples=1"],
    "bc/object_rearrangement.yaml": ["--model.members=2"],
    "cvae/object_rearrangement.yaml": [],
    "driving.yaml": ["--model.view=steps", "--model.perturb=true", "--model.feature_dropout={traffic: 0.4}"],
    "in_context/agent.yaml": ["--trainer.limit_val_batches=0"],
}
"""Every method that pretrains, and everything that is random in ours; the in-context model needs observed features."""


def fit(path: str, name: str, batch_size: int) -> list[str]:
    """Arguments of a tiny fit that logs and writes to folders of a name."""
    domain, method = Path(path).stem, Path(path).parent.name or Path(path).stem
    options = [*FIT, *DATA[domain], *NETWORK[method], *CASES[path], f"--data.batch_size={batch_size}"]
    options += [f"--trainer.logger.init_args.save_dir={name}", f"--model.output={name}/model"]
    return ["fit", "--config", str(CONF / path), *options]


def logged(folder: str) -> dict[str, list[float]]:
    """Every curve of a run by its tag."""
    (events,) = sorted({path.parent for path in Path(folder).rglob("events.*")})
    board = EventAccumulator(str(events))
    board.Reload()
    return {tag: [event.value for event in board.Scalars(tag)] for tag in board.Tags()["scalars"]}


def environment(**more: str) -> dict[str, str]:
    """Of processes that tests start."""
    return os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | more


def started(arguments: list[str]) -> "subprocess.Popen[str]":
    """The program, as people start it."""
    command = [sys.executable, "-m", "ftl_lightning", *arguments]
    return subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ports(count: int) -> list[str]:
    """So many that nobody uses."""
    with ExitStack() as held:
        free = [held.enter_context(socket.socket()) for _ in range(count)]
        for one in free:
            one.bind(("127.0.0.1", 0))
        return [str(one.getsockname()[1]) for one in free]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the logs of each case in two processes, which fit one case after another: starting takes longer than that."""
    folder = tmp_path_factory.mktemp("two")
    # Each with a port of its own: a process that is ahead must not join the group that the other one is about to leave.
    every = [([*fit(path, f"two/{path}", 4), *TWO], port) for path, port in zip(CASES, ports(len(CASES)), strict=True)]
    script = "import os, sys\nfrom ftl_lightning.cli import main\n"
    script += f"for arguments, os.environ['MASTER_PORT'] in {every!r}:\n    if main(arguments):\n        sys.exit(1)"
    names = {"MASTER_ADDR": "127.0.0.1", "NODE_RANK": "0", "WORLD_SIZE": "2"}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", script],
            env=environment(LOCAL_RANK=str(rank), **names),
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        (first, trouble), (second, more) = (one.communicate(timeout=100) for one in both)
    finally:
        for one in both:
            one.kill()
    assert [one.returncode for one in both] == [0, 0], trouble + more
    assert first.count("pretrained model: ") == len(CASES)
    assert second == ""  # one of them speaks
    assert "error" not in trouble + more
    return folder


@pytest.mark.parametrize("path", CASES)
def test_two_processes_learn_as_one_with_the_doubled_batch(path: str, runs: Path) -> None:
    assert main(fit(path, "one", 8)) == 0
    one, two = logged("one"), logged(str(runs / "two" / path))
    assert list(one) == list(two)
    assert len(one["loss/train"]) == STEPS
    for tag, values in one.items():
        assert two[tag] == pytest.approx(values, rel=1e-5, abs=1e-5), tag
    if path != "in_context/agent.yaml":
        assert len(one["loss/val"]) == 2  # once an epoch


def test_rows_of_a_batch_get_the_numbers_that_one_process_draws_for_them() -> None:
    def numbers(count: int) -> torch.Tensor:
        return drawn(count, lambda n: torch.rand(n, 3, generator=torch.Generator().manual_seed(0)))

    def dropped(values: torch.Tensor) -> torch.Tensor:
        torch.manual_seed(0)
        return Dropout(0.5)(values)

    values = torch.arange(1.0, 13).reshape(6, 2)
    whole, mask = numbers(6), dropped(values)
    for rank in range(3):
        with rows_of(rank, 3):
            assert numbers(2).equal(whole[rank::3])
            assert dropped(values[rank::3]).equal(mask[rank::3])
    assert numbers(6).equal(whole)  # outside there is one process


LONG = [f"--trainer.max_steps={6 * STEPS}", "--trainer.callbacks.init_args.every_n_train_steps=100", "--data.steps_per_epoch=90"]
"""A run that is long enough to be killed after its first checkpoint and before its end."""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the logs of a run in two processes, the second of which was killed."""
    folder = tmp_path_factory.mktemp("killed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run = started([*fit("object_rearrangement.yaml", "killed", 4), *TWO, *LONG])
        end = time.monotonic() + 60
        while not list(Path("killed").rglob("last.ckpt")) and time.monotonic() < end and run.poll() is None:
            time.sleep(0.01)
        (second,) = map(int, Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split())
        os.kill(second, signal.SIGKILL)
        told, error = run.communicate(timeout=30)
    assert (run.returncode, told) == (2, "")
    (error,) = error.splitlines()
    assert error.startswith("error: trainer.devices: expected 2 processes to the end, process 1 ended by signal 9 (SIGKILL)")
    assert "--ckpt_path last" in error
    assert not (folder / "killed" / "model").exists()
    return folder


@pytest.mark.parametrize(("processes", "batch_size"), [(2, 4), (1, 8)])
def test_a_run_whose_process_was_killed_goes_on_in_two_or_one(
    processes: int, batch_size: int, killed: Path, tmp_path: Path
) -> None:
    shutil.copytree(killed, tmp_path, dirs_exist_ok=True)
    again = [*fit("object_rearrangement.yaml", "killed", batch_size), *LONG, "--ckpt_path=last"]
    if processes == 1:
        assert main(again) == 0
    else:
        run = started([*again, *TWO])
        told, error = run.communicate(timeout=60)
        assert (run.returncode, len(told.splitlines()), "error" in error) == (0, 1, False)
    assert main([*fit("object_rearrangement.yaml", "unbroken", 8), *LONG]) == 0
    for tag, values in logged("unbroken").items():
        assert logged("killed")[tag] == pytest.approx(values, rel=1e-5, abs=1e-5), tag


def test_a_mistake_in_one_process_ends_both_with_its_line(tmp_path: Path) -> None:
    Path("mistaken.py").write_text(
        "import lightning.pytorch as pl\nfrom ftl_lightning.errors import UserError\n"
        "class Mistaken(pl.Callback):\n"
        "    def on_train_batch_start(self, trainer, *_):\n"
        "        if trainer.global_rank == 1 and trainer.global_step == 3:\n"
        "            raise UserError('number: expected 1, found 2')\n"
    )
    run = started(
        [*fit("object_rearrangement.yaml", "mistaken", 4), *TWO, "--trainer.callbacks+=mistaken.Mistaken", "--trust=mistaken"]
    )
    told, error = run.communicate(timeout=60)
    assert (run.returncode, told, error) == (2, "", "error: number: expected 1, found 2\n")


@pytest.mark.skipif(os.cpu_count() == 1, reason="one processor runs one process")
def test_what_cannot_run_in_several_processes_is_refused(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = ["--config", str(CONF / "object_rearrangement.yaml"), *TINY, "--trainer.devices=2"]
    refused(capsys, ["fit", *base, "--trainer.strategy=ddp_spawn"], "trainer.strategy: expected ddp", "found spawn")
    checkpoint = next(tiny.parent.rglob("*.ckpt"))
    refused(capsys, ["test", *base, f"--ckpt_path={checkpoint}"], "trainer.devices: expected 1 for test, found 2")
    invert = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), f"--model.pretrained={tiny}"]
    refused(
        capsys, [*invert, "--trainer.accelerator=cpu", "--trainer.devices=2"], "trainer.devices: expected 1 for invert, found 2"
    )
