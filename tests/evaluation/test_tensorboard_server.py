"""A TensorBoard server on the logs answers with what the evaluator wrote."""

import json
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def get(invert: Callable[..., Path]) -> Any:
    """A function that asks a server on the logs of a short inversion."""
    invert("--trainer.log_every_n_steps=1", "--evaluation.suites=[paper]")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = ["--logdir", "logs", "--port", str(port), "--host", "127.0.0.1", "--reload_interval", "1"]
    server = subprocess.Popen(
        [sys.executable, "-m", "tensorboard.main", *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    def ask(path: str, body: dict[str, Any] | None = None) -> bytes:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{port}/data/{path}", data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=20) as answer:
            content: bytes = answer.read()
        return content

    deadline = time.monotonic() + 60
    try:
        while True:
            try:
                if json.loads(ask("plugin/scalars/tags")):
                    break
            except OSError:
                if time.monotonic() > deadline:
                    raise
            time.sleep(0.5)
        yield ask
    finally:
        server.terminate()
        server.wait()


def test_the_server_answers(get: Callable[..., bytes]) -> None:
    run = "object_rearrangement/invert"
    quoted = urllib.parse.quote(run, safe="")
    scalars = json.loads(get("plugin/scalars/tags"))
    assert set(scalars) == {run}  # one run, hparams included
    assert {"loss/train", "test results/accuracy/new concept"} < set(scalars[run])
    curve = json.loads(get(f"plugin/scalars/scalars?run={quoted}&tag=loss%2Ftrain"))
    assert len(curve) == 5
    images = json.loads(get("plugin/images/tags"))
    tag = "pictures/new concept/square diagonal to triangle"
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
