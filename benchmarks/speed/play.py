"""Run time of the ``play`` page in a browser: draw five strokes of new kinds, learn, sample, and mix.

    python benchmarks/speed/play.py [--out results/play.json] [--kinds KIND ...]

Chromium draws with a synthetic mouse. Each kind is absent from pretraining and has five hand-like strokes
(:mod:`ftl_lightning.apps.benchmark.strokes`). Samples are classified by nearest templates, independently of learning. Seconds
depend on the machine and its load.
"""

import argparse
import json
import platform
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from ftl_lightning.apps.benchmark.strokes import TEST, VALIDATION, Judge, drawn
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.concept import Concept
from ftl_lightning.services.tensor_file import write_text

sys.path.insert(0, str(Path(__file__).parents[2]))  # the browser is that of the tests
from tests.apps.play.browser import Browser, browser
from tests.apps.play.served import Served, served

SEED, SHOWN, SAMPLES = 11, 5, 100
"""Of the strokes; how many are drawn; samples that are judged."""
MOVES = 6
"""Of a slider."""


TICKED = """learning.samples.filter((film) => film.right).map((film) => {
  const shape = film.shapes.find((one) => one.kind === "way");
  return Array.from({ length: film.frames }, (_, frame) => placed(shape, film, frame)[0]);
})"""
"""Lines of the samples that the page ticks as right."""


def first_movement(page: Browser, address: str) -> float:
    """Seconds from the request of the page to the first line that draws itself on the canvas."""
    begin = time.monotonic()
    page.open(address)
    page.until(lambda: page.text("next") == "Five strokes")
    return time.monotonic() - begin


def ticked(page: Browser, judge: Judge, kind: str) -> list[bool]:
    """Whether each sample that the page ticks as right is of another kind."""
    if not (lines := page.js(TICKED)):
        return []
    return [predicted != kind for predicted in judge.kind(np.array(lines, dtype=np.float32))]


def learn(page: Browser, server: Served, kind: str) -> tuple[dict[str, float], bytes]:
    """Draw five strokes of a kind; returns seconds from the end of the last one, and the concept's file."""
    page.click("clear")
    page.until(lambda: page.count("#slots canvas") == 0)
    strokes = drawn(kind, SHOWN, SEED)
    for number, stroke in enumerate(strokes):
        page.until(lambda: page.js("recorder.scene !== null && !recorder.busy"))
        seen = int(page.data("samples") or 0)
        places = page.places([(float(x), float(y)) for x, y in stroke])
        begin = time.monotonic()
        page.drag(places)
        drawing = time.monotonic() - begin
        if number + 1 < SHOWN:
            until_count(page, number + 1)
    done = begin + drawing
    page.until(lambda: page.data("learning") == "yes" or page.count("#slots canvas") == SHOWN)
    if page.data("learning") != "yes" and page.js("!document.getElementById('learn').disabled && !recorder.busy"):
        time.sleep(0.3)  # learning waits where a stroke looks different from the others
        if page.data("learning") != "yes" and int(page.data("samples") or 0) == seen:
            page.click("learn")
    until_samples(page, seen)
    first = time.monotonic() - done
    page.until(lambda: page.data("learning") == "yes")
    page.until(lambda: page.data("learning") == "no")
    learned = time.monotonic() - done
    concept = [one for one in server.get("/api/state")["concepts"] if one["kind"] == "learned"][-1]
    content = server.ask("GET", f"/api/concept?id={concept['id']}")[1]
    return {"first samples": first, "learned": learned, "drawing": drawing}, content


def until_count(page: Browser, count: int) -> None:
    """Wait until so many demonstrations are there."""
    page.until(lambda: page.count("#slots canvas") == count)


def until_samples(page: Browser, seen: int) -> None:
    """Wait until there are samples after so many sets of them."""
    page.until(lambda: int(page.data("samples") or 0) > seen)


def slide(page: Browser) -> list[float]:
    """Seconds from a change of a weight to new samples on the page."""
    found = []
    for move in range(MOVES):
        before = int(page.data("samples"))
        script = (
            "(() => { const one = document.querySelector('#mix input[type=range]'); one.value = arguments[0];"
            " one.dispatchEvent(new Event('input', {bubbles: true})); return true; })"
        )
        begin = time.monotonic()
        page.js(f"{script.replace('arguments[0]', str(0.5 + 0.1 * move))}()")
        until_samples(page, before)
        found.append(time.monotonic() - begin)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/play.json")
    parser.add_argument("--kinds", nargs="+", default=[*VALIDATION, *TEST])
    options = parser.parse_args()
    judge, model, rows = Judge.of(), FewShot.from_pretrained("strokes"), {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        begin = time.monotonic()
        with served(folder, ["--pretrained", "strokes"]) as server, browser(folder) as page:
            started = time.monotonic()
            moved = first_movement(page, server.address)
            page.until(lambda: int(page.data("samples") or 0) > 0)
            opened = server.seconds + time.monotonic() - started
            for kind in options.kinds:
                seconds, content = learn(page, server, kind)
                wrong = ticked(page, judge, kind)
                path = folder / "concept.safetensors"
                path.write_bytes(content)
                samples = model.sample(model.load(path), SAMPLES, seed=SEED).states.numpy()
                told = {key: round(value, 2) for key, value in seconds.items()}
                told |= {"recognised": judge.rate(samples, kind), "loss": round(Concept.load(path).origin.loss, 4)}
                told["recognised, as drawn"] = judge.rate(drawn(kind, SAMPLES, SEED + 1), kind)
                told |= {"ticked": len(wrong), "wrong ticked": sum(wrong)}
                told["slider"] = round(statistics.median(slide(page)), 2)
                rows[kind] = told
                print(kind, told, flush=True)
    whole: dict[str, Any] = {
        "command": "python benchmarks/speed/play.py",
        "model": model.model.hash,
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
        "seconds from the command to samples on the page": round(opened, 2),
        "seconds from the request of the page to the first movement": round(moved, 2),
        "kinds": rows,
        "validation": _means([rows[kind] for kind in VALIDATION if kind in rows]),
        "test": _means([rows[kind] for kind in TEST if kind in rows]),
        "seconds": round(time.monotonic() - begin, 1),
    }
    write_text(options.out, json.dumps(whole, indent=2) + "\n")
    write_text(Path(options.out).with_suffix(".md"), _table(whole))


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean rate, least rate, and medians of seconds."""
    if not rows:
        return {}
    rates = np.array([row["recognised"] for row in rows])
    found = {"recognised": round(float(rates.mean()), 3), "least": round(float(rates.min()), 3)}
    found["standard error"] = round(float(rates.std(ddof=1) / len(rates) ** 0.5), 3) if len(rates) > 1 else 0.0
    for key in ("ticked", "wrong ticked"):
        found[key] = sum(row[key] for row in rows)
    for key in ("first samples", "learned", "slider"):
        found[f"{key}, seconds"] = round(statistics.median(row[key] for row in rows), 2)
    return found


def _table(whole: dict[str, Any]) -> str:
    """The same as Markdown."""
    keys = ("first samples", "learned", "slider")
    lines = ["| | recognised (least) | ticked, of these wrong | first samples | learned | slider |", "|---|---|---|---|---|---|"]
    for name in ("validation", "test"):
        if found := whole[name]:
            rate = f"{found['recognised']:.2f} ± {found['standard error']:.2f} ({found['least']:.2f})"
            cells = [f"{found[f'{key}, seconds']:.1f} s" for key in keys]
            count = sum(kind in whole["kinds"] for kind in (VALIDATION if name == "validation" else TEST))
            ticks = f"{found['ticked']}, {found['wrong ticked']}"
            lines.append(f"| {count} {name} kinds | {rate} | {ticks} | {' | '.join(cells)} |")
    opened = whole["seconds from the command to samples on the page"]
    told = "Mean ± standard error over kinds. Seconds are medians: from the end of the fifth stroke, and from the move of a slider "
    told += f"to new samples. From the command to the first samples on the page: {opened:.1f} s; from the request of the page to "
    told += f"the first movement: {whole['seconds from the request of the page to the first movement']:.1f} s."
    return "\n".join((*lines, "", told, ""))


if __name__ == "__main__":
    main()
