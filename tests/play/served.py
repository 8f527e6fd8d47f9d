"""The program as a person starts it, and questions to it as anybody may send them."""

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from tests.conftest import ROOT


@dataclass
class Served:
    """A server that runs.

    Attributes:
        address: that it printed.
        folder: where it runs.
        process: of it.
        told: lines that it printed.
        seconds: from the command to the address.
    """

    address: str
    folder: Path
    process: "subprocess.Popen[str]"
    seconds: float
    told: list[str] = field(default_factory=list)

    @property
    def token(self) -> str:
        return self.address.partition("token=")[2]

    @property
    def host(self) -> str:
        return urlsplit(self.address).netloc

    def ask(
        self, method: str, path: str, body: bytes | str | None = None, headers: Mapping[str, str] | None = None, timeout: float = 60
    ) -> tuple[int, bytes, Mapping[str, str]]:
        """Status, bytes and headers of an answer; headers that are given take the place of the usual ones."""
        name, _, port = self.host.partition(":")
        connection = http.client.HTTPConnection(name, int(port), timeout=timeout)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            usual = {"Host": self.host, "X-Token": self.token, "Content-Type": "application/json"}
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

    def get(self, path: str) -> Any:
        status, content, _ = self.ask("GET", path)
        assert status == 200, content
        return json.loads(content)

    def post(self, path: str, asked: Any) -> Any:
        status, content, _ = self.ask("POST", path, json.dumps(asked))
        assert status == 200, content
        return json.loads(content)

    def learn(self, name: str) -> list[Any]:
        """The lines that learning tells."""
        status, content, _ = self.ask("POST", "/api/learn", json.dumps({"name": name}), timeout=300)
        assert status == 200
        return [json.loads(line) for line in content.decode().splitlines()]

    def alive(self) -> bool:
        return self.process.poll() is None


@contextmanager
def served(folder: Path, arguments: Sequence[str], verb: str = "play") -> Iterator[Served]:
    """Run the program in a folder until the block ends."""
    begin = monotonic()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "XDG_DATA_HOME": str(folder / "share"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "ftl_lightning", verb, *arguments, "--browser", "false", "--port", "0"]
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    told: list[str] = []
    address = ""
    for line in process.stdout:
        told.append(line)
        if found := re.match(r"open (http://\S+)", line):
            address = found[1]
            break
    assert address, "".join(told)
    one = Served(address, folder, process, monotonic() - begin, told)
    reader = threading.Thread(target=lambda: told.extend(process.stdout or ()), daemon=True)
    reader.start()
    try:
        yield one
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        reader.join(5)
