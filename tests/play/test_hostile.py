"""What others may send to the page's server: answered in one plain line, nothing written or run, and the server lives."""

import json
import socket
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.play.conftest import files_of
from tests.play.served import Served

SAMPLE = {"parts": [{"id": "t0", "weight": 1.0}], "count": 2}
NESTED = "[" * 100_000
TRAVERSALS = (
    "/../../../../etc/passwd",
    "/..%2f..%2f..%2fetc%2fpasswd",
    "/api/../../etc/passwd",
    "/api/%2e%2e/%2e%2e/pyproject.toml",
    "/static/page.js",
    "/pretrained/agent/config.json",
    "//etc/passwd",
    "/api/state/../../conf",
    "/api/state%00",
    "/file:///etc/passwd",
    "/.git/config",
    "/api/concept?id=../../../etc/passwd",
    "/api/demonstrations?id=..%2f..%2fetc%2fpasswd",
    "/api/thumbnail?id=" + "a" * 20_000,
)
STRANGERS = (
    {"Host": "evil.example"},
    {"Host": ""},
    {"Host": "127.0.0.1"},
    {"Host": "127.0.0.1:1"},
    {"Host": "localhost.evil.example:80"},
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "https://127.0.0.1"},
    {"Origin": "http://127.0.0.1:1"},
    {"Origin": "file://"},
    {"X-Token": ""},
    {"X-Token": "wrong"},
    {"X-Token": "a" * 10_000},
    {"X-Token": "t\xf6ken"},
)
BODIES = (
    "",
    "nothing",
    "{",
    NESTED,
    "[]",
    "null",
    "1e999",
    '"text"',
    '{"parts": []}',
    '{"parts": "t0"}',
    '{"parts": [{"id": "t0", "weight": NaN}]}',
    '{"parts": [{"id": "t0", "weight": Infinity}]}',
    '{"parts": [{"id": "t0", "weight": 1e300}]}',
    '{"parts": [{"id": "t0", "weight": "1"}]}',
    '{"parts": [{"id": "nobody"}]}',
    '{"parts": [{"id": "t0", "groups": ["arms"]}]}',
    '{"parts": [{"id": "t0"}], "count": -1}',
    '{"parts": [{"id": "t0"}], "count": 1000000000}',
    '{"parts": [{"id": "t0"}], "count": 1.5}',
    '{"parts": [{"id": "t0"}], "temperature": -1}',
    '{"parts": [{"id": "t0"}], "seed": 99999999999999999999}',
    '{"parts": [{"id": "t0"}], "task": "go"}',
    '{"parts": [{"id": "t0"}], "execute": true}',
    '{"parts": [{"id": "t0"}], "domain": "os:system"}',
    '{"parts": [{"id": "t0"}], "parts": [{"id": "t0"}]}',
    '{"parts": [' + ",".join(['{"id": "t0"}'] * 5000) + "]}",
    '{"__class__": "os.system", "args": ["touch hacked"]}',
    '{"parts": [{"id": "\\ud800"}]}',
)
OTHERS = (
    ("/api/open", '{"model": "../../etc"}'),
    ("/api/open", '{"model": "someone/model"}'),
    ("/api/open", '{"model": "package.module:DOMAIN"}'),
    ("/api/draw", "{\"task\": \"__import__('os').system('touch hacked')\"}"),
    ("/api/draw", '{"task": "circle above square", "count": 100000}'),
    ("/api/record", '{"scene": 1, "path": [[[0, 0]]], "seconds": [0]}'),
    ("/api/record", '{"scene": 987654, "path": [], "seconds": []}'),
    ("/api/record", '{"scene": 1, "path": [[[1e308, 0], [0, 0], [0, 0]]], "seconds": [0]}'),
    ("/api/record", '{"scene": 1, "path": [[[0, 0], [0]]], "seconds": [0]}'),
    ("/api/scene", '{"task": "no such task"}'),
    ("/api/remove", '{"id": 12345}'),
    ("/api/forget", '{"id": "t0"}'),
    ("/api/upload?name=five.npz", "not an archive"),
    ("/api/upload?name=..%2f..%2fhacked.npz", "PK\x03\x04"),
    ("/api/upload?name=code.py", "import os"),
    ("/api/upload?name=model.pkl", "\x80\x04"),
    ("/api/upload?name=a.safetensors", "\xff" * 64),
    ("/api/upload", ""),
)


def told_plainly(status: int, content: bytes) -> str:
    """The one line of an answer that refuses."""
    assert 400 <= status < 500, (status, content[:200])
    told = json.loads(content)["error"]
    assert told
    assert "\n" not in told
    assert "Traceback" not in told
    assert len(told) < 400
    return str(told)


def unharmed(scenes: Served) -> None:
    """The server lives, answers, and wrote nothing."""
    assert scenes.alive()
    assert scenes.post("/api/sample", SAMPLE)["samples"]
    assert files_of(scenes.folder) <= {scenes.folder / "share"}
    assert not [line for line in scenes.told if "Traceback" in line]


@pytest.mark.parametrize("headers", STRANGERS, ids=str)
def test_whoever_is_not_the_page_is_turned_away(scenes: Served, headers: dict[str, str]) -> None:
    for path in ("/api/state", "/"):
        if path == "/" and "X-Token" in headers:
            path = f"/?token={headers['X-Token'].encode('ascii', 'replace').decode()}"
        elif path == "/":
            path = f"/?token={scenes.token}"
        status, content, _ = scenes.ask("GET", path, headers=headers)
        if status != 400:  # a request without a host is none
            assert status == 403
            told_plainly(status, content)
    assert scenes.alive()


def test_a_question_is_not_answered_to_another_origin(scenes: Served) -> None:
    status, _, headers = scenes.ask("OPTIONS", "/api/sample", headers={"Origin": "http://evil.example"})
    assert status == 403
    assert not [name for name in headers if name.startswith("access-control")]


@pytest.mark.parametrize("path", TRAVERSALS, ids=lambda path: path[:30])
def test_no_file_is_read(scenes: Served, path: str) -> None:
    status, content, _ = scenes.ask("GET", path)
    told_plainly(status, content)
    assert b"root:" not in content


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body[:40])
def test_a_damaged_question_is_told_in_one_line(scenes: Served, body: str) -> None:
    status, content, _ = scenes.ask("POST", "/api/sample", body.encode("utf-8", "surrogatepass"))
    told_plainly(status, content)


@pytest.mark.parametrize(("path", "body"), OTHERS, ids=str)
def test_what_is_none_is_refused(scenes: Served, path: str, body: str) -> None:
    scenes.post("/api/scene", {})
    status, content, _ = scenes.ask("POST", path, body.encode("latin-1"))
    told_plainly(status, content)


@pytest.mark.parametrize("name", ["", "x" * 10_000, "a\x00b", "a\nb"])
def test_a_name_is_a_short_text(scenes: Served, name: str) -> None:
    status, content, _ = scenes.ask("POST", "/api/learn", json.dumps({"name": name}))
    told_plainly(status, content)


def test_huge_bodies_are_refused_before_they_are_read(scenes: Served) -> None:
    for path, told in (("/api/sample", 10**9), ("/api/upload?name=a.npz", 10**12)):
        status, content, _ = scenes.ask("POST", path, headers={"Content-Length": str(told)})
        assert status == 413
        told_plainly(status, content)
    status, content, _ = scenes.ask("POST", "/api/sample", b"[" + b"1," * 3_000_000 + b"1]")
    assert status == 413
    unharmed(scenes)


@pytest.mark.parametrize("length", ["-1", "abc", "1, 2", "9" * 400])
def test_a_length_that_is_none(scenes: Served, length: str) -> None:
    try:
        status, _, _ = scenes.ask("POST", "/api/sample", headers={"Content-Length": length})
    except ConnectionError:
        pass
    else:
        assert 400 <= status < 500
    assert scenes.alive()


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"\x00" * 1000,
        b"GET / HTTP/1.1\r\n",
        b"\x16\x03\x01\x02\x00",
        b"GET / HTTP/9.9\r\n\r\n",
        b"A" * 200_000,
        b"GET / HTTP/1.1\r\nHost: x\r\n" + b"X: y\r\n" * 5000 + b"\r\n",
        b"POST /api/sample HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    ],
)
def test_what_is_no_question(scenes: Served, sent: bytes) -> None:
    name, _, port = scenes.host.partition(":")
    with socket.create_connection((name, int(port)), timeout=10) as connection:
        try:
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                pass
        except OSError:
            pass
    assert scenes.alive()


def test_floods_are_answered(scenes: Served) -> None:
    def ask(number: int) -> int:
        try:
            if number % 2:
                return scenes.ask("POST", "/api/sample", json.dumps(SAMPLE))[0]
            return scenes.ask("GET", "/api/state", headers={"X-Token": "wrong"})[0]
        except OSError:  # a connection more than are taken at a time
            return 0

    with ThreadPoolExecutor(64) as pool:
        found = list(pool.map(ask, range(1000)))
    assert set(found) <= {0, 200, 403, 429, 503}
    assert found.count(200) > 10
    unharmed(scenes)


def test_whoever_leaves_in_the_middle_of_learning_stops_it(scenes: Served) -> None:
    scenes.post("/api/draw", {"task": "circle above square", "count": 3})
    body = json.dumps({"name": "left"})
    name, _, port = scenes.host.partition(":")
    with socket.create_connection((name, int(port)), timeout=10) as connection:
        head = f"POST /api/learn HTTP/1.1\r\nHost: {scenes.host}\r\nX-Token: {scenes.token}\r\nContent-Length: {len(body)}\r\n\r\n"
        connection.sendall((head + body).encode())
        assert connection.recv(1000)
    unharmed(scenes)
    assert "left" not in [one["name"] for one in scenes.get("/api/state")["concepts"]]
