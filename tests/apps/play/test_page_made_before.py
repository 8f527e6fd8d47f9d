"""The page of play without a program behind it: what is in it, and what it does in a browser with answers made before."""

import base64
import gzip
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.apps.play.page import page, request_key
from ftl_lightning.domains.pictures import path_film
from ftl_lightning.evaluation.pictures import packed

if TYPE_CHECKING:
    from tests.apps.play.browser import Browser

NONCE = "abc123"
WEIGHTS = [0, 0.5, 1, 1.5]
TEMPERATURE = 0.5

Json = dict[str, Any]


def line(points: np.ndarray, right: bool | None = None) -> Json:
    drawn = path_film(torch.as_tensor(points, dtype=torch.float32), None)
    window = [float(edge) for edge in drawn.window]
    return {"frames": drawn.frames, "rate": drawn.rate, "window": window, "shapes": packed(drawn), "right": right, "told": "ended"}


def body(height: float) -> Json:
    """A pole that sways, with a head."""
    sway = 0.3 * np.sin(np.linspace(0, 3, 30))
    at = np.stack([np.zeros((30, 3)), np.stack([sway, 0 * sway, 0 * sway + height], axis=-1)], axis=1)
    told = {"points": base64.b64encode((1000 * at).astype("<i2").tobytes()).decode(), "count": 2, "lines": [[0, 1]]}
    space = told | {"colours": ["#3f6fb5"], "heads": [[1, 0.1, "#444444"]], "rate": 30, "room": [0.75, 2.1]}
    return {"space": space, "frames": 30, "rate": 30, "right": None, "told": ""}


def state(**other: Any) -> Json:
    about = {"kind": "training", "count": None, "form": "", "accuracy": None, "hash": "0" * 16, "from": []}
    concepts = [{"id": f"c{number}", "name": name, **about} for number, name in enumerate(("line", "arc", "circle"))]
    flags = ["It is short."]
    shown = [{"id": number, "film": line(stroke), "flags": flags} for number, stroke in enumerate(strokes("heart", 5, 0))]
    same = {"python": "", "command": ""}
    return {
        "title": "strokes",
        "model": {"name": "strokes", "title": "strokes", "hash": "0" * 16},
        "models": [{"name": "strokes", "title": "strokes"}],
        "recorder": None,
        "library": {"tasks": [], "why": ""},
        "uploads": [".npz"],
        "executes": False,
        "groups": [],
        "temperature": TEMPERATURE,
        "concepts": concepts,
        "work": {
            "demonstrations": shown,
            "check": ["They are much alike."],
            "undo": False,
            "same": same,
            "wanted": 5,
            "concepts": concepts,
        },
        "viewer": None,
        "offline": {"weights": WEIGHTS, "pairs": [["c0", "c1"]]},
        **other,
    }


def made_before() -> Json:
    """Answers: a state, thumbnails, and samples of one pair with all weights."""
    one, other = (strokes(kind, 8, 0) for kind in ("line", "arc"))
    answers: Json = {"/api/state": state()} | {f"/api/thumbnail?id=c{number}": {"film": line(one[number])} for number in range(3)}
    for a in WEIGHTS:
        for b in WEIGHTS:
            parts = [{"id": name, "weight": float(weight), "groups": []} for name, weight in (("c0", a), ("c1", b))]
            asked = {"parts": parts, "count": 8, "seed": 0, "temperature": TEMPERATURE, "execute": False, "task": ""}
            films = [line(path, right=number % 2 == 0) for number, path in enumerate(a * one + b * other + 0.01)]
            same = {"python": f"{a} * line", "command": "sample"}
            told = {"samples": films, "told": f"{a} and {b}", "seconds": 0.0, "same": same}
            answers[request_key("/api/sample", asked)] = told
    return answers


def packed_page(answers: Json) -> str:
    return page(NONCE, gzip.compress(json.dumps(answers).encode(), mtime=0))


HELP = """
const done = arguments[0], told = {};
const pause = (time) => new Promise((then) => setTimeout(then, time));
const until = async (what) => { for (let waited = 0; waited < 4800 && !what(); waited++) await pause(25); };
const texts = (where) => [...document.querySelectorAll(where)].map((one) => one.textContent);
const pictures = (where) => [...document.querySelectorAll(where)].map((one) => one.toDataURL()).join();
const put = (where, value) => { where.value = value; where.dispatchEvent(new Event("input")); };
"""


def asked(page: "Browser", text: str, folder: Path, script: str, width: int = 1280) -> Json:
    """What a script tells of a page, which is as wide as its window, loads nothing and has no mistakes."""
    path = folder / "page.html"
    path.write_text(text, encoding="utf-8")
    page.window(width)
    page.driver.get_log("browser")  # of the page before
    page.driver.get(path.as_uri())
    whole = f"(async () => {{ await until(() => document.body.dataset.ready); {script} }})()"
    told = page.driver.execute_async_script(f"{HELP} {whole}.then(() => done(told), (error) => done(String(error)));")
    assert isinstance(told, dict), told
    assert page.js("document.documentElement.scrollWidth - innerWidth") <= 0
    assert page.js("performance.getEntriesByType('resource').filter((one) => !one.name.startsWith('data:'))") == []
    assert page.driver.get_log("browser") == []
    return told | {"error": page.text("error-text")}


def test_the_page_is_whole_and_names_no_address() -> None:
    for text in (page(NONCE), packed_page(made_before())):
        assert not re.search(r"%[A-Z]+%", text)
        assert set(re.findall(r"\w+://[\w./]+", text)) == {"http://www.w3.org/2000/svg"}  # a name, which nothing asks for
        assert not re.search(r"<(script|style)(?![^>]*(nonce=\"abc123\"|text/plain))", text)
        assert " style=" not in text  # which the policy forbids
    assert "Content-Security-Policy" not in page(NONCE)
    assert "default-src 'none'; script-src 'nonce-abc123'" in packed_page({})
    assert '<style nonce="%SCRIPT%">' in page("%SCRIPT%")  # what is put into the page is not looked at again


def test_the_name_of_a_request_is_that_of_the_page() -> None:
    assert request_key("/api/state") == "/api/state"
    body = {"parts": [{"id": "c0", "weight": 1.0, "groups": ["arms"]}], "temperature": 0.5, "execute": False, "task": "ü"}
    assert request_key("/api/sample", body) == (
        '/api/sample {"parts":[{"id":"c0","weight":1,"groups":["arms"]}],"temperature":0.5,"execute":false,"task":"ü"}'
    )


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_a_page_made_before_shows_samples_of_pairs(chromium: "Browser", tmp_path: Path, width: int) -> None:
    script = """
      await until(() => document.body.dataset.samples);
      told.samples = Number(document.body.dataset.samples);
      told.ready = Number(document.body.dataset.ready);
      told.hidden = ["canvas", "learning", "ways", "sampling"].filter((id) => !find(id).offsetParent);
      told.slots = document.querySelectorAll("#slots figure:not([hidden])").length;
      told.check = texts("#check li");
      told.mix = texts("#mix .name");
      told.marks = texts("#mixed .mark");
      find("mixed").scrollIntoView();  // films are drawn where they are in sight
      const canvas = document.querySelector("#mixed canvas");
      await until(() => canvas.film.near && document.body.dataset.samples);
      const before = pictures("#mixed canvas");
      put(document.querySelector("#mix input"), 1.3);
      await until(() => document.body.dataset.samples > told.samples);
      told.weights = texts("#mix output");
      told.said = find("told").textContent;
      told.python = find("python").textContent;
      told.other = pictures("#mixed canvas") !== before;
      told.same = canvas.isConnected;
      told.later = Number(document.body.dataset.samples);
      put(find("time"), 100);
      const early = pictures("#mixed canvas");
      put(find("time"), 900);
      told.moved = pictures("#mixed canvas") !== early;
      told.playing = player.playing;
      told.alone = [...document.querySelectorAll("#concepts .pick")].map((one) => one.disabled);
      if (innerWidth > 1000) await until(() => document.querySelectorAll("#concepts .filmed").length === 3);
      told.thumbnails = document.querySelectorAll("#concepts .filmed").length;
      document.querySelector("#mixed button").click();
      told.large = find("large").open;
      find("large-close").click();
    """
    told = asked(chromium, packed_page(made_before()), tmp_path, script, width)
    assert told["ready"] > 0
    assert (told["check"][0], told["check"][-1]) == ("⚠ Demonstration 1: It is short.", "They are much alike.")
    shown = {"error": "", "samples": 1, "hidden": ["canvas", "learning", "ways", "sampling"], "slots": 5, "mix": ["line", "arc"]}
    shown |= {"marks": ["✓ right", "✗ wrong"] * 4, "said": "1.5 and 1", "python": "1.5 * line", "later": 2, "large": True}
    shown |= {"weights": ["1.50", "1.00"]}  # the nearest of those that there are
    shown |= {"other": True, "same": True}  # exchanged in place, so that nothing flickers
    shown |= {"moved": True, "playing": False, "alone": [False, False, True]}
    assert {name: told[name] for name in shown} == shown
    assert width < 1000 or told["thumbnails"] == 3


@pytest.mark.browser
def test_a_request_that_has_no_answer_is_told_and_breaks_nothing(chromium: "Browser", tmp_path: Path) -> None:
    answers = {name: one for name, one in made_before().items() if '"weight":0.5' not in name}
    script = """
      await until(() => document.body.dataset.samples);
      put(document.querySelector("#mix input"), 0.5);
      await until(() => !find("error").hidden);
      told.films = texts("#mixed figure").length;
    """
    told = asked(chromium, packed_page(answers), tmp_path, script)
    assert "no samples of this choice" in told["error"]
    assert told["films"] == 8


@pytest.mark.browser
def test_a_viewer_filters_films_lays_them_over_each_other_and_turns_bodies(chromium: "Browser", tmp_path: Path) -> None:
    flags = ["It is short."]
    hearts = [{"film": line(stroke), "label": str(number), "flags": flags} for number, stroke in enumerate(strokes("heart", 3, 0))]
    poles = [{"film": body(1 + 0.2 * number), "label": str(number), "flags": []} for number in range(2)]
    groups = [{"concept": "heart", "films": hearts}, {"concept": "pole", "films": poles}]
    viewer = {"title": "five.npz", "told": ["Two concepts."], "groups": groups}
    script = """
      const concepts = () => texts("#view-films h3");
      told.play = Boolean(find("play-page").offsetParent);
      told.concepts = concepts();
      told.flags = texts("#view-films .flags li");
      told.canvases = document.querySelectorAll("#view-films canvas").length;
      find("view-over").click();
      told.over = document.querySelectorAll("#view-films canvas").length;
      find("view-over").click();
      put(find("time"), 500);
      await until(() => document.querySelector("#view-films canvas").film.near);
      const button = [...document.querySelectorAll("#view-films button")].at(-1);
      const before = button.querySelector("canvas").toDataURL();
      button.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true, cancelable: true }));
      told.turned = button.querySelector("canvas").toDataURL() !== before;
      document.querySelector("#view-concepts input").click();
      told.fewer = concepts();
      put(find("view-text"), "pole 1");
      told.one = concepts();
      told.left = films.size;
    """
    told = asked(chromium, packed_page({"/api/state": state(viewer=viewer, offline=None)}), tmp_path, script)
    shown = {"error": "", "play": False, "concepts": ["heart, 3 films", "pole, 2 films"], "canvases": 5, "over": 2, "turned": True}
    shown |= {"flags": [f"⚠ {number}: It is short." for number in range(3)], "fewer": ["pole, 2 films"], "one": ["pole, 1 film"]}
    shown |= {"left": 1}  # films that are not shown are not kept
    assert told == shown
