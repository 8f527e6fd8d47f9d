"""Runs that start at the same instant, and runs that were killed: each has its own, and nothing is lost or left behind."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from ftl_lightning.cli.main import main
from ftl_lightning.evaluation.results import add_rows, read_rows
from ftl_lightning.services import log_folder
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import atomic, write_text

from .conftest import CONF, ROOT, TINY, refused, succeed

INVERT = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), "--data.suite=validation", "--data.steps=2"]
INVERT += ["--evaluation.suites=[validation]", "--model.budget.samples=2", "--evaluation.samples=1", "--evaluation.steps=1"]
INVERT += ["--evaluation.figures=0", "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]
FIT = ["fit", "--config", str(CONF / "object_rearrangement.yaml"), *TINY]


def together(target: Callable[..., None], count: int, *arguments: Any) -> list[Any]:
    """What processes put into a queue that call a function at the same instant.

    The function is called with its number, the barrier at which all of them wait for each other, the queue and the arguments.
    """
    context = multiprocessing.get_context("fork")
    barrier, queue = context.Barrier(count), context.Queue()
    runs = [context.Process(target=target, args=(number, barrier, queue, *arguments), daemon=True) for number in range(count)]
    for run in runs:
        run.start()
    found = [queue.get(timeout=120) for _ in runs]
    for run in runs:
        run.join(timeout=120)
    assert [run.exitcode for run in runs] == [0] * count
    return found


def _invert(number: int, barrier: Any, queue: Any, tiny: Path) -> None:
    barrier.wait()
    queue.put(main([*INVERT, f"--model.pretrained={tiny}", f"--seed_everything={number}"]))


@pytest.mark.slow
def test_inversions_that_start_together_have_folders_of_their_own(tiny: Path) -> None:
    assert together(_invert, 3, tiny) == [0] * 3
    folders = sorted(Path("logs/object_rearrangement").iterdir())
    assert [folder.name for folder in folders] == ["invert", "invert_1", "invert_2"]
    assert {tuple(read_rows(folder / "results.csv")["seed"].unique()) for folder in folders} == {(0,), (1,), (2,)}
    assert len({len(list((folder / "concepts").iterdir())) for folder in folders}) == 1
    assert not list(Path("logs").rglob(log_folder.LOCK))


def _claim(number: int, barrier: Any, queue: Any, folder: Path, new: bool) -> None:
    with log_folder.run():
        barrier.wait()
        name = log_folder.claim(folder, "run", new)
        (folder / name / str(number)).touch()
        queue.put(name)
        barrier.wait()  # every run goes on until all have their folders


@pytest.mark.slow
@pytest.mark.parametrize("new", [True, False])
def test_of_twenty_that_start_at_the_same_instant_none_loses_its_folder(new: bool) -> None:
    logs = Path("deep/logs").absolute()
    assert set(together(_claim, 20, logs, new)) == {"run", *(f"run_{number}" for number in range(1, 20))}
    assert sorted(file.name for file in logs.glob("*/*")) == sorted(map(str, range(20)))


def test_a_pretraining_takes_the_folder_of_one_that_ended_and_not_of_one_that_goes_on(tmp_path: Path) -> None:
    for _ in range(2):
        with log_folder.run():
            assert log_folder.claim(tmp_path, "fit", new=False) == "fit"
            (tmp_path / "fit" / "events").touch()
    with log_folder.run():
        log_folder.hold(tmp_path / "fit")
        with log_folder.run():
            assert log_folder.claim(tmp_path, "fit", new=False) == "fit_1"
            with pytest.raises(UserError, match="fit: expected the log folder of a run that has ended"):
                log_folder.hold(tmp_path / "fit")
        assert not (tmp_path / "fit_1").exists()  # nothing was written to it


def test_what_goes_on_from_a_checkpoint_does_not_join_a_run_in_its_folder(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("logs/object_rearrangement/fit")
    with log_folder.run():
        log_folder.hold(folder)
        (folder / "events").touch()
        refused(capsys, [*FIT, "--ckpt_path=last"], f"{folder}: expected the log folder of a run that has ended")


def test_a_refused_run_leaves_no_folder(capsys: pytest.CaptureFixture[str]) -> None:
    refused(capsys, [*FIT, "--data.batch_size=0"], "data.batch_size")
    assert not Path("logs").exists()


def _add(number: int, barrier: Any, queue: Any, rows: pd.DataFrame) -> None:
    barrier.wait()
    add_rows(Path("r.csv"), rows.iloc[[number]])
    queue.put(number)


@pytest.mark.slow
def test_rows_that_are_added_together_are_all_there() -> None:
    table = read_rows(sorted((ROOT / "results").glob("agent*.csv"))[0]).iloc[:20]
    table.to_csv("all.csv", index=False)
    together(_add, 20, table)
    assert len(read_rows("r.csv")) == len(read_rows("all.csv").drop_duplicates())


def _left() -> list[str]:
    """Hidden files that a process leaves which is killed in the middle of writing ``table.md``."""
    child = os.fork()
    if not child:
        with atomic("table.md") as temporary:
            temporary.write_text("ha")
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    return sorted(path.name for path in Path().iterdir() if path.name.startswith("."))


def test_what_a_killed_process_leaves_is_removed_when_the_file_is_written_again() -> None:
    Path("other.md").write_text("whole")
    assert len(_left()) == 1
    write_text("table.md", "whole")
    assert sorted(path.name for path in Path().iterdir()) == ["other.md", "table.md"]


@pytest.mark.slow
def test_a_report_removes_what_a_killed_one_left() -> None:
    rows = (ROOT / "results" / "tabletop.csv").read_text("utf-8").splitlines(keepends=True)
    Path("rows.csv").write_text("".join(rows[:60]))
    report = ["report", "--results=rows.csv", "--out=."]
    succeed(*report)
    before = sorted(Path().rglob("*"))
    whole = next(path for path in before if path.suffix == ".md")
    (left,) = _left()
    Path(left).rename(whole.parent / left.replace("table.md", whole.name))
    succeed(*report)
    assert sorted(Path().rglob("*")) == before


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    with atomic(tmp_path / "a.md") as mine:
        mine.write_text("mine")
        writer = threading.Thread(target=write_text, args=(tmp_path / "a.md", "theirs"))
        writer.start()
        writer.join()
        assert (tmp_path / "a.md").read_text() == "theirs"
        assert mine.read_text() == "mine"
    assert (tmp_path / "a.md").read_text() == "mine"


@pytest.mark.parametrize("name", ["a" * 250 + ".md", "ü" * 120 + ".md"])
def test_a_name_that_a_file_system_just_takes_is_written(name: str) -> None:
    write_text(name, "long")
    assert [path.name for path in Path().iterdir()] == [name]


def test_a_folder_that_another_run_made_in_the_meantime_is_never_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is made, filled and let go of between the look at what is missing and the making of the folder."""
    folder = tmp_path / "fit"
    exists = Path.exists

    def filled(path: Path) -> bool:
        found = exists(path)
        if path == folder and not found:
            folder.mkdir()
            (folder / "results.csv").touch()
        return found

    monkeypatch.setattr(log_folder, "check_writable_folder", lambda path: None)
    monkeypatch.setattr(Path, "exists", filled)

    def held() -> None:
        with log_folder.run():
            log_folder.hold(folder)
            raise UserError("refused")

    with pytest.raises(UserError, match="refused"):
        held()
    assert [path.name for path in folder.iterdir()] == ["results.csv"]
