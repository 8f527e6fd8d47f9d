"""A TensorBoard server on the logs answers with what the evaluator wrote."""

import json
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import environment

PATIENCE = 120
"""Seconds that the server may take to start, and to read a run."""


@pytest.fixture
def get(log: Path) -> Iterator[Callable[..., bytes]]:
    """A function that asks a server on the logs of a short inversion."""
    logs = log.parent.parent
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", str(logs), "--port", "0", "--host", "127.0.0.1"]
    with Path("told.txt").open("w") as told:
        server = subprocess.Popen([*command, "--reload_interval", "1"], stdout=told, stderr=told, env=environment())

    def ask(path: str, body: dict[str, Any] | None = None) -> bytes:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{address()}data/{path}", data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            content: bytes = answer.read()
        return content

    def address() -> str:
        return next(word for word in Path("told.txt").read_text().split() if word.startswith("http://127.0.0.1:"))

    def until(there: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not there():
            assert server.poll() is None, Path("told.txt").read_text()
            assert time.monotonic() < deadline, Path("told.txt").read_text()
            time.sleep(0.2)

    try:
        until(lambda: "http://127.0.0.1:" in Path("told.txt").read_text() and "(Press" in Path("told.txt").read_text())
        until(lambda: json.loads(ask("plugin/scalars/tags")))
        yield ask
    finally:
        server.terminate()
        server.wait()


@pytest.mark.slow
def test_the_server_answers(get: Callable[..., bytes]) -> None:
    run = "object_rearrangement/invert"
    quoted = urllib.parse.quote(run, safe="")
    scalars = json.loads(get("plugin/scalars/tags"))
    assert set(scalars) == {run}  # one run, hparams included
    assert {"loss/train", "test results/accuracy/new concept"} < set(scalars[run])
    curve = json.loads(get(f"plugin/scalars/scalars?run={quoted}&tag=loss%2Ftrain"))
    assert len(curve) == 5
    images = json.loads(get("plugin/images/tags"))
    tag = "1 pictures/new concept/square diagonal to triangle"
    assert tag in images[run]
    entry = json.loads(get(f"plugin/images/images?run={quoted}&tag={urllib.parse.quote(tag, safe='')}&sample=0"))[0]
    assert get(f"plugin/images/individualImage?{entry['query']}").startswith(b"\x89PNG")
    experiment = json.loads(get("plugin/hparams/experiment", {"experimentName": "", "hparamsLimit": 100}))
    # The tab shows the first five.
    names = [info["name"] for info in experiment["hparamInfos"]]
    assert names[:7] == ["K", "domain", "form", "method", "omega", "seed", "steps"]
    assert "with evaluation/temperature" in names
    assert "test results/accuracy/new concept" in {metric["name"]["tag"] for metric in experiment["metricInfos"]}
    projector = json.loads(get("plugin/projector/runs"))
    assert projector
    info = json.loads(get(f"plugin/projector/info?run={urllib.parse.quote(projector[0], safe='')}"))
    assert info["embeddings"][0]["tensorShape"] == [1 + 12 + 20, 384]
