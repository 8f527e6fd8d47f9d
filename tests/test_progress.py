"""Progress: lines without a terminal, one display with one."""

import io
import sys
import time

import pytest

from ftl_lightning.services import progress
from ftl_lightning.services.progress import bar


class Terminal(io.StringIO):
    """A standard error that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_work_that_reports_nothing_shows_its_seconds_in_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "WAIT", 0.01)
    with progress.waiting("loading"):
        time.sleep(0.1)
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    with progress.waiting("loading"):
        time.sleep(0.1)
    assert terminal.getvalue().startswith("\rloading, 0 s")
    assert terminal.getvalue().endswith("\r\x1b[K")


def test_without_a_terminal_there_is_a_line_at_the_start_each_tenth_and_the_end(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with bar("fit", 40) as advance:
        for step in range(40):
            advance(1, f"loss {step}")
    told = capsys.readouterr()
    lines = told.err.splitlines()
    assert told.out == ""
    assert len(lines) == 11
    assert lines[0] == "fit: 0/40"
    assert lines[1].startswith("fit: 4/40, 0:0")
    assert lines[1].endswith("loss 3")
    assert lines[-1].startswith("fit: 40 steps, 0:0")
    assert "\x1b" not in told.err


def test_a_resumed_run_counts_from_where_it_was(capsys: pytest.CaptureFixture[str]) -> None:
    with bar("fit", 10, done=8) as advance:
        advance()
        advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "fit: 8/10"
    assert lines[-1].startswith("fit: 2 steps")


def test_more_steps_than_expected_have_no_total(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with bar("learning", 2) as advance:
        for _ in range(5):
            advance()
    assert capsys.readouterr().err.splitlines()[-1].startswith("learning: 5 steps")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with bar("learning", 2) as advance:
        for _ in range(5):
            advance()
        assert progress._SCREEN.display is not None
        (task,) = progress._SCREEN.display.tasks
        assert not task.finished
        assert task.fields["steps"] == "5"


def test_what_runs_inside_of_a_bar_writes_no_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with bar("evaluation", None), bar("episodes", 10) as advance:
        advance(10)
    assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ["evaluation", "evaluation"]
    with bar("cells", 3, lines=False) as advance, bar("fit", 10) as more:
        more(10)
        advance()
    assert capsys.readouterr().err == ""


def test_what_fails_does_not_say_that_it_ended(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        with bar("fit", 10), bar("episodes", 10):
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert capsys.readouterr().err == "fit: 0/10\n"
    assert progress._Screen() == progress._SCREEN


def test_in_a_terminal_bars_share_a_display_that_is_gone_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    with bar("fit", 2) as advance:
        assert progress._SCREEN.display is not None
        with bar("episodes", 5) as more:
            more(5)
            assert [task.completed for task in progress._SCREEN.display.tasks] == [0, 5]
        advance(2, "loss 1")
        assert [task.completed for task in progress._SCREEN.display.tasks] == [2]
        assert progress._SCREEN.display.tasks[0].fields["note"] == "loss 1"
    assert progress._SCREEN.display is None
    last = terminal.getvalue().splitlines()[-1]
    assert "fit: 2 steps, 0:0" in last
    assert last.endswith("loss 1")
