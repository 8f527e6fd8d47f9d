"""Where the page is served, and how it ends."""

import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.cli.main import main
from tests.apps.play.served import Served, here, served
from tests.conftest import refused


@pytest.mark.slow
def test_it_listens_on_this_machine_alone_and_ends_with_control_c(tmp_path: Path) -> None:
    with served(tmp_path, ["object_rearrangement"]) as server:
        assert server.host.startswith("127.0.0.1:")
        assert not [line for line in server.told if "warning" in line]
        assert server.get("/api/state")  # before it answers, Ctrl-C interrupts a program that starts
        server.stop()
        assert server.wait() == 0
    assert server.told[-1] == "ended"


def test_control_c_stops_what_runs_first(monkeypatch: pytest.MonkeyPatch) -> None:
    from uvicorn import Config, Server

    from ftl_lightning.apps.play.server import _Server

    seen: list[object] = []
    monkeypatch.setattr(Server, "handle_exit", lambda self, sig, frame: seen.append(sig))
    _Server(Config(app=lambda: None), lambda: seen.append("closed")).handle_exit(signal.SIGINT, None)
    assert seen == ["closed", signal.SIGINT]


def test_each_run_has_a_token_of_its_own_and_ends_when_it_is_told_to(tmp_path: Path) -> None:
    tokens = []
    for _ in range(2):
        with here(tmp_path, "play", "object_rearrangement") as server:
            assert server.host.startswith("127.0.0.1:")
            assert not [line for line in server.told if "warning" in line]
            tokens.append(server.token)
            server.post("/api/end", {})
            assert server.wait() == 0
        assert server.told[-1] == "ended"
    assert tokens[0] != tokens[1]
    assert min(map(len, tokens)) >= 32


def test_other_machines_are_let_in_with_a_warning_only(tmp_path: Path) -> None:
    with here(tmp_path, "play", "object_rearrangement", "--host", "0.0.0.0") as server:
        assert server.get("/api/state")["model"]["name"] == "object_rearrangement"
    assert [line for line in server.told if line.startswith("warning: other machines")]


def test_a_port_that_is_taken_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        refused(capsys, ["play", "strokes", "--browser", "false", "--port", str(port)], f"127.0.0.1:{port}", "choose another port")


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """All models that ship."""
    with here(tmp_path_factory.mktemp("every"), "play", "object_rearrangement") as found:
        yield found


def test_models_are_opened_and_what_was_done_in_each_is_kept(every: Served) -> None:
    every.post("/api/draw", {"task": "circle above square", "count": 3})
    other = every.post("/api/open", {"model": "strokes"})
    assert other["recorder"]["kind"] == "draw"
    assert not other["work"]["demonstrations"]
    back = every.post("/api/open", {"model": "object_rearrangement"})
    assert len(back["work"]["demonstrations"]) == 3


def learned(every: Served, model: str, task: str) -> dict[str, Any]:
    """Open a model, and learn from two more demonstrations of a task, its first by default; returns what is mixed, and the task."""
    state = every.post("/api/open", {"model": model})
    task = task or state["library"]["tasks"][0]
    work = every.post("/api/draw", {"task": task, "count": 2})
    assert len(work["demonstrations"]) == len(state["work"]["demonstrations"]) + 2
    assert work["demonstrations"][0]["film"]["shapes"]
    last = every.learn("mine")[-1]
    assert last["done"], last
    return {"parts": [{"id": last["concept"]["id"], "weight": 1.0, "groups": []}], "task": task}


@pytest.mark.slow
@pytest.mark.usefixtures("learns_fast")
@pytest.mark.parametrize(("model", "task"), [("agent", "go to red bowl"), ("driving", "merge"), ("tabletop", "")])
def test_every_domain_is_shown_learned_and_executed(every: Served, model: str, task: str) -> None:
    executed = every.post("/api/sample", {**learned(every, model, task), "count": 1, "execute": True})
    assert executed["samples"][0]["frames"] > 1
    assert executed["samples"][0]["told"]


@pytest.mark.usefixtures("learns_fast")
def test_a_model_is_shown_learned_and_sampled(every: Served) -> None:
    found = every.post("/api/sample", {**learned(every, "object_rearrangement", "circle above square"), "task": "", "count": 2})
    assert len(found["samples"]) == 2


def test_help_tells_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("play", "view"):
        assert main([verb, "--help"]) == 0
        assert "page" in capsys.readouterr().out
