"""The page in a real browser, used as a person uses it."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from selenium.webdriver.common.keys import Keys

from ftl_lightning.apps.play import workspace
from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.igm.settings import PAPER
from tests.apps.play.browser import Browser
from tests.apps.play.served import Served, here

pytestmark = [pytest.mark.browser, pytest.mark.usefixtures("learns_fast")]

CONTROLS = ("button", "slider", "combobox", "textbox", "searchbox", "checkbox", "switch", "image", "img")
PLACES = {0: (0.8, 4.5), 1: (1.5, 1.5), 2: (3.8, 3.8)}
"""Where circle, triangle and square are put: the square diagonal to the triangle."""
NAMELESS = """[...document.querySelectorAll('button, input, select, canvas[role=img], a')]
  .filter((one) => one.getClientRects().length
  && !(one.getAttribute('aria-label') || one.getAttribute('aria-labelledby') || one.textContent.trim()
  || (one.labels && one.labels.length) || one.getAttribute('aria-hidden') === 'true')).map((one) => one.outerHTML)"""
LEVELS = "[...document.querySelectorAll('h1, h2, h3')].filter((one) => one.getClientRects().length).map((one) => one.tagName)"
SMALL = """[...document.querySelectorAll('button, select, input[type=range]')].filter((one) => one.getClientRects().length
  && one.getBoundingClientRect().height < 24).map((one) => one.id || one.textContent)"""


@pytest.fixture
def page(scenes: Served, chromium: Browser) -> Browser:
    """Object rearrangement, after its first samples and without demonstrations."""
    return opened(chromium, scenes)


def opened(found: Browser, server: Served, width: int = 1280, height: int = 900, dark: bool = False) -> Browser:
    if server.get("/api/state")["work"]["demonstrations"]:
        server.post("/api/clear", {})
    found.window(width, height, dark)
    found.open(server.address)
    found.sampled()
    return found


def learned(found: Browser) -> None:
    """Wait until a concept is learned of what is there."""
    found.until(lambda: found.js("justLearned()"))


def arrange(found: Browser, touch: bool = False) -> None:
    """One demonstration by hand."""
    before = found.count("#slots canvas")
    found.until(lambda: found.js("recorder.scene !== null && !recorder.busy"))
    for piece, (x, y) in PLACES.items():
        x0, y0 = found.js(f"recorder.at[{piece}]")
        found.draw([(x0, y0), ((x0 + x) / 2, (y0 + y) / 2), (x, y), (x, y)], touch)
    found.click("keep")
    found.until(lambda: found.count("#slots canvas") > before)


def check_names(found: Browser) -> None:
    """Everything has a name for a screen reader, and headings leave out no level."""
    assert not found.js(NAMELESS)
    levels = found.js(LEVELS)
    assert levels[0] == "H1"
    assert all(int(after[1]) - int(before[1]) <= 1 for before, after in itertools.pairwise(levels))


def test_the_page_is_there_with_samples_before_anything_is_done(page: Browser) -> None:
    assert page.count("#mixed canvas") == 8
    assert page.count("#mix li") == 1
    assert not page.errors()
    check_names(page)


def test_five_arrangements_become_a_concept(page: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workspace, "REPORT", 0.0)  # every loss, however fast this machine is
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
    check_names(page)


def test_a_concept_is_learned_more_thoroughly_by_itself(page: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    def settings(of: Workspace, quick: bool) -> tuple[dict[str, Any], int]:
        return ({"form": PAPER}, 1) if quick else ({"form": "auto"}, 30)

    monkeypatch.setattr(Workspace, "_settings", settings)
    page.js("(document.getElementById('ways').open = true)")
    page.click("draw")
    page.until(lambda: page.data("again") == "yes")
    key = page.js("learning.concept.id")
    assert "more thoroughly" in page.text("waiting")
    page.until(lambda: page.data("again") == "no")
    assert page.text("waiting").endswith("seconds.")  # better than after one step
    assert page.js("learning.concept.id") == key
    assert "one set" not in page.js("conceptOf(learning.concept.id).form")
    page.until(lambda: "form='auto'" in page.text("python"))
    assert not page.errors()


def test_a_concept_learned_again_replaces_the_former_and_undo_brings_it_back(page: Browser) -> None:
    page.js("(document.getElementById('ways').open = true)")
    page.click("draw")
    learned(page)
    page.until(lambda: page.js("!learning.again"))
    count, key = page.js("state.concepts.length"), page.js("learning.concept.id")
    page.js("(document.querySelector('#slots .remove').click(), 1)")
    page.until(lambda: page.count("#slots canvas") == 4)
    page.click("learn")
    page.until(lambda: page.js("justLearned() && learning.concept.count === 4"))
    assert page.js("[state.concepts.length, learning.concept.id]") == [count, key]
    page.undo()
    page.until(lambda: "former one is back" in page.text("waiting"))
    assert page.js("conceptOf(arguments[0]).count", key) == 5
    page.undo()  # then the demonstration that was removed
    page.until(lambda: page.count("#slots canvas") == 5)
    assert not page.errors()


def test_a_screen_reader_reads_it_through(page: Browser) -> None:
    page.js("(document.getElementById('ways').open = true)")
    page.click("draw")
    learned(page)
    nodes = page.read_aloud()
    for node in nodes:
        assert node["name"] or node["role"] not in CONTROLS, node
    said = [node["name"] for node in nodes if node["role"] in ("heading", *CONTROLS)]
    order = [next(at for at, text in enumerate(said) if text.endswith(title)) for title in ("Show five", "Learn", "Mix")]
    assert order == sorted(order)
    assert {"main", "banner", "region", "status", "alert"} & {node["role"] for node in nodes} >= {"main", "banner", "region"}
    assert any("Sample 1 of" in node["name"] and ("right" in node["name"] or "wrong" in node["name"]) for node in nodes)
    assert len({node["name"] for node in nodes if node["role"] == "slider"}) == sum(node["role"] == "slider" for node in nodes)


def test_a_slider_changes_the_samples(page: Browser) -> None:
    slider = page.driver.find_element("css selector", "#mix input[type=range]")
    assert page.js("arguments[0].value", slider) == "1"
    before = int(page.data("samples"))
    picture = page.js("document.querySelector('#mixed canvas').toDataURL()")
    page.js("arguments[0].focus()", slider)
    page.press(*[Keys.ARROW_LEFT] * 6)
    page.sampled(before)
    page.until(lambda: page.js("document.querySelector('#mixed canvas').toDataURL()") != picture)
    assert page.js("document.querySelector('#mix input[type=range]').value") == "0.7"
    page.until(lambda: "0.7" in page.text("python"))


def test_what_was_done_is_undone_by_keys(page: Browser) -> None:
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
    page.js("document.getElementById('ways').open = true")
    page.js("(document.getElementById('library').value = 'circle above square')")
    page.click("draw")
    page.until(lambda: page.count("#slots canvas") == 5)
    learned(page)


def test_all_is_done_with_keys_alone(page: Browser) -> None:
    page.until(lambda: page.js("recorder.scene !== null && !recorder.busy"))
    before = page.js("recorder.at[0]")
    page.js("document.activeElement.blur()")
    tab_to(page, lambda: page.js("document.activeElement.closest('#handles') !== null"))
    page.press(Keys.ARROW_RIGHT, Keys.ARROW_UP)
    page.until(lambda: page.js("recorder.at[0]") != before)
    page.press(Keys.ENTER)
    page.until(lambda: page.count("#slots canvas") == 1)
    tab_to(page, lambda: page.js("document.activeElement.classList.contains('pick')"))
    count = page.count("#mix li")
    page.press(Keys.ENTER)
    page.until(lambda: page.count("#mix li") != count)


def tab_to(found: Browser, there: Callable[[], bool]) -> None:
    """Go on with the Tab key until something has the focus."""
    for _ in range(80):
        found.press(Keys.TAB)
        if there():
            return
    raise AssertionError("the Tab key does not lead there")


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_it_without_scrolling_sideways(scenes: Served, chromium: Browser, dark: bool) -> None:
    found = opened(chromium, scenes, 390, 844, dark)
    assert found.js("document.documentElement.scrollWidth") <= 390
    assert found.js("document.documentElement.dataset.theme") == ("dark" if dark else "light")
    assert not found.js(SMALL)
    arrange(found, touch=True)
    assert found.count("#slots canvas") == 1


def test_the_program_ends_and_the_page_says_so(chromium: Browser, tmp_path: Path) -> None:
    with here(tmp_path, "play", "--pretrained", "object_rearrangement") as server:
        opened(chromium, server)
        server.stop()
        assert server.wait() == 0
    chromium.click("noise")
    chromium.until(lambda: "has ended" in chromium.text("error-text"))
