"""What others may send to the page's server: answered in one plain line, nothing written or run, and the server lives."""

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.igm.settings import PAPER
from tests.apps.play.conftest import files_of
from tests.apps.play.served import Served

SAMPLE = {"parts": [{"id": "t0", "weight": 1.0}], "count": 2}
TRAVERSALS = ["/../../../../etc/passwd", "/..%2f..%2f..%2fetc%2fpasswd", "/api/../../etc/passwd"]
TRAVERSALS += ["/static/page.js", "/pretrained/agent/config.json", "//etc/passwd", "/api/state/../../conf", "/api/state%00"]
TRAVERSALS += ["/file:///etc/passwd", "/.git/config", "/api/concept?id=../../../etc/passwd", "/api/%2e%2e/%2e%2e/pyproject.toml"]
TRAVERSALS += ["/api/demonstrations?id=..%2f..%2fetc%2fpasswd", "/api/thumbnail?id=" + "a" * 20_000]
HOSTS = ("evil.example", "", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:80")
ORIGINS = ("http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1", "file://")
TOKENS = ("", "wrong", "a" * 10_000, "t\xf6ken")
STRANGERS = [("Host", one) for one in HOSTS] + [("Origin", one) for one in ORIGINS] + [("X-Token", one) for one in TOKENS]
WEIGHTS = ("NaN", "Infinity", "1e300", '"1"')
KEYS = ['"count": -1', '"count": 1000000000', '"count": 1.5', '"temperature": -1', '"seed": 99999999999999999999', '"task": "go"']
KEYS += ['"execute": true', '"domain": "os:system"', '"parts": [{"id": "t0"}]']
BODIES = ["", "nothing", "{", "[" * 100_000, "[]", "null", "1e999", '"text"', '{"parts": []}', '{"parts": "t0"}']
BODIES += [f'{{"parts": [{{"id": "t0", "weight": {one}}}]}}' for one in WEIGHTS]
BODIES += ['{"parts": [{"id": "nobody"}]}', '{"parts": [{"id": "t0", "groups": ["arms"]}]}', '{"parts": [{"id": "\\ud800"}]}']
BODIES += [f'{{"parts": [{{"id": "t0"}}], {one}}}' for one in KEYS]
BODIES += ['{"parts": [' + ",".join(['{"id": "t0"}'] * 5000) + "]}", '{"__class__": "os.system", "args": ["touch hacked"]}']
MODELS = ("../../etc", "someone/model", "package.module:DOMAIN")
RECORDS = ['"scene": 1, "path": [[[0, 0]]], "seconds": [0]', '"scene": 987654, "path": [], "seconds": []']
RECORDS += [f'"scene": 1, "path": [{one}], "seconds": [0]' for one in ("[[1e308, 0], [0, 0], [0, 0]]", "[[0, 0], [0]]")]
NAMES = ("", "x" * 10_000, "a\x00b", "a\nb")
FILES = {"five.npz": "not an archive", "..%2f..%2fhacked.npz": "PK\x03\x04", "code.py": "import os"}
FILES |= {"model.pkl": "\x80\x04", "a.safetensors": "\xff" * 64}
REFUSED = [("/api/sample", body) for body in BODIES] + [("/api/open", f'{{"model": "{name}"}}') for name in MODELS]
REFUSED += [("/api/learn", json.dumps({"name": name})) for name in NAMES] + [("/api/record", f"{{{one}}}") for one in RECORDS]
REFUSED += [(f"/api/upload?name={name}", content) for name, content in FILES.items()] + [("/api/upload", "")]
REFUSED += [
    ("/api/draw", "{\"task\": \"__import__('os').system('touch hacked')\"}"),
    ("/api/draw", '{"task": "circle above square", "count": 100000}'),
    ("/api/scene", '{"task": "no such task"}'),
    ("/api/remove", '{"id": 12345}'),
    ("/api/forget", '{"id": "t0"}'),
]
LINE = b"GET / HTTP/1.1\r\n"
BROKEN = [b"", b"\x00" * 1000, LINE, b"\x16\x03\x01\x02\x00", b"GET / HTTP/9.9\r\n\r\n", b"A" * 200_000]
BROKEN += [LINE + b"Host: x\r\n" + b"X: y\r\n" * 5000 + b"\r\n"]
BROKEN += [b"POST /api/sample HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n"]


def told_plainly(status: int, content: bytes) -> str:
    """The one line of an answer that refuses."""
    assert 400 <= status < 500, (status, content[:200])
    told = json.loads(content)["error"]
    assert told
    assert "\n" not in told
    assert "Traceback" not in told
    assert len(told) < 400
    return str(told)


@pytest.fixture(autouse=True)
def _unharmed(scenes: Served) -> Iterator[None]:
    """After each test the server lives, and wrote nothing."""
    yield
    assert scenes.alive()
    assert not files_of(Path.cwd())
    assert not [line for line in scenes.told if "Traceback" in line]


def answers(scenes: Served) -> None:
    """The server does what it did before."""
    assert scenes.post("/api/sample", SAMPLE)["samples"]


@pytest.mark.parametrize(("header", "value"), STRANGERS, ids=lambda one: one[:40])
def test_whoever_is_not_the_page_is_turned_away(scenes: Served, header: str, value: str) -> None:
    token = (value if header == "X-Token" else scenes.token).encode("ascii", "replace").decode()
    for path in ("/api/state", f"/?token={token}"):
        status, content, _ = scenes.ask("GET", path, headers={header: value})
        if status != 400:  # a request without a host is none
            assert status == 403
            told_plainly(status, content)


def test_a_question_is_not_answered_to_another_origin(scenes: Served) -> None:
    status, _, headers = scenes.ask("OPTIONS", "/api/sample", headers={"Origin": "http://evil.example"})
    assert status == 403
    assert not [name for name in headers if name.startswith("access-control")]


@pytest.mark.parametrize("path", TRAVERSALS, ids=lambda path: path[:30])
def test_no_file_is_read(scenes: Served, path: str) -> None:
    status, content, _ = scenes.ask("GET", path)
    told_plainly(status, content)
    assert b"root:" not in content


@pytest.mark.parametrize(("path", "body"), REFUSED, ids=lambda one: one[:40])
def test_what_is_damaged_or_asks_for_what_is_none_is_told_in_one_line(scenes: Served, path: str, body: str) -> None:
    scenes.post("/api/scene", {})
    status, content, _ = scenes.ask("POST", path, body.encode("latin-1"))
    told_plainly(status, content)


def test_huge_bodies_are_refused_before_they_are_read(scenes: Served) -> None:
    for path, told in (("/api/sample", 10**9), ("/api/upload?name=a.npz", 10**12)):
        status, content, _ = scenes.ask("POST", path, headers={"Content-Length": str(told)})
        assert status == 413
        told_plainly(status, content)
    status, content, _ = scenes.ask("POST", "/api/sample", b"[" + b"1," * 3_000_000 + b"1]")
    assert status == 413
    answers(scenes)


@pytest.mark.parametrize("length", ["-1", "abc", "1, 2", "9" * 400])
def test_a_length_that_is_none(scenes: Served, length: str) -> None:
    try:
        status, _, _ = scenes.ask("POST", "/api/sample", headers={"Content-Length": length})
    except ConnectionError:
        pass
    else:
        assert 400 <= status < 500


@pytest.mark.parametrize("sent", BROKEN, ids=lambda sent: str(sent[:20]))
def test_what_is_no_question(scenes: Served, sent: bytes) -> None:
    with suppress(OSError):
        scenes.send(sent)
    answers(scenes)


@pytest.mark.slow
def test_floods_are_answered(scenes: Served) -> None:
    def ask(number: int) -> int:
        try:
            if number % 2:
                return scenes.ask("POST", "/api/sample", json.dumps(SAMPLE))[0]
            return scenes.ask("GET", "/api/state", headers={"X-Token": "wrong"})[0]
        except OSError:  # a connection more than are taken at a time
            return 0

    answers(scenes)  # the name of the model is known from now on
    with ThreadPoolExecutor(64) as pool:
        found = list(pool.map(ask, range(300)))
    assert set(found) <= {0, 200, 403, 429, 503}
    assert found.count(200) > 10
    answers(scenes)


def test_others_are_answered_while_a_concept_is_learned_again(scenes: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Workspace, "_settings", lambda self, quick: ({"form": PAPER}, 5) if quick else ({"tolerance": None}, 10**6))
    scenes.post("/api/draw", {"task": "circle above square", "count": 3})
    last = scenes.learn("quick")[-1]
    assert last["more"]
    key = last["concept"]["id"]
    with ThreadPoolExecutor(1) as pool:
        again = pool.submit(scenes.ask, "POST", "/api/learn", json.dumps({"again": key}))
        for _ in range(3):
            answers(scenes)  # the steps alone would take hours
        scenes.post("/api/forget", {"id": key})
        status, content, _ = again.result(timeout=60)
    assert (status, content) == (200, b"")


def test_whoever_leaves_in_the_middle_of_learning_stops_it(scenes: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Workspace, "_settings", lambda self, quick: ({"tolerance": None}, 10**6))  # steps, which nobody waits for
    scenes.post("/api/draw", {"task": "circle above square", "count": 3})
    body = json.dumps({"name": "left"})
    scenes.send(f"{scenes.head('/api/learn', len(body))}\r\n{body}".encode(), first=True)
    answers(scenes)
    assert "left" not in [one["name"] for one in scenes.get("/api/state")["concepts"]]
