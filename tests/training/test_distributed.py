"""``fit`` in two processes: the losses of one with the doubled batch, one that writes, and one line when one of them ends."""

import multiprocessing
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.distributed import TCPStore

from ftl_lightning.cli.main import main
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import Dropout, drawn, rows_of
from ftl_lightning.training.trainer import Trainer
from tests import tiny as sizes
from tests.conftest import CONF, TINY, Once, draw_once, inversion_module, refused, started, succeed

STEPS = 50
FIT = [f"--data.steps_per_epoch={STEPS // 2}", f"--trainer.max_steps={STEPS}", "--trainer.log_every_n_steps=1"]
FIT += ["--evaluation.samples=1", "--evaluation.steps=2", "--evaluation.figures=0", "--evaluation.diversity=false"]
TWO = ["--trainer.devices=2", "--trainer.strategy=ddp"]
OURS = "object_rearrangement.yaml"
CASES = {
    OURS: ["--model.codes={share: 0.5, knots: 1}", "--model.draws=2"],
    "bc/object_rearrangement.yaml": ["--model.members=2"],
    "cvae/object_rearrangement.yaml": [],
    "driving.yaml": ["--model.view=steps", "--model.perturb=true", "--model.feature_dropout={traffic: 0.4}"],
    "in_context/agent.yaml": ["--trainer.limit_val_batches=0"],
}
"""Every method that pretrains, and everything that is random in ours; the in-context model needs observed features."""


def fit(path: str, name: str, batch_size: int) -> list[str]:
    """Arguments of a tiny fit that logs and writes to folders of a name."""
    options = [*FIT, *CASES[path], f"--data.batch_size={batch_size}", f"--trainer.logger.init_args.save_dir={name}"]
    return sizes.fit(Path(path), *options, f"--model.output={name}/model")


def logged(folder: str) -> dict[str, list[float]]:
    """Every curve of a run by its tag; of a step that was done again the later value."""
    (events,) = sorted({path.parent for path in Path(folder).rglob("events.*")})
    board = EventAccumulator(str(events))
    board.Reload()
    return {tag: [*{event.step: event.value for event in board.Scalars(tag)}.values()] for tag in board.Tags()["scalars"]}


def same(one: str, other: str) -> bool:
    """Whether two runs logged the same curves, to the rounding of sums in another order."""
    first, second = logged(one), logged(other)
    assert list(first) == list(second)
    for tag, values in first.items():
        assert second[tag] == pytest.approx(values, rel=1e-5, abs=1e-5), tag
    return True


@contextmanager
def ended(*runs: "subprocess.Popen[str]") -> Iterator[list[tuple[str, str]]]:
    """What processes wrote, after their ends; none of them outlives the block."""
    try:
        yield [run.communicate() for run in runs]
    finally:
        for run in runs:
            run.kill()


def rank(number: int, every: Sequence[tuple[list[str], str]]) -> None:
    """One of two processes, which make fits one after another; what it writes is in a file of its number."""
    names = {"MASTER_ADDR": "127.0.0.1", "NODE_RANK": "0", "WORLD_SIZE": "2", "TORCHELASTIC_USE_AGENT_STORE": "True"}
    os.environ |= names | {"LOCAL_RANK": str(number)}
    with Path(f"{number}.out").open("w") as out, Path(f"{number}.err").open("w") as err, redirect_stdout(out), redirect_stderr(err):
        for arguments, os.environ["MASTER_PORT"] in every:
            if main(arguments):
                sys.exit(1)


@pytest.fixture(scope="module")
def runs(once: Once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the logs of each case in two processes: forks of this one, since an interpreter takes longer to start."""
    # Each case has a store, at a port that the system chose: a process that is ahead joins no group that the other one leaves.
    stores = [TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False) for _ in CASES]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("two"))
        draw_once(patch, once)
        every = [([*fit(path, f"two/{path}", 4), *TWO], str(store.port)) for path, store in zip(CASES, stores, strict=True)]
        both = [multiprocessing.get_context("fork").Process(target=rank, args=(number, every)) for number in range(2)]
        for one in both:
            one.start()
        for one in both:
            one.join()
        (first, trouble), (second, more) = (
            [Path(f"{number}.{kind}").read_text() for kind in ("out", "err")] for number in range(2)
        )
        assert [one.exitcode for one in both] == [0, 0], trouble + more
        assert first.count("pretrained model: ") == len(CASES)
        assert second == ""  # one of them speaks
        assert "error" not in trouble + more
        return Path.cwd()


@pytest.mark.cluster
@pytest.mark.parametrize("path", CASES)
def test_two_processes_learn_as_one_with_the_doubled_batch(path: str, runs: Path) -> None:
    succeed(*fit(path, "one", 8))
    assert same("one", str(runs / "two" / path))
    assert len(logged("one")["loss/train"]) == STEPS
    if path != "in_context/agent.yaml":
        assert len(logged("one")["loss/val"]) == 2  # once an epoch


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


OFTEN = ["--trainer.callbacks.init_args.every_n_train_steps=8"]
CALLBACKS = """
import os, signal
import lightning.pytorch as pl
from ftl_lightning.services.errors import UserError

class Second(pl.Callback):
    def on_train_batch_start(self, trainer, *_):
        if trainer.global_rank == 1 and trainer.global_step == 12:
            self.end()

class Killed(Second):
    def end(self):
        os.kill(os.getpid(), signal.SIGKILL)

class Mistaken(Second):
    def end(self):
        raise UserError('number: expected 1, found 2')
"""
"""What ends the second process after its twelfth step, for which it exchanged gradients with the first one after its checkpoint."""


def broken(name: str) -> tuple[int, str, str]:
    """The exit code of a run whose second process ends so, and what the run writes."""
    Path("ends.py").write_text(CALLBACKS)
    run = started(*fit(OURS, name, 4), *TWO, *OFTEN, f"--trainer.callbacks+=ends.{name}", "--trust=ends")
    with ended(run) as ((told, error),):
        return run.returncode, told, error


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the logs of a run in two processes, the second of which was killed, and of an unbroken one."""
    folder = tmp_path_factory.mktemp("killed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        code, told, error = broken("Killed")
        succeed(*fit(OURS, "unbroken", 8), *OFTEN)
    assert (code, told, error.count("\n")) == (2, "", 1)
    assert error.startswith("error: trainer.devices: expected 2 processes to the end, the connection to one was lost")
    assert "--ckpt_path last" in error
    assert not (folder / "Killed" / "model").exists()
    return folder


@pytest.mark.cluster
@pytest.mark.parametrize(("processes", "batch_size"), [(2, 4), (1, 8)])
def test_a_run_whose_process_was_killed_goes_on_in_two_or_one(
    processes: int, batch_size: int, killed: Path, tmp_path: Path
) -> None:
    shutil.copytree(killed, tmp_path, dirs_exist_ok=True)
    again = [*fit(OURS, "Killed", batch_size), *OFTEN, "--ckpt_path=last"]
    if processes == 1:
        succeed(*again)
    else:
        with ended(run := started(*again, *TWO)) as ((told, error),):
            assert (run.returncode, told.count("pretrained model: "), "error" in error) == (0, 1, False), told
    assert same("unbroken", "Killed")


@pytest.mark.cluster
def test_a_mistake_in_one_process_ends_both_with_its_line() -> None:
    code, told, error = broken("Mistaken")
    assert (code, told) == (2, "")
    first, second = error.splitlines()
    assert first == "error: number: expected 1, found 2"
    assert second.startswith("error: trainer.devices: expected 2 processes to the end")


@pytest.mark.skipif(os.cpu_count() == 1, reason="one processor runs one process")
def test_what_cannot_run_in_several_processes_is_refused(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module, options = inversion_module(tiny), {"accelerator": "cpu", "devices": 2, "logger": False}
    with pytest.raises(UserError, match=r"trainer\.strategy: expected ddp for several processes, found .*MultiProcessing"):
        Trainer(**options, strategy="ddp_spawn").fit(module)
    two = Trainer(**options, strategy="ddp")
    for verb in (two.validate, two.test, two.invert):
        with pytest.raises(UserError, match=rf"trainer\.devices: expected 1 for {verb.__name__}, found 2"):
            verb(module, datamodule=None)
    test = ["test", f"--config={CONF / OURS}", *TINY, "--trainer.devices=2", f"--ckpt_path={next(tiny.parent.rglob('*.ckpt'))}"]
    refused(capsys, test, "trainer.devices: expected 1 for test, found 2")
