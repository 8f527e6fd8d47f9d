"""The page of a study in a browser, which somebody goes through."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ftl_lightning.apps.study.page import Made
from ftl_lightning.apps.study.report import read_key
from ftl_lightning.cli.main import main
from tests.study import make, write_films

if TYPE_CHECKING:
    from tests.apps.play.browser import Browser

pytestmark = pytest.mark.browser

SHADES = """((canvas) => [...new Set(canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data)])(
  document.querySelector('canvas'))"""
STORED = "JSON.parse(localStorage.getItem('study-' + JSON.parse(document.getElementById('data').textContent).study))"
CLICKING = "setInterval(() => document.querySelector('button[data-key]:enabled')?.click(), 10)"
"""Answers all questions as soon as they may be answered."""


class Rater:
    """Somebody with a telephone, attentive, who says no to everything and takes the first film."""

    def __init__(self, page: "Browser") -> None:
        self.page = page

    def one(self, selector: str) -> Any:
        return self.page.driver.find_element("css selector", selector)

    @property
    def question(self) -> str:
        return str(self.one("h1").text)

    @property
    def answered(self) -> int:
        return int(self.one("#bar").get_attribute("aria-valuenow"))

    def begin(self, age: str = "") -> None:
        assert not self.one("#start").is_enabled()
        self.one("#agree").click()
        self.one("#age").send_keys(age)
        self.one("#start").click()

    def answer(self, count: int) -> None:
        """So many questions, each by a key as soon as the film has been shown."""
        for _ in range(count):
            before, question = self.answered, self.question
            key = "1" if question.startswith("Which") else "y" if "answer Yes" in question else "n"
            self.page.until(lambda: self.page.js("!document.querySelector('button[data-key]').disabled"))
            self.one("body").send_keys(key)
            assert self.answered == before + 1

    def reload(self) -> tuple[str, int]:
        """Load the page again: its question, and the number of answers."""
        self.page.driver.refresh()
        return self.question, self.answered

    def come_back(self, study: Made) -> None:
        """On another day, in another window."""
        old = self.page.driver.current_window_handle
        self.page.driver.switch_to.new_window("tab")
        new = self.page.driver.current_window_handle
        self.page.driver.switch_to.window(old)
        self.page.driver.close()
        self.page.driver.switch_to.window(new)
        self.page.window(420, 800)
        self.page.driver.get(study.page.as_uri())


@pytest.fixture
def study(tmp_path: Path) -> Made:
    return make(write_films(tmp_path / "films"), tmp_path / "study")


@pytest.fixture
def rater(study: Made, chromium: "Browser") -> Rater:
    chromium.window(420, 800)
    chromium.driver.get(study.page.as_uri())
    chromium.js("localStorage.clear()")
    chromium.driver.refresh()
    chromium.driver.get_log("browser")
    return Rater(chromium)


def test_somebody_rates_everything_with_a_break_and_the_report_takes_the_file(
    study: Made, rater: Rater, capsys: pytest.CaptureFixture[str]
) -> None:
    page = rater.page
    rater.begin("31")
    rater.answer(7)
    assert len(page.js(SHADES)) > 20
    assert page.js("document.documentElement.scrollWidth <= window.innerWidth")
    asked = rater.question
    page.until(lambda: rater.reload() == (asked, 7))  # a browser stores answers shortly after a script has set them
    rater.answer(5)
    asked = rater.question
    assert page.driver.get_log("browser") == []
    rater.come_back(study)
    assert (rater.question, rater.answered) == (asked, 12)
    rater.one("body").send_keys("\ue003")  # Backspace
    assert rater.one("button.chosen").is_displayed()  # of the question before, which may read the same
    rater.one("button.chosen").click()
    assert rater.question == asked
    assert page.js("document.querySelector('button.chosen')") is None
    rater.answer(study.questions - 12)
    assert rater.question.startswith("Thank you")
    rater.one("#save").click()
    page.until(lambda: list(page.downloads.glob("answers-*.json")))
    (saved,) = page.downloads.glob("answers-*.json")
    assert page.driver.get_log("browser") == []
    content = json.loads(saved.read_text())
    assert content["age"] == 31
    assert [entry["place"] for entry in content["answers"]] == list(range(study.questions))
    assert all(entry["milliseconds"] >= 0 for entry in content["answers"])
    assert main(["study-report", str(saved), "--key", str(study.key)]) == 0
    out, err = capsys.readouterr()
    assert "1 rater; scenarios: 3 training, 3 new" in out
    assert err == ""


def test_raters_see_films_in_other_orders_and_repeats_apart(study: Made, rater: Rater) -> None:
    key, page, orders = read_key(study.key), rater.page, []
    repeated = [question.films for question in key.of_kind("repeat").values()]
    for _ in range(2):
        page.js("localStorage.clear()")
        page.driver.refresh()
        rater.begin()
        page.js(CLICKING)
        page.until(lambda: rater.answered == study.questions)
        answers = page.js(STORED)["answers"].values()
        orders.append([entry["id"] for entry in sorted(answers, key=lambda entry: entry["place"])])
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(key.questions)
    assert orders[0] != orders[1]
    for order in orders:
        kinds = [key.questions[name].kind == "best" for name in order]
        assert kinds == sorted(kinds)  # films alone come first
        asked = [key.questions[name].films for name in order]
        for films in repeated:
            first, second = [place for place, found in enumerate(asked) if found == films][:2]
            assert second - first > 1
