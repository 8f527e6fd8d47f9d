"""Runs that start at the same instant, and runs that were killed: each has its own, and nothing is lost or left behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from ftl_lightning import log_folder
from ftl_lightning.cli import main
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.tensor_file import atomic, write_text

from .conftest import CONF, ROOT, TINY

INVERT = ["invert", "--config", str(CONF / "object_rearrangement.yaml"), "--data.steps=2", "--model.budget.samples=2"]
QUIET = ["--evaluation.samples=1", "--evaluation.steps=1", "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]


def started(*arguments: str) -> subprocess.Popen[str]:
    variables = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "ftl_lightning", *arguments]
    return subprocess.Popen(command, env=variables, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def test_inversions_that_start_together_have_folders_of_their_own(tiny: Path) -> None:
    runs = [started(*INVERT, *QUIET, f"--model.pretrained={tiny}", f"--seed_everything={seed}") for seed in range(3)]
    told = [run.communicate(timeout=300)[0] for run in runs]
    assert [run.returncode for run in runs] == [0] * 3, told
    folders = sorted(Path("logs/object_rearrangement").iterdir())
    assert [folder.name for folder in folders] == ["invert", "invert_1", "invert_2"]
    assert {tuple(read_rows(folder / "results.csv")["seed"].unique()) for folder in folders} == {(0,), (1,), (2,)}
    assert len({len(list((folder / "concepts").iterdir())) for folder in folders}) == 1
    assert not list(Path("logs").rglob(log_folder.LOCK))


def _claim_when_told(folder: Path, new: bool, go: object, found: object) -> None:
    with log_folder.run():
        go.wait()  # type: ignore[attr-defined]
        name = log_folder.claim(folder, "run", new)
        (folder / name / f"{os.getpid()}").touch()
        found.put(name)  # type: ignore[attr-defined]
        time.sleep(1)


@pytest.mark.parametrize("new", [True, False])
def test_of_twenty_that_start_at_the_same_instant_none_loses_its_folder(new: bool, tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    go, found = context.Barrier(20), context.Queue()
    runs = [context.Process(target=_claim_when_told, args=(tmp_path / "deep" / "logs", new, go, found)) for _ in range(20)]
    for run in runs:
        run.start()
    names = {found.get(timeout=60) for _ in runs}
    for run in runs:
        run.join(timeout=60)
    assert names == {"run", *(f"run_{number}" for number in range(1, 20))}
    assert all(len(list(folder.iterdir())) == 1 for folder in (tmp_path / "deep" / "logs").iterdir())


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
        assert main(["fit", "--config", str(CONF / "object_rearrangement.yaml"), *TINY, "--ckpt_path=last"]) == 2
    assert "logs/object_rearrangement/fit: expected the log folder of a run that has ended" in capsys.readouterr().err


def test_a_refused_run_leaves_no_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--config", str(CONF / "object_rearrangement.yaml"), *TINY, "--data.batch_size=0"]) == 2
    assert "data.batch_size" in capsys.readouterr().err
    assert not Path("logs").exists()


def test_rows_that_are_added_together_are_all_there(tmp_path: Path) -> None:
    results = sorted((ROOT / "results").glob("agent*.csv"))[0]
    table = read_rows(results).iloc[:20]
    table.to_csv("all.csv", index=False)
    context = multiprocessing.get_context("fork")
    runs = [context.Process(target=_add, args=(tmp_path / "r.csv", table.iloc[[number]])) for number in range(20)]
    for run in runs:
        run.start()
    for run in runs:
        run.join(timeout=60)
    assert len(read_rows(tmp_path / "r.csv")) == len(read_rows("all.csv").drop_duplicates())


def _add(path: Path, rows: pd.DataFrame) -> None:
    from ftl_lightning.evaluation.results import add_rows

    add_rows(path, rows)


def _left(write: Callable[[Path], None]) -> list[str]:
    """Hidden files that a process leaves which is killed in the middle of writing."""
    child = os.fork()
    if not child:
        with atomic("table.md") as temporary:
            write(temporary)
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    return sorted(path.name for path in Path().iterdir() if path.name.startswith("."))


def test_what_a_killed_process_leaves_is_removed_when_the_file_is_written_again() -> None:
    Path("other.md").write_text("whole")
    assert len(_left(lambda path: path.write_text("ha"))) == 1
    write_text("table.md", "whole")
    assert sorted(path.name for path in Path().iterdir()) == ["other.md", "table.md"]


def test_a_report_removes_what_a_killed_one_left(shipped: Path) -> None:
    results = ROOT / "results" / "tabletop.csv"
    assert main(["report", f"--results={results}", "--out=."]) == 0
    before = sorted(Path().rglob("*"))
    whole = next(path for path in before if path.suffix == ".md")
    whole.rename("table.md")
    (left,) = _left(lambda path: path.write_text("ha"))
    Path(left).rename(whole.parent / left.replace("table.md", whole.name))
    assert main(["report", f"--results={results}", "--out=."]) == 0
    assert sorted(path for path in Path().rglob("*") if path.name != "table.md") == before


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    with atomic(tmp_path / "a.md") as mine:
        mine.write_text("mine")
        writer = threading.Thread(target=write_text, args=(tmp_path / "a.md", "theirs"))
        writer.start()
        writer.join(timeout=30)
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

    monkeypatch.setattr(log_folder, "expect_writable_folder", lambda path: None)
    monkeypatch.setattr(Path, "exists", filled)

    def refused() -> None:
        with log_folder.run():
            log_folder.hold(folder)
            raise UserError("refused")

    with pytest.raises(UserError, match="refused"):
        refused()
    assert [path.name for path in folder.iterdir()] == ["results.csv"]
