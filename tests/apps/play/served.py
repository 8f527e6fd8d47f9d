"""The program that serves a page, and questions to it as anybody may send them."""

import http.client
import json
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import quote, urlsplit

import pytest

import ftl_lightning.apps.play.application  # noqa: F401 - before the work of a test is measured
from ftl_lightning.apps.play import server
from ftl_lightning.apps.play.server import Limits, Place
from ftl_lightning.cli.main import main
from tests.conftest import environment

PATIENCE = 120.0
"""Seconds that anything may take before a test fails."""
UNNAMED = ("/api/state", "/api/open", "/api/end")
"""Questions that need no model."""


@dataclass
class Served:
    """A server that runs."""

    address: str
    """That it printed."""
    told: list[str]
    """Lines that it printed."""
    alive: Callable[[], bool]
    wait: Callable[[], int]
    """Waits for its end, and returns its exit code."""
    stop: Callable[[], object]
    """Ends it from outside."""
    seconds: float
    """From the command to the address."""
    model: str = ""
    """That questions name: the first, or the one opened last."""

    @property
    def token(self) -> str:
        return self.address.partition("token=")[2]

    @property
    def host(self) -> str:
        return urlsplit(self.address).netloc

    def ask(
        self, method: str, path: str, body: bytes | str | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, bytes, Mapping[str, str]]:
        """Status, bytes and headers of an answer; headers that are given take the place of the usual ones."""
        if not self.model and path not in UNNAMED and path.startswith("/api/"):
            self.model = self.get("/api/state")["model"]["name"]
        connection = http.client.HTTPConnection(*self.at, timeout=PATIENCE)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            usual = {"Host": self.host, "X-Token": self.token, "X-Model": quote(self.model), "Content-Type": "application/json"}
            content = body.encode() if isinstance(body, str) else body
            if content is not None:
                usual["Content-Length"] = str(len(content))
            for key, value in (usual | dict(headers or {})).items():
                if value:
                    connection.putheader(key, value)
            connection.endheaders(content)
            answer = connection.getresponse()
            return answer.status, answer.read(), {key.lower(): value for key, value in answer.getheaders()}
        finally:
            connection.close()

    @property
    def at(self) -> tuple[str, int]:
        name, _, port = self.host.partition(":")
        return name, int(port)

    def head(self, path: str, length: int) -> str:
        """Headers of a question with a body, without the empty line at their end."""
        names = {"Host": self.host, "X-Token": self.token, "X-Model": quote(self.model), "Content-Length": str(length)}
        return "".join((f"POST {path} HTTP/1.1\r\n", *(f"{name}: {value}\r\n" for name, value in names.items())))

    def send(self, sent: bytes, first: bool = False) -> None:
        """Send bytes that need not be a question, and read what comes until the server hangs up, or its first bytes."""
        with socket.create_connection(self.at, timeout=PATIENCE) as connection:
            connection.sendall(sent)
            if first:
                assert connection.recv(1000)
                return
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                pass

    def get(self, path: str) -> Any:
        return json.loads(self._content("GET", path))

    def post(self, path: str, asked: Any) -> Any:
        found = json.loads(self._content("POST", path, json.dumps(asked)))
        if path == "/api/open":
            self.model = asked["model"]
        return found

    def learn(self, name: str) -> list[Any]:
        """The lines that learning tells."""
        return [json.loads(line) for line in self._content("POST", "/api/learn", json.dumps({"name": name})).splitlines()]

    def _content(self, method: str, path: str, body: str | None = None) -> bytes:
        status, content, _ = self.ask(method, path, body)
        assert status == 200, content
        return content


@contextmanager
def here(folder: Path, *arguments: str, limits: Limits | None = None) -> Iterator[Served]:
    """Run a verb in a thread of this process, in a folder, until the block ends: all of the program but its start.

    Limits take the place of the usual ones.
    """
    begin, told, ended = monotonic(), list[str](), list[int]()
    lines = queue.SimpleQueue[str]()

    def say(*parts: object, error: bool = False) -> None:
        for one in " ".join(map(str, parts)).splitlines():
            told.append(one)
            lines.put(one)

    def run() -> None:
        ended.append(main([*arguments, "--browser", "false", "--port", "0"]))
        lines.put(f"ended with {ended}")

    def wait() -> int:
        thread.join(PATIENCE)
        return ended[0]

    thread = threading.Thread(target=run, daemon=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "say", say)
        patch.setattr(server, "Place", partial(Place, limits=limits or Limits()))
        patch.setenv("XDG_DATA_HOME", str(folder / "data"))  # no concepts of the person who runs the tests
        patch.chdir(folder)
        thread.start()
        address = lines.get(timeout=PATIENCE).removeprefix("open ")
        assert address.startswith("http"), address
        found = Served(address, told, thread.is_alive, wait, lambda: found.post("/api/end", {}), monotonic() - begin)
        try:
            yield found
        finally:
            if thread.is_alive():
                found.stop()
            assert wait() == 0


@contextmanager
def served(folder: Path, arguments: Sequence[str], verb: str = "play") -> Iterator[Served]:
    """Run the program as a person starts it, in a folder, until the block ends."""
    begin = monotonic()
    variables = environment(XDG_DATA_HOME=str(folder / "share"))
    command = [sys.executable, "-m", "ftl_lightning", verb, *arguments, "--browser", "false", "--port", "0"]
    process = subprocess.Popen(command, cwd=folder, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    told, address = list[str](), ""
    for line in process.stdout:
        told.append(line.rstrip("\n"))
        if match := re.match(r"open (http://\S+)", line):
            address = match[1]
            break
    assert address, told
    reader = threading.Thread(target=lambda: told.extend(line.rstrip("\n") for line in process.stdout or ()), daemon=True)
    reader.start()

    def wait() -> int:
        code = process.wait(PATIENCE)
        reader.join(PATIENCE)
        return code

    stop = partial(process.send_signal, signal.SIGINT)
    try:
        yield Served(address, told, lambda: process.poll() is None, wait, stop, monotonic() - begin)
    finally:
        if process.poll() is None:
            stop()
            try:
                wait()
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
