"""The page in a real browser, used as a person uses it."""

import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from selenium.webdriver.common.keys import Keys

from tests.play.browser import DRIVER, Browser, browser
from tests.play.served import Served, served

pytestmark = pytest.mark.skipif(not DRIVER.exists() or not shutil.which("chromium"), reason="needs Chromium and its driver")

PLACES = {0: (0.8, 4.5), 1: (1.5, 1.5), 2: (3.8, 3.8)}
"""Where circle, triangle and square are put: the square diagonal to the triangle."""


@pytest.fixture(scope="module")
def page(scenes: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Object rearrangement, after its first samples."""
    with browser(tmp_path_factory.mktemp("browser")) as found:
        opened(found, scenes)
        yield found


def opened(found: Browser, server: Served) -> Browser:
    found.open(server.address)
    found.until(lambda: int(found.data("samples") or 0) > 0)
    return found


def learned(found: Browser) -> float:
    """Wait until a concept is learned; returns the seconds."""
    waited = found.until(lambda: found.data("learning") == "yes")
    return waited + found.until(lambda: found.data("learning") == "no")


def arrange(found: Browser, touch: bool = False) -> None:
    """One demonstration by hand."""
    before = found.count("#slots canvas")
    found.until(lambda: found.js("recorder.scene !== null && !recorder.busy"))
    for piece, (x, y) in PLACES.items():
        x0, y0 = found.js(f"recorder.at[{piece}]")
        found.draw([(x0, y0), ((x0 + x) / 2, (y0 + y) / 2), (x, y), (x, y)], touch)
    found.click("keep")
    found.until(lambda: found.count("#slots canvas") > before)


def emptied(found: Browser) -> None:
    """Without demonstrations, whatever other tests have left."""
    found.until(lambda: found.data("learning") != "yes" and found.js("!recorder.busy"))
    if found.count("#slots canvas"):
        found.click("clear")
        found.until(lambda: found.count("#slots canvas") == 0)


def test_the_page_is_there_with_samples_before_anything_is_done(page: Browser) -> None:
    assert page.count("#mixed canvas") == 8
    assert page.count("#mix li") == 1
    assert not page.errors()


def test_five_arrangements_become_a_concept(page: Browser) -> None:
    emptied(page)
    for _ in range(5):
        arrange(page)
    learned(page)
    assert page.count("#samples canvas") == 8
    assert "novelty" in page.text("quality")
    assert page.count("#mix li") == 1  # alone
    assert page.js("document.querySelectorAll('#loss polyline')[0].points.length") > 10
    page.until(lambda: "model.learn(" in page.text("python"))
    assert "invert" in page.text("command")
    assert not page.errors()


def test_a_slider_changes_the_samples(page: Browser) -> None:
    slider = page.driver.find_element("css selector", "#mix input[type=range]")
    assert page.js("arguments[0].value", slider) == "1"
    before = int(page.data("samples"))
    picture = page.js("document.querySelector('#mixed canvas').toDataURL()")
    page.js("arguments[0].focus()", slider)
    page.press(*[Keys.ARROW_LEFT] * 6)
    waited = page.until(lambda: int(page.data("samples")) > before)
    page.until(lambda: page.js("document.querySelector('#mixed canvas').toDataURL()") != picture)
    assert page.js("document.querySelector('#mix input[type=range]').value") == "0.7"
    assert waited < 5  # of which seconds are told in results/play.json; this machine may be busy
    page.until(lambda: "0.7" in page.text("python"))


def test_what_was_done_is_undone_by_keys(page: Browser) -> None:
    emptied(page)
    arrange(page)
    page.click("clear")
    page.until(lambda: page.count("#slots canvas") == 0)
    page.js("document.activeElement.blur()")
    page.undo()
    page.until(lambda: page.count("#slots canvas") == 1)


def test_mistakes_are_told_and_go_away(page: Browser, tmp_path: Path) -> None:
    bad = tmp_path / "notes.npz"
    bad.write_bytes(b"nothing")
    page.js("document.getElementById('ways').open = true")
    page.driver.find_element("id", "upload").send_keys(str(bad))
    page.until(lambda: page.text("error-text"))
    assert "notes.npz" in page.text("error-text")
    page.click("error-close")
    assert page.count("#error") == 0


def test_demonstrations_come_from_the_library_too(page: Browser) -> None:
    emptied(page)
    page.js("document.getElementById('ways').open = true")
    page.js("(document.getElementById('library').value = 'circle above square')")
    page.click("draw")
    page.until(lambda: page.count("#slots canvas") == 5)
    learned(page)


def test_all_is_done_with_keys_alone(scenes: Served, tmp_path: Path) -> None:
    with browser(tmp_path) as found:
        opened(found, scenes)
        found.click("clear")
        found.until(lambda: found.count("#slots canvas") == 0)
        found.until(lambda: found.js("recorder.scene !== null && !recorder.busy"))
        before = found.js("recorder.at[0]")
        found.js("document.activeElement.blur()")
        tab_to(found, lambda: found.js("document.activeElement.closest('#handles') !== null"))
        found.press(Keys.ARROW_RIGHT, Keys.ARROW_UP)
        found.until(lambda: found.js("recorder.at[0]") != before)
        found.press(Keys.ENTER)
        found.until(lambda: found.count("#slots canvas") == 1)
        tab_to(found, lambda: found.js("document.activeElement.classList.contains('pick')"))
        count = found.count("#mix li")
        found.press(Keys.ENTER)
        found.until(lambda: found.count("#mix li") != count)


def tab_to(found: Browser, there: Callable[[], bool]) -> None:
    """Go on with the Tab key until something has the focus."""
    for _ in range(80):
        found.press(Keys.TAB)
        if there():
            return
    raise AssertionError("the Tab key does not lead there")


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_it_without_scrolling_sideways(scenes: Served, tmp_path: Path, dark: bool) -> None:
    with browser(tmp_path, 390, 844, dark) as found:
        opened(found, scenes)
        assert found.js("document.documentElement.scrollWidth") <= 390
        assert found.js("document.documentElement.dataset.theme") == ("dark" if dark else "light")
        small = "[...document.querySelectorAll('button, select, input[type=range]')].filter((one) => one.getClientRects().length"
        small += " && one.getBoundingClientRect().height < 24).map((one) => one.id || one.textContent)"
        assert not found.js(small)
        before = found.count("#slots canvas")
        arrange(found, touch=True)
        assert found.count("#slots canvas") == before + 1


def test_everything_has_a_name_for_a_screen_reader(page: Browser) -> None:
    nameless = (
        "[...document.querySelectorAll('button, input, select, canvas[role=img], a')].filter((one) => one.getClientRects().length"
        " && !(one.getAttribute('aria-label') || one.getAttribute('aria-labelledby') || one.textContent.trim() ||"
        " (one.labels && one.labels.length) || one.getAttribute('aria-hidden') === 'true')).map((one) => one.outerHTML)"
    )
    assert not page.js(nameless)
    levels = page.js(
        "[...document.querySelectorAll('h1, h2, h3')].filter((one) => one.getClientRects().length).map((one) => one.tagName)"
    )
    assert levels[0] == "H1"
    assert all(int(after[1]) - int(before[1]) <= 1 for before, after in itertools.pairwise(levels))


def test_the_program_ends_and_the_page_says_so(tmp_path: Path) -> None:
    with served(tmp_path, ["--pretrained", "object_rearrangement"]) as server, browser(tmp_path) as found:
        opened(found, server)
        server.process.terminate()
        server.process.wait(20)
        found.click("noise")
        found.until(lambda: "has ended" in found.text("error-text"))
