"""The page to watch: what is in it, and what it does in a browser."""

import base64
import itertools
import json
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.reporting.page import FILMS
from ftl_lightning.reporting.table import select
from tests.conftest import ROOT, Once, refused, succeed

if TYPE_CHECKING:
    from tests.apps.play.browser import Browser

ASK = """
const told = {};
const picture = () => [...document.querySelectorAll("#wall canvas")].map((one) => one.toDataURL()).join();
const choose = (id, value) => { const box = find(id); box.value = value; box.dispatchEvent(new Event("change")); };
find("films").scrollIntoView();
told.lines = [...document.querySelectorAll("#wall h3")].map((one) => one.textContent);
find("time").value = 0;
find("time").dispatchEvent(new Event("input"));
const before = picture();
told.early = [...document.querySelectorAll("figcaption")].map((one) => one.textContent).join("");
step(1);
told.moved = picture() !== before;
step(1000);
told.late = document.querySelector("figcaption").textContent;
told.edges = document.querySelectorAll("figure.right, figure.wrong").length;
document.querySelector("#methods input").click();
told.fewer = [...document.querySelectorAll("#wall h3")].map((one) => one.textContent);
document.querySelector("#methods input").click();
told.tasks = [...find("task").options].map((one) => one.value);
choose("task", told.tasks.at(-1));
told.other = picture() !== before;
document.dispatchEvent(new KeyboardEvent("keydown", { key: " ", bubbles: true }));
told.playing = playing;
told.marks = document.querySelectorAll("#chart circle").length;
told.wide = document.documentElement.scrollWidth - innerWidth;
told.loaded = performance.getEntriesByType("resource").length;
return told;
"""


@pytest.fixture(scope="module")
def made(once: Once, evaluated: Path) -> Path:
    """A folder with the page of one small evaluation, whose films are given a second frame: scenes do not move."""

    def make(folder: Path) -> None:
        (folder / "results" / FILMS).mkdir(parents=True)
        shutil.copy(evaluated / "logs" / "object_rearrangement" / "invert" / "results.csv", "results/rows.csv")
        content = json.loads((evaluated / "films.json").read_text())
        for shape in content["shapes"]:
            shape["points"] = twice(shape["points"])
        for task in content["tasks"]:
            for film in task["films"]:
                film["frames"] = 2
        (folder / "results" / FILMS / "scenes.json").write_text(json.dumps(content))
        succeed("report", "--results=results", "--html=page.html")

    return once("page_to_watch", make)


def twice(points: str) -> str:
    """The same points in two frames, in the second one moved."""
    at = np.frombuffer(base64.b64decode(points), dtype="<i2")
    return base64.b64encode(np.concatenate((at, at + 500)).astype("<i2").tobytes()).decode()


def test_the_page_names_no_address_and_is_the_same_for_the_same_results(made: Path) -> None:
    text = (made / "page.html").read_text()
    assert set(re.findall(r"\w+://[\w./]+", text)) == {"http://www.w3.org/2000/svg"}  # a name, which nothing asks for
    assert "default-src 'none'" in text
    succeed("report", f"--results={made / 'results'}", "--html=again.html")
    assert Path("again.html").read_bytes() == (made / "page.html").read_bytes()


def test_a_file_of_something_else_is_told(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made / "results", "results")
    arguments, other = ["report", "--results=results", "--html=b.html"], Path("results") / FILMS / "other.json"
    other.write_text("{}")
    refused(capsys, arguments, "other.json", "format 1")
    for tasks in ("[{}]", "3", '[{"row": 1, "values": {}, "films": []}]'):
        other.write_text(f'{{"format": 1, "domain": "object_rearrangement", "shapes": [], "tasks": {tasks}}}')
        refused(capsys, arguments, "other.json", "as evaluation.films writes them")


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_in_a_browser_films_move_and_filters_filter(made: Path, chromium: "Browser", width: int) -> None:
    chromium.window(width)
    chromium.open((made / "page.html").as_uri())
    told = chromium.driver.execute_script(ASK)
    assert chromium.driver.get_log("browser") == []
    assert told["loaded"] == 0
    assert told["lines"][0] == "FTL-IGM"
    assert "random scenes" in told["lines"]
    assert told["moved"]
    assert told["early"] == ""
    assert told["late"].startswith("accuracy: ")
    assert told["edges"] > 0
    assert told["fewer"] == told["lines"][1:]
    assert len(told["tasks"]) > 1
    assert told["other"]
    assert told["playing"]
    assert told["marks"] > 0
    assert told["wide"] <= 0


FILES = sorted((ROOT / "results" / FILMS).glob("*.json"))
SAME = ("domain", "setting", "task", "method", "form", "role", "K", "omega", "demonstrations", "seed")
"""What a film and the row that it belongs to have in common."""


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_films_that_ship_belong_to_rows_of_the_results(path: Path) -> None:
    rows = read_rows(ROOT / "results")
    for task in json.loads(path.read_text())["tasks"]:
        own = select(rows, **{key: task["row"][key] for key in SAME})
        assert not own.empty, task["row"]
        for metric, value in task["values"].items():
            same = select(own, metric=metric, n=task["row"]["n"])
            # Other processors round otherwise, so that a sample may end otherwise.
            assert same.empty or (same["value"] - value).abs().min() <= 0.05, (task["row"], metric)


def test_every_method_of_every_domain_has_films() -> None:
    filmed = {(task["row"]["domain"], task["row"]["method"]) for path in FILES for task in json.loads(path.read_text())["tasks"]}
    methods = {"FTL-IGM", "BC", "CVAE", "language"}
    assert filmed >= set(itertools.product(("object_rearrangement", "agent", "driving", "mocap", "tabletop"), methods))
