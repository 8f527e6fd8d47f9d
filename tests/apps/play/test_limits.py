"""Nobody holds up the page's server: idle and slow connections, large questions; and each question is that of its model."""

import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.apps.play.server import Limits
from tests.apps.play.served import Served, here

POST = b"POST /api/undo HTTP/1.1\r\nHost: "
SOON = 3.0
"""Seconds in which a connection is closed after some tenths of a second, on a busy machine."""
OTHER = "127.0.0.2"
"""Another address of this machine."""


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server that waits for tenths of a second."""
    limits = Limits(connections=8, per_address=4, headers=0.2, body=0.3, idle=1)
    with here(tmp_path_factory.mktemp("quick"), "play", "object_rearrangement", limits=limits) as found:
        found.model = found.get("/api/state")["model"]["name"]
        yield found


@pytest.fixture(scope="module")
def patient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server that admits four connections of an address, and waits for long."""
    limits = Limits(connections=8, per_address=4, headers=60, body=60)
    with here(tmp_path_factory.mktemp("patient"), "play", "object_rearrangement", limits=limits) as found:
        found.model = found.get("/api/state")["model"]["name"]
        yield found


def connected(stack: ExitStack, server: Served, sent: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
    """A connection that stays open until the end of a test."""
    found = stack.enter_context(socket.create_connection(server.at, timeout=SOON, source_address=(source, 0)))
    found.sendall(sent)
    return found


def busy(stack: ExitStack, server: Served, source: str = "127.0.0.1") -> socket.socket:
    """A connection whose question is on its way."""
    return connected(stack, server, f"{server.head('/api/undo', 1000)}\r\n".encode() + b"{", source)


def all_of(connection: socket.socket) -> bytes:
    """What comes until the server hangs up."""
    content = b""
    try:
        while more := connection.recv(65536):
            content += more
    except ConnectionError:
        pass
    return content


def answer_of(content: bytes) -> tuple[int, str]:
    """Status and the line of a refusal."""
    head, _, body = content.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)["error"]


def timed(server: Served, path: str = "/api/state") -> float:
    """Seconds until a question is answered."""
    begin = time.monotonic()
    assert server.get(path)
    return time.monotonic() - begin


def test_idle_connections_do_not_block(scenes: Served) -> None:
    timed(scenes)
    with ExitStack() as stack:
        idle = [connected(stack, scenes) for _ in range(210)]
        assert timed(scenes) < 2
        partly = [connected(stack, scenes, POST) for _ in range(210)]
        assert timed(scenes) < 2
        for connection in (*idle, *partly[:100]):  # have made room
            assert not all_of(connection)


def test_connections_that_send_nothing_are_closed(quick: Served) -> None:
    with ExitStack() as stack:
        assert answer_of(all_of(connected(stack, quick))) == (408, "no request in time")


@pytest.mark.parametrize("before", [False, True])
def test_headers_in_drops_are_closed(quick: Served, before: bool) -> None:
    with ExitStack() as stack:
        connection = connected(stack, quick)
        if before:  # an answer has come before on the same connection
            connection.sendall(f"GET /api/state HTTP/1.1\r\nHost: {quick.host}\r\nX-Token: {quick.token}\r\n\r\n".encode())
            assert connection.recv(15) == b"HTTP/1.1 200 OK"
        begin = time.monotonic()
        connection.settimeout(0.05)
        content = b""
        for drop in POST * 20:
            try:
                connection.sendall(bytes([drop]))
                if not (more := connection.recv(65536)):
                    break
                content += more
            except TimeoutError:
                continue
            except ConnectionError:
                break
        assert time.monotonic() - begin < SOON
        assert b"408 Request Timeout" in content


def test_a_body_in_drops_is_refused(quick: Served) -> None:
    with ExitStack() as stack:
        assert answer_of(all_of(busy(stack, quick))) == (408, "expected a whole question within 0.3 seconds, found a part")


def test_more_busy_connections_than_are_taken_of_an_address_are_refused_in_one_line(patient: Served) -> None:
    with ExitStack() as stack:
        for _ in range(4):
            busy(stack, patient, OTHER)
        time.sleep(0.2)
        assert answer_of(all_of(connected(stack, patient, source=OTHER))) == (
            503,
            "too many connections at a time; wait for an answer",
        )
        assert timed(patient) < 2  # from this address
        with ExitStack() as mine:
            for _ in range(4):
                busy(mine, patient)
            time.sleep(0.2)
            assert answer_of(all_of(connected(stack, patient, source="127.0.0.3")))[0] == 503  # of all addresses together


def many(item: str, count: int) -> str:
    """A list in JSON, without as many objects in this process."""
    return f"[{','.join([item] * count)}]"


PLACE, LONG = "[[0.5, 0.5]]", "0.1234567890123456789"
LARGE = {
    "steps": (many(PLACE, 29_000), "[0]"),
    "more steps": (many(PLACE, 150_000), "[0]"),
    "pieces": (f"[{many('[0.5, 0.5]', 45_000)}]", "[0]"),
    "numbers": (f"[[{many(LONG, 90_000)}]]", "[0]"),
    "more numbers": (f"[[{many(LONG, 90_000)}]]", many("0", 50_000)),
    "flat": (many(LONG, 90_000), "[0]"),
    "seconds": (f"[{PLACE}]", many(LONG, 90_000)),
    "texts": (f'[[["{"a" * 900_000}", "{"a" * 900_000}"]]]', '["b"]'),
    "deeper": (f"[[[{many(LONG, 45_000)}, {many(LONG, 45_000)}]]]", "[0]"),
    "keys": (f"{{{','.join(f'{chr(34)}{number:09}{chr(34)}: 1' for number in range(90_000))}}}", "[0]"),
    "mappings": (many("{}", 90_000), "[0]"),
    "a text": (f'"{"x" * 1_900_000}"', "[0]"),
    "a number": (f"0.{'1' * 1_900_000}", "[0]"),
    "far": (many(f"[[1e9, {LONG}]]", 20_000), many(LONG, 20_000)),
}
"""Paths and seconds of .2 to 2 MB, in JSON."""


@pytest.mark.parametrize("kind", LARGE)
def test_a_large_question_holds_up_no_other(scenes: Served, kind: str) -> None:
    path, seconds = LARGE[kind]
    body = f'{{"scene": {scenes.post("/api/scene", {})["scene"]}, "path": {path}, "seconds": {seconds}}}'
    assert 2**17 < len(body) < 2**21
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(scenes.ask, "POST", "/api/record", body)
        waits = [timed(scenes)]
        while not asked.done():
            waits.append(timed(scenes))
        status, content, _ = asked.result()
    assert status == 400, content
    assert max(waits) < 3, waits  # half a second where the page has a process to itself
    assert len(content) < 400
    assert b"expected" in content


def test_a_question_of_three_megabytes_is_refused(scenes: Served) -> None:
    body = f'{{"scene": 1, "path": {many(PLACE, 260_000)}, "seconds": [0]}}'
    assert len(body) > 3e6
    status, content, _ = scenes.ask("POST", "/api/record", body)
    assert (status, json.loads(content)["error"]) == (413, "expected at most 2 MB, found more")


def test_large_questions_that_need_not_be_are_refused(scenes: Served) -> None:
    for path in ("/api/sample", "/api/learn", "/api/draw", "/api/open", "/api/undo"):
        status, content, _ = scenes.ask("POST", path, json.dumps({"name": "x" * 100_000}))
        assert (status, json.loads(content)["error"]) == (413, "expected at most 64 kB, found more")


@pytest.fixture(scope="module")
def tabs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with here(tmp_path_factory.mktemp("tabs"), "play", "object_rearrangement") as found:
        yield found


def asked(server: Served, model: str, path: str, body: Any = None) -> Any:
    """A question of a tab with a model."""
    content = None if body is None else json.dumps(body)
    status, found, _ = server.ask("GET" if body is None else "POST", path, content, {"X-Model": model})
    return json.loads(found) if status == 200 else (status, json.loads(found)["error"])


def test_two_tabs_have_a_model_each(tabs: Served) -> None:
    first, second = "object_rearrangement", "strokes"
    assert tabs.get("/api/state")["model"]["name"] == first
    task = asked(tabs, first, "/api/state")["library"]["tasks"][0]
    assert asked(tabs, first, "/api/draw", {"task": task, "count": 3})["demonstrations"]
    tabs.post("/api/open", {"model": second})  # in another tab
    state = asked(tabs, first, "/api/state")
    assert (state["model"]["name"], len(state["work"]["demonstrations"])) == (first, 3)
    assert not asked(tabs, second, "/api/state")["work"]["demonstrations"]
    scene = asked(tabs, second, "/api/scene", {})
    assert not scene["pieces"]
    assert asked(tabs, first, "/api/scene", {})["pieces"]
    assert asked(tabs, second, "/api/clear", {})["demonstrations"] == []
    assert len(asked(tabs, first, "/api/undo", {})["demonstrations"]) == 0
    assert len(asked(tabs, first, "/api/draw", {"task": task, "count": 2})["demonstrations"]) == 2
    for model in (first, second):
        sampled = asked(tabs, model, "/api/sample", {"parts": [{"id": "t0"}], "count": 1})
        assert f"from_pretrained({model!r})" in sampled["same"]["python"]
        assert asked(tabs, model, "/api/thumbnail?id=t0")["film"]["frames"] == sampled["samples"][0]["frames"]
        assert asked(tabs, model, "/api/forget", {"id": "t0"}) == (
            400,
            "id: expected a concept that was learned or opened here, found one of the model's",
        )
    assert tabs.get("/api/state")["model"]["name"] == second  # named by the helper, as opened last


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("agent", "model: expected one that is open ("),
        ("../../etc/passwd", "found '../../etc/passwd'; open it first, or reload the page"),
        ("%C3%BC", "found 'ü'; open it first, or reload the page"),
        ("x" * 5000, "; open it first, or reload the page"),
        ("", "x-model: expected the name of the model, found none; reload the page"),
    ],
)
@pytest.mark.parametrize("path", ["/api/undo", "/api/sample", "/api/learn", "/api/upload?name=a.npz", "/api/thumbnail?id=t0"])
def test_a_model_that_is_not_open_is_one_line(tabs: Served, model: str, expected: str, path: str) -> None:
    body = {"/api/sample": {"parts": [{"id": "t0"}]}, "/api/learn": {"name": "mine"}}.get(path, {})
    found = asked(tabs, model, path, None if "thumbnail" in path else body)
    if path == "/api/learn" and model:  # a stream, whose one line says so
        assert expected in found["error"]
        return
    status, told = found
    assert status == 400
    assert expected in told
    assert len(told) < 400


def test_a_model_in_a_folder_is_named_too(tmp_path: Path) -> None:
    from tests.conftest import ROOT

    folder = tmp_path / "Übung 1"
    folder.symlink_to(ROOT / "pretrained" / "object_rearrangement")
    with here(tmp_path, "play", str(folder)) as server:
        assert server.post("/api/undo", {})["demonstrations"] == []
        assert server.model == str(folder)
