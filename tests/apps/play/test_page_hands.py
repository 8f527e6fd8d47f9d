"""The page in the hands of a person: pointer and keys together, demonstrations that look wrong, learned concepts."""

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from selenium.webdriver.common.keys import Keys

from tests.apps.play.browser import Browser
from tests.apps.play.served import here

pytestmark = [pytest.mark.browser, pytest.mark.usefixtures("learns_fast")]

TAP = """((key) => {
  for (const kind of ["keydown", "keyup"])
    document.activeElement.dispatchEvent(new KeyboardEvent(kind, { key, bubbles: true, cancelable: true }));
})(arguments[0])"""
"""A key that is let go before anything is drawn."""


@pytest.fixture(scope="module")
def strokes(tmp_path_factory: pytest.TempPathFactory, chromium: Browser) -> Iterator[Browser]:
    with here(tmp_path_factory.mktemp("strokes"), "play", "--pretrained", "strokes") as server:
        chromium.window()
        chromium.open(server.address)
        chromium.sampled()
        yield chromium


def stroke(page: Browser, bend: float = 0.0, touch: bool = False) -> None:
    """A line from left to right, bent."""
    page.until(lambda: page.js("recorder.scene !== null && !recorder.busy"))
    before = page.count("#slots canvas")
    left, lower, width, height = page.js("recorder.scene.film.window")
    at = [(0.2 + 0.03 * step, 0.4 + bend * (1 - ((step - 10) / 10) ** 2)) for step in range(21)]
    page.draw([(left + x * width, lower + y * height) for x, y in at], touch)
    page.until(lambda: page.count("#slots canvas") == before + 1)


def cleared(page: Browser) -> None:
    if page.count("#slots canvas"):
        page.click("clear")
        page.until(lambda: page.count("#slots canvas") == 0)


def learned(page: Browser) -> None:
    """Wait until something is learned from what is there."""
    page.until(lambda: page.js("justLearned()"))


def test_an_example_draws_itself_and_ends_when_somebody_draws(strokes: Browser) -> None:
    cleared(strokes)
    picture = "document.getElementById('show').toDataURL()"
    strokes.until(lambda: strokes.text("next") == "Your turn: stroke 1 of 5")
    empty = strokes.js(picture)
    strokes.js("(playExample(), 1)")
    strokes.until(lambda: strokes.text("next") == "Five strokes")
    assert strokes.js(picture) != empty
    strokes.until(lambda: strokes.text("next") == "Learned: samples")
    stroke(strokes)
    strokes.until(lambda: strokes.text("next") == "Stroke 2 of 5")
    strokes.js("(playExample(), 1)")
    assert strokes.text("next") == "Stroke 2 of 5", "no example once there is a demonstration"
    cleared(strokes)
    strokes.js("(playExample(), 1)")
    strokes.until(lambda: strokes.text("next") == "Learned: samples")
    strokes.until(lambda: strokes.text("next") == "Your turn: stroke 1 of 5")
    assert strokes.js(picture) == empty


def test_samples_grow_out_of_the_strokes_until_somebody_draws(strokes: Browser) -> None:
    cleared(strokes)
    for number in range(5):
        stroke(strokes, 0.1 + 0.02 * number)
    learned(strokes)
    strokes.until(lambda: strokes.js("performance.now() > recorder.grown.start + GROW"))
    grown = strokes.js("[recorder.grown.strokes.length, shapesNow(recorder.grown)[0], lineOf(learning.samples[0])]")
    assert grown[0] == 5
    assert grown[1] == grown[2]
    picture = "document.getElementById('show').toDataURL()"
    strokes.until(lambda: strokes.js("!learning.again"))
    shown = strokes.js(picture)
    strokes.drag(strokes.places([(0.0, 0.0), (0.0, 0.0)]))  # a dot changes nothing
    assert strokes.js(picture) == shown
    cleared(strokes)
    assert strokes.js("recorder.grown") is None
    assert strokes.js(picture) != shown
    strokes.undo()
    strokes.until(lambda: strokes.count("#slots canvas") == 5)
    assert strokes.js("justLearned()"), "the concept belongs to these strokes again"


def test_undo_goes_back_step_by_step(strokes: Browser) -> None:
    cleared(strokes)
    for number in range(5):
        stroke(strokes, 0.2 + 0.02 * number)
    learned(strokes)
    name, key, count = strokes.js("[learning.concept.name, learning.concept.id, state.concepts.length]")
    stroke(strokes, 0.25)
    learned(strokes)
    strokes.until(lambda: strokes.js("!learning.again"))
    assert strokes.js("[learning.concept.name, learning.concept.id, state.concepts.length]") == [name, key, count]
    strokes.js("(undo(), undo(), 1)")  # the former concept, then the sixth stroke
    strokes.until(lambda: strokes.count("#slots canvas") == 5)
    assert strokes.text("error-text") == ""
    assert strokes.js("justLearned() && conceptOf(learning.concept.id).from.length") == 5
    assert strokes.text("waiting").startswith(f"Learned “{name}” in")
    strokes.click("learn")
    strokes.js("(undo(), 1)")  # while it is learned: this ends, and the fifth stroke goes
    strokes.until(lambda: strokes.count("#slots canvas") == 4)
    assert strokes.data("learning") == "no"
    assert strokes.js("conceptOf(arguments[0]).from.length", key) == 5
    assert strokes.errors() == []


def test_the_first_stroke_moves_nothing(strokes: Browser) -> None:
    cleared(strokes)
    where = "[find('ways').offsetTop, find('mix-title').offsetTop, document.querySelector('#slots li').offsetHeight]"
    before = strokes.js(where)
    stroke(strokes)
    assert strokes.text("learn-why") == "Show at least two"
    assert strokes.js(where) == before
    stroke(strokes)
    assert strokes.text("learn-why") == ""


@pytest.mark.parametrize("touch", [False, True])
def test_a_press_on_the_canvas_draws_in_the_mode_of_keys_too(strokes: Browser, touch: bool) -> None:
    cleared(strokes)
    strokes.click("pen-keys")
    assert strokes.js("find('pen-keys').getAttribute('aria-pressed')") == "true"
    stroke(strokes, touch=touch)
    assert strokes.js("find('pen-keys').getAttribute('aria-pressed')") == "false"


def test_a_short_tap_moves_the_pen(strokes: Browser) -> None:
    cleared(strokes)
    strokes.click("pen-keys")
    assert strokes.js("document.activeElement.id") == "show"
    x, y = strokes.js("recorder.pen")
    strokes.js(TAP, "ArrowRight")
    right, up = strokes.js("recorder.pen")
    assert right > x
    assert up == y
    strokes.press(Keys.SPACE)
    strokes.js("document.activeElement.blur()")
    for _ in range(12):
        strokes.js(TAP, "ArrowUp")  # where nothing has the focus
    assert strokes.js("recorder.path.length") >= 13
    strokes.press(Keys.SPACE)
    strokes.until(lambda: strokes.count("#slots canvas") == 1)
    strokes.click("pen-keys")


def test_learning_waits_where_a_demonstration_looks_wrong(strokes: Browser) -> None:
    cleared(strokes)
    for bend in (0.3, 0.28, 0.31, 0.29):
        stroke(strokes, bend)
    fifth = "{...state.work.demonstrations[0], id: 99, flags: ['It differs.']}"
    work = f"{{...state.work, demonstrations: [...state.work.demonstrations, {fifth}]}}"
    strokes.js(f"(worked({work}, true), true)")
    assert strokes.text("waiting") == "Demonstration 5 looks different from the others. Remove it, or press Learn."
    assert strokes.data("learning") != "yes"
    assert strokes.js("!find('learn').disabled")
    strokes.js("(worked({...state.work, demonstrations: state.work.demonstrations.slice(0, 4)}), true)")
    assert strokes.text("waiting").startswith("Learning starts by itself")


@pytest.fixture
def page(request: pytest.FixtureRequest, tmp_path: Path, chromium: Browser) -> Iterator[Browser]:
    """The page of a model, as nobody has used it."""
    with here(tmp_path, "play", request.param) as server:
        chromium.window()
        chromium.open(server.address)
        chromium.sampled()
        yield chromium


@pytest.mark.parametrize("page", ["agent"], indirect=True)
def test_a_short_tap_steers(page: Browser) -> None:
    page.until(lambda: page.js("recorder.scene !== null"))
    page.js("document.activeElement.blur()")
    before = page.js("recorder.at[0]")
    page.js(TAP, "ArrowLeft")
    assert page.js("recorder.at[0][0]") < before[0]
    assert page.js("recorder.path.length") == 2
    for _ in range(15):
        page.js(TAP, "ArrowLeft")
    page.click("keep")
    assert page.js("document.activeElement.id") == "show"
    page.until(lambda: page.count("#slots canvas") == 1 and page.js("!recorder.busy && recorder.scene !== null"))
    page.js(TAP, "d")
    assert page.js("recorder.path.length") == 2
    page.click("scene")
    page.until(lambda: page.js("recorder.path.length") == 0)
    page.js(TAP, "ArrowUp")
    assert page.js("recorder.path.length") == 2
    assert not page.errors()


YOURS = "state.concepts.filter((one) => one.kind === 'learned').map((one) => one.name)"
WEIGHTS = """[...document.querySelectorAll('#mix li')].map(
  (one) => [one.querySelector('.name').textContent, one.querySelector('input').value])"""


@pytest.mark.parametrize("page", ["strokes"], indirect=True)
def test_what_is_learned_is_mixed_forgotten_and_renamed(page: Browser) -> None:
    for bend in (0.3, 0.28, 0.31, 0.29, 0.305):
        stroke(page, bend)
    learned(page)
    # Alone in the mix; a second one beside it, half and half.
    assert page.js(WEIGHTS) == [["my stroke 1", "1"]]
    assert page.js("document.querySelector('#concepts .pick .about').textContent").startswith("5 demos · ")
    page.js("(find('name').value = '', find('name').focus())")
    page.press("my stroke 2")
    page.click("learn")  # again from the same, with another name
    page.until(lambda: page.js("justLearned() && learning.concept.name === 'my stroke 2'"))
    assert page.js(WEIGHTS) == [["my stroke 1", "0.5"], ["my stroke 2", "0.5"]]
    assert page.js("find('name').value") == "my stroke 2"
    # Forgotten.
    assert page.js(YOURS) == ["my stroke 1", "my stroke 2"]
    button = page.driver.find_element("css selector", "button[aria-label='Forget my stroke 2']")
    page.js("arguments[0].scrollIntoView({ block: 'center' })", button)
    page.until(lambda: page.js("!mix.fetching && !mix.asking"))  # nothing is on its way of what is forgotten
    button.click()
    page.until(lambda: page.js(YOURS) == ["my stroke 1"])
    assert page.count("#mix li") == 1
    assert page.count("#learned") == page.count("#samples canvas") == 0
    assert page.text("error-text") == ""
    assert page.js("find('name').value") == "my stroke 1"  # which was learned from the same strokes
    # Called otherwise.
    page.click("learn")
    learned(page)
    assert page.count("#rename") == 0
    page.js("(find('name').value = '', find('name').focus())")
    page.press("bow")
    assert page.count("#rename") == 1
    page.press(Keys.ENTER)
    page.until(lambda: "bow" in page.js("state.concepts.map((one) => one.name)"))
    page.until(lambda: "bow" in page.text("mix-name"))
    assert page.text("waiting").startswith("Learned “bow” in")
    assert page.count("button[aria-label='Forget bow']") == 1
    assert page.count("#rename") == 0
    assert page.errors() == []
