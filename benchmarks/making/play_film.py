"""Record a film of the ``play`` page in a browser: five strokes are drawn, learned, and mixed by a slider.

    python benchmarks/making/play_film.py [--out docs/play.gif] [--pictures docs/play]

Chromium draws; ``--pictures`` also keeps pictures of the page (light and dark, a phone's size, other models) in a folder.
"""

import argparse
import io
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ftl_lightning.apps.benchmark.strokes import drawn
from ftl_lightning.evaluation.pictures import gif
from ftl_lightning.services.tensor_file import atomic

sys.path.insert(0, str(Path(__file__).parents[2]))  # the browser is that of the tests
from tests.apps.play.browser import Browser, browser
from tests.apps.play.served import served

KIND, SEED, OTHER = "heart", 5, "wave"
WINDOW, WIDTH = (1180, 800), 760
"""Of the browser, in pixels, and of the film."""
RATE, COLOURS = 8.0, 96


class Film:
    """Pictures of a page.

    Args:
        page: that is filmed.
    """

    def __init__(self, page: Browser) -> None:
        self._page = page
        self.pictures: list[NDArray[np.uint8]] = []

    def take(self, times: int = 1) -> None:
        """The page as it is, so many times."""
        whole = Image.open(io.BytesIO(self._page.driver.get_screenshot_as_png())).convert("RGB")
        height = round(whole.height * WIDTH / whole.width)
        picture = np.asarray(whole.resize((WIDTH, height), Image.Resampling.LANCZOS))
        self.pictures += [picture] * times


def mouse(page: Browser, kind: str, place: tuple[float, float]) -> None:
    """One event of the mouse."""
    event = {"type": kind, "x": place[0], "y": place[1], "button": "left", "buttons": 1, "clickCount": 1, "pointerType": "mouse"}
    page.driver.execute_cdp_cmd("Input.dispatchMouseEvent", event)


def draw(page: Browser, film: Film, stroke: NDArray[np.float32], pictures: int) -> None:
    """A stroke, filmed while it is drawn."""
    places = page.places([(float(x), float(y)) for x, y in stroke])
    mouse(page, "mousePressed", places[0])
    shown = set(np.linspace(1, len(places) - 1, pictures).round().astype(int).tolist())
    for number, place in enumerate(places[1:], start=1):
        mouse(page, "mouseMoved", place)
        time.sleep(0.01)
        if number in shown:
            film.take()
    mouse(page, "mouseReleased", places[-1])


def slide(page: Browser, film: Film, number: int, weights: Sequence[float]) -> None:
    """A slider of the mix by its number, moved and filmed."""
    for weight in weights:
        before = int(page.data("samples"))
        find = f"document.querySelectorAll('#mix input[type=range]')[{number}]"
        page.js(
            f"((one) => {{ one.value = {weight}; one.dispatchEvent(new Event('input', {{bubbles: true}})); return 1; }})({find})"
        )
        page.until(lambda seen=before: int(page.data("samples")) > seen)  # type: ignore[misc]
        film.take()


def record(page: Browser, film: Film) -> None:
    """The whole of it."""
    for number, stroke in enumerate(drawn(KIND, 5, SEED)):
        page.until(lambda: page.js("recorder.scene !== null && !recorder.busy"))
        draw(page, film, stroke, 6 if number == 0 else 2)
        if number < 4:
            page.until(lambda count=number + 1: page.count("#slots canvas") == count)  # type: ignore[misc]
            film.take()
    page.until(lambda: page.data("learning") == "yes")
    while page.data("learning") == "yes":
        film.take()
    for _ in range(12):  # samples grow
        film.take()
        time.sleep(0.05)
    page.until(lambda: page.data("again") == "no")
    film.take(6)
    page.js("(document.getElementById('mix-title').scrollIntoView(), 1)")
    time.sleep(0.5)
    page.js(f"([...document.querySelectorAll('.pick')].find((one) => one.textContent.includes('{OTHER}')).click(), 1)")
    page.until(lambda: page.count("#mix li") >= 2)
    while page.count("#mix li") > 2:  # what was there at first
        page.driver.find_element("css selector", "#mix .remove").click()
    time.sleep(0.5)
    film.take(4)
    last = page.count("#mix li") - 1
    slide(page, film, last, [0.8, 0.6, 0.4, 0.2, 0.0])
    film.take(3)
    slide(page, film, last, [0.2, 0.4, 0.6, 0.8, 1.0, 1.2])
    film.take(6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="docs/play.gif")
    parser.add_argument("--pictures", default="")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, served(Path(name), ["--pretrained", "strokes"]) as server:
        folder = Path(name)
        with browser(folder / "film", *WINDOW) as page:
            page.open(server.address)
            page.until(lambda: int(page.data("samples") or 0) > 0)
            film = Film(page)
            film.take(2)
            record(page, film)
            with atomic(options.out) as temporary:
                temporary.write_bytes(gif(film.pictures, len(film.pictures) / RATE, colours=COLOURS))
            print(options.out, len(film.pictures), "pictures", Path(options.out).stat().st_size // 1000, "kB", page.errors())
        if options.pictures:
            keep(Path(options.pictures), server.address, folder)


def keep(out: Path, address: str, folder: Path) -> None:
    """Pictures of the page after something was learned: light, dark, a phone's."""
    out.mkdir(parents=True, exist_ok=True)
    for name, width, height, dark in (("light", 1280, 1300, False), ("dark", 1280, 1300, True), ("phone", 390, 844, False)):
        with browser(folder / name, width, height, dark) as page:
            page.open(address)
            page.until(lambda page=page: int(page.data("samples") or 0) > 0)  # type: ignore[misc]
            time.sleep(2)
            page.picture(out / f"{name}.png")


if __name__ == "__main__":
    main()
