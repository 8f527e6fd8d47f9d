"""What files and options hold is cut in every error, however long it is."""

import io
import sys
from pathlib import Path

import pytest

from ftl_lightning.services.errors import LONGEST, UserError
from ftl_lightning.services.text import say
from tests.conftest import refused

LONG = "x" * 100_000


def test_errors_are_cut_where_they_are_built_and_where_they_are_printed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert str(UserError("place: expected this, found that")) == "place: expected this, found that"
    message = str(UserError(f"place: expected\n{LONG}, found that"))
    assert message.startswith("place: expected x")
    assert message.endswith("x, found that")
    assert len(message) <= LONGEST + 100
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    say("note:", LONG, "end", error=True)
    printed = sys.stderr.getvalue()
    assert printed.startswith("note: x")
    assert printed.endswith("x end\n")
    assert len(printed) <= 2 * LONGEST + 1
    monkeypatch.undo()
    say(LONG)
    assert capsys.readouterr().out == f"{LONG}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        [LONG],
        ["check", LONG],
        ["check", f"--{LONG}=1"],
        ["sample", f"--pretrained={LONG}"],
        ["generate", LONG, "--task=a"],
        ["generate", "object_rearrangement", f"--task={LONG}", "--out=x.npz"],
        ["generate", "object_rearrangement", f"--count={LONG}", "--out=x.npz"],
        ["fit", f"--config={LONG}"],
        ["fit", "--config=long.yaml"],
        ["fit", f"--data.{LONG}=3"],
        ["prepare", "mocap", f"--root={LONG}"],
        ["report", f"--results={LONG}"],
        ["concepts", LONG],
        ["explain", LONG],
    ],
    ids=lambda arguments: " ".join(arguments)[:30],
)
def test_long_options_and_keys_are_cut(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("long.yaml").write_text(f"{LONG}: 3\n")
    refused(capsys, arguments, longest=LONGEST + 110)
