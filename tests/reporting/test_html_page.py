"""The page to watch: what is in it, and what it does in a browser."""

import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from ftl_lightning.cli import main
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.reporting.html.page import FILMS
from ftl_lightning.reporting.table import select
from tests.conftest import ROOT, refused

BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
QUIET = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
QUIET += ["--disable-component-update", "--disable-sync", "--enable-logging=stderr", "--virtual-time-budget=8000", "--dump-dom"]
ASK = """<script>
const told = { errors: [] };
addEventListener("error", (event) => told.errors.push(String(event.message)));
addEventListener("unhandledrejection", (event) => told.errors.push(String(event.reason)));
const picture = () => [...document.querySelectorAll("#wall canvas")].map((one) => one.toDataURL()).join();
const choose = (id, value) => { const box = find(id); box.value = value; box.dispatchEvent(new Event("change")); };
setTimeout(() => {
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
  document.body.dataset.told = JSON.stringify(told);
}, 1500);
</script>"""


@pytest.fixture
def page(invert: Callable[..., Path], tmp_path: Path) -> Path:
    """A page of one small evaluation, whose films are given a second frame: scenes do not move."""
    films = tmp_path / "results" / FILMS / "scenes.json"
    invert(f"--evaluation.films={films}", f"--evaluation.results={tmp_path / 'results' / 'rows.csv'}")
    content = json.loads(films.read_text())
    for shape in content["shapes"]:
        shape["points"] = twice(shape["points"])
    for task in content["tasks"]:
        for film in task["films"]:
            film["frames"] = 2
    films.write_text(json.dumps(content))
    assert main(["report", "--results", str(tmp_path / "results"), "--html", str(tmp_path / "page.html")]) == 0
    return tmp_path / "page.html"


def twice(points: str) -> str:
    """The same points in two frames, in the second one moved."""
    import base64

    import numpy as np

    at = np.frombuffer(base64.b64decode(points), dtype="<i2")
    return base64.b64encode(np.concatenate((at, at + 500)).astype("<i2").tobytes()).decode()


def test_the_page_names_no_address(page: Path) -> None:
    text = page.read_text()
    assert set(re.findall(r"\w+://[\w./]+", text)) == {"http://www.w3.org/2000/svg"}  # a name, which nothing asks for
    assert "default-src 'none'" in text


def test_the_same_results_give_the_same_page(page: Path, tmp_path: Path) -> None:
    assert main(["report", "--results", str(tmp_path / "results"), "--html", str(tmp_path / "again.html")]) == 0
    assert (tmp_path / "again.html").read_bytes() == page.read_bytes()


def test_a_file_of_something_else_is_told(page: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["report", "--results", str(tmp_path / "results"), "--html", str(tmp_path / "b.html")]
    other = tmp_path / "results" / FILMS / "other.json"
    other.write_text("{}")
    refused(capsys, arguments, "other.json", "format 1")
    for tasks in ("[{}]", "3", '[{"row": 1, "values": {}, "films": []}]'):
        other.write_text(f'{{"format": 1, "domain": "object_rearrangement", "shapes": [], "tasks": {tasks}}}')
        refused(capsys, arguments, "other.json", "as evaluation.films writes them")


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [1280, 390])
def test_in_a_browser_films_move_and_filters_filter(page: Path, tmp_path: Path, width: int) -> None:
    asking = tmp_path / "asking.html"
    asking.write_text(page.read_text().replace("</body>", f"{ASK}</body>"))
    command = [str(BROWSER), *QUIET, f"--user-data-dir={tmp_path / 'browser'}", f"--window-size={width},900", asking.as_uri()]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "CONSOLE" not in ran.stderr
    found = re.search(r'data-told="([^"]*)"', ran.stdout)
    assert found, ran.stdout[-2000:]
    told = json.loads(found[1].replace("&quot;", '"').replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))
    assert told["errors"] == []
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
