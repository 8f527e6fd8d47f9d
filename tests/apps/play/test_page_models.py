"""The page with several models: nothing of one is left with another, and nothing is lost without a question."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from ftl_lightning.apps.play.workspace import Workspace
from tests.apps.play.browser import Browser
from tests.apps.play.served import Served, here

pytestmark = [pytest.mark.browser, pytest.mark.usefixtures("learns_fast")]

OPENING = """(() => {
  const seen = window.seen = [];
  new MutationObserver(() => { if (opening) seen.push([find("opening").textContent, find("mixed").childElementCount,
    find("told").textContent + find("mix-name").textContent + find("python").textContent + find("command").textContent,
    find("steps").offsetHeight, find("mixing").offsetHeight].map(String)); })
    .observe(document.body, { attributes: true, childList: true, subtree: true });
  return true;
})()"""
FILMS = "[...document.querySelectorAll('#concepts .filmed canvas')].map((one) => one.film.films[0].shapes[0].colour)"


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with here(tmp_path_factory.mktemp("several"), "play") as found:
        yield found


@pytest.fixture
def page(several: Served, chromium: Browser) -> Browser:
    """All models, of which strokes is open, without the demonstrations of the test before: the server keeps them."""
    several.post("/api/open", {"model": "strokes"})
    several.post("/api/clear", {})
    return opened(chromium, several)


def opened(page: Browser, server: Served) -> Browser:
    page.window()
    page.open(server.address)
    page.sampled()
    return page


def choose(page: Browser, model: str, wait: bool = True) -> None:
    """Choose another model."""
    if page.js("state.model.name") == model:
        return
    before = int(page.data("samples"))
    put(page, "models", model, "change")
    if wait:
        page.until(lambda: page.js("state.model.name") == model and int(page.data("samples")) > before)


def front(page: Browser, tab: str) -> None:
    """Bring a tab to the front."""
    page.driver.switch_to.window(tab)
    page.driver.execute_cdp_cmd("Page.bringToFront", {})
    page.until(lambda: page.js("document.visibilityState") == "visible")


def put(page: Browser, name: str, value: Any, event: str = "input") -> None:
    """A value into an element by its id."""
    script = "((one, value, event) => { one.value = value; one.dispatchEvent(new Event(event, { bubbles: true })); })"
    page.js(f"{script}(document.getElementById(arguments[0]), arguments[1], arguments[2])", name, value, event)


def take(page: Browser) -> None:
    """Demonstrations from the library, from which learning starts by itself or is started."""
    page.js("(document.getElementById('ways').open = true)")
    page.click("draw")
    page.until(lambda: page.count("#slots canvas") == 5)
    if page.data("learning") != "yes" and page.js("learning.concept === null"):
        page.click("learn")


def test_pictures_of_concepts_are_those_of_the_model(page: Browser) -> None:
    page.js("find('concepts').scrollIntoView()")  # films are asked for where they are in sight
    page.until(lambda: len(page.js(FILMS)) >= 4)
    strokes = page.js(FILMS)
    ids = page.js("state.concepts.map((one) => one.id)")
    choose(page, "agent")
    assert set(ids) & set(page.js("state.concepts.map((one) => one.id)"))  # models give the same ids
    page.js("find('concepts').scrollIntoView()")
    page.until(lambda: len(page.js(FILMS)) == len(page.js("state.concepts")))
    assert not set(strokes) & set(page.js(FILMS))
    assert page.js("mix.cards.size === state.concepts.length")
    assert not page.errors()


def test_choices_are_those_of_the_model(page: Browser) -> None:
    choose(page, "agent")
    page.click("execute")
    page.js("(find('starts').selectedIndex = 1)")
    put(page, "count", 4, "change")
    choose(page, "strokes")
    put(page, "sought", "zigzag")
    assert 0 < page.count("#concepts .pick") < 10
    page.js("(state.concepts = state.concepts.slice(0, 5), conceptList())")
    assert page.count("#sought") == 1  # what hides concepts is never hidden itself
    choose(page, "agent")
    assert page.count("#concepts .pick") == len(page.js("state.concepts"))
    found = page.js("[find('sought').value, find('execute').checked, find('starts').value, find('count').value]")
    assert found == ["", False, "", "8"]
    assert page.count("#mixed canvas") == 8


def test_nothing_of_a_model_is_seen_while_another_one_is_opened(page: Browser) -> None:
    before = [page.js("find('steps').offsetHeight"), page.js("find('mixing').offsetHeight")]
    page.js(OPENING)
    choose(page, "object_rearrangement")
    text, films, told, steps, mixing = page.js("window.seen.at(0)")
    assert text == "The model object rearrangement is being opened …"
    assert (films, told) == ("0", "")
    assert int(steps) >= before[0]
    assert int(mixing) >= before[1]
    assert page.count("#opening") == 0
    assert page.js("find('mixing').style.minHeight") == ""
    assert page.text("mix-name") == page.js("state.concepts[0].name")
    assert not page.errors()


def test_learning_is_not_stopped_by_another_model_without_a_question(page: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        Workspace, "_settings", lambda self, quick: ({"tolerance": None}, 10**6)
    )  # steps, which end if they are stopped
    take(page)
    page.until(lambda: page.data("learning") == "yes")
    choose(page, "agent", wait=False)
    page.until(lambda: page.count("#sure") == 1)
    assert page.text("sure-text") == "Learning is not finished. Stop it and open agent?"
    page.click("sure-no")
    page.until(lambda: page.js("find('models').value") == "strokes")
    assert page.data("learning") == "yes"
    choose(page, "agent", wait=False)
    page.click("sure-yes")
    page.until(lambda: page.js("state.model.name") == "agent" and page.data("learning") == "no")
    page.until(lambda: page.count("#mixed canvas") == 8)
    assert page.count("#samples canvas") == 0
    assert page.text("error-text") == ""


def test_two_tabs_show_two_models(page: Browser, several: Served) -> None:
    windows = page.driver.switch_to
    first = page.driver.current_window_handle
    windows.new_window("tab")
    try:
        opened(page, several)
        choose(page, "agent")
        second = page.driver.current_window_handle
        front(page, first)
        page.window()
        take(page)
        page.until(lambda: page.count("#learned") == 1)
        assert "from_pretrained('strokes')" in page.js("find('python').textContent")
        assert page.text("error-text") == ""
        front(page, second)
        assert page.js("state.model.name") == "agent"
        before = int(page.data("samples"))
        page.click("noise")
        page.sampled(before)
        assert "from_pretrained('agent')" in page.js("find('python').textContent")
        assert not page.js("state.work.demonstrations.length")
        assert not page.errors()
        page.driver.close()
    finally:
        windows.window(first)


def test_the_end_is_asked_for_and_calm(chromium: Browser, tmp_path: Path) -> None:
    with here(tmp_path, "play", "--pretrained", "strokes") as server:
        page = opened(chromium, server)
        take(page)
        page.until(lambda: page.count("#learned") == 1)
        name = page.js("learning.concept.name")
        page.click("end")
        page.until(lambda: page.count("#sure") == 1)
        assert page.text("sure-text") == f"“{name}” is not saved. End the program all the same?"
        page.click("sure-no")
        assert server.alive()
        page.click("end")
        page.click("sure-yes")
        page.until(lambda: page.count("#ended") == 1)
        assert server.wait() == 0
        page.js("(performance.clearResourceTimings(), resample(), mix.waiting.push(...mix.cards.values()), thumbnails(), true)")
        page.driver.execute_async_script("setTimeout(arguments[0], 600)")
        assert page.js("performance.getEntriesByType('resource').length") == 0
        assert page.count("#error") == 0
        assert page.count("#play-page") == page.count("#player") == page.count("#end") == 0
        assert page.text("ended") == "The program has ended. You can close this page."


def test_what_is_saved_is_not_asked_for(chromium: Browser, tmp_path: Path) -> None:
    with here(tmp_path, "play", "--pretrained", "strokes") as server:
        page = opened(chromium, server)
        take(page)
        page.until(lambda: page.count("#learned") == 1)
        page.click("save")
        page.until(lambda: page.js("learning.unsaved.size") == 0)
        page.click("end")
        page.until(lambda: page.count("#ended") == 1)
        assert server.wait() == 0
