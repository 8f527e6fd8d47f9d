"""Where the page is served, and how it ends."""

import signal
import socket
from pathlib import Path

import pytest

from ftl_lightning.cli import main
from tests.conftest import refused
from tests.play.served import served


def test_it_listens_on_this_machine_alone_and_ends_with_control_c(tmp_path: Path) -> None:
    with served(tmp_path, ["object_rearrangement"]) as server:
        assert server.host.startswith("127.0.0.1:")
        assert not [line for line in server.told if "warning" in line]
        assert server.get("/api/state")  # before it answers, Ctrl-C interrupts a program that starts
        server.process.send_signal(signal.SIGINT)
        assert server.process.wait(20) == 0
    assert "ended\n" in server.told


def test_it_ends_when_it_is_told_to(tmp_path: Path) -> None:
    with served(tmp_path, ["object_rearrangement"]) as server:
        server.post("/api/end", {})
        assert server.process.wait(20) == 0


def test_other_machines_are_let_in_with_a_warning_only(tmp_path: Path) -> None:
    with served(tmp_path, ["object_rearrangement", "--host", "0.0.0.0"]) as server:
        assert server.get("/api/state")["model"]["name"] == "object_rearrangement"
        server.post("/api/end", {})
        server.process.wait(20)
    assert [line for line in server.told if line.startswith("warning: other machines")]


def test_a_port_that_is_taken_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        refused(capsys, ["play", "strokes", "--browser", "false", "--port", str(port)], f"127.0.0.1:{port}", "choose another port")


def test_each_run_has_a_token_of_its_own(tmp_path: Path) -> None:
    tokens = []
    for _ in range(2):
        with served(tmp_path, ["object_rearrangement"]) as server:
            tokens.append(server.token)
    assert tokens[0] != tokens[1]
    assert min(map(len, tokens)) >= 32


def test_models_are_opened_and_what_was_done_in_each_is_kept(tmp_path: Path) -> None:
    with served(tmp_path, ["object_rearrangement"]) as server:
        server.post("/api/draw", {"task": "circle above square", "count": 3})
        other = server.post("/api/open", {"model": "strokes"})
        assert other["recorder"]["kind"] == "draw"
        assert not other["work"]["demonstrations"]
        back = server.post("/api/open", {"model": "object_rearrangement"})
        assert len(back["work"]["demonstrations"]) == 3


@pytest.mark.parametrize(("model", "task"), [("agent", "go to red bowl"), ("driving", "exit"), ("tabletop", "")])
def test_every_domain_is_shown_learned_and_executed(tmp_path: Path, model: str, task: str) -> None:
    with served(tmp_path, [model]) as server:
        state = server.get("/api/state")
        task = task or state["library"]["tasks"][0]
        work = server.post("/api/draw", {"task": task, "count": 2})
        assert len(work["demonstrations"]) == 2
        assert work["demonstrations"][0]["film"]["shapes"]
        last = server.learn("mine")[-1]
        assert last["done"], last
        part = {"id": last["concept"]["id"], "weight": 1.0, "groups": []}
        executed = server.post("/api/sample", {"parts": [part], "count": 1, "execute": True, "task": task})
        assert executed["samples"][0]["frames"] > 1
        assert executed["samples"][0]["told"]


def test_help_tells_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("play", "view"):
        assert main([verb, "--help"]) == 0
        assert "page" in capsys.readouterr().out
