"""Pages that need no program."""

from pathlib import Path

import pytest

from ftl_lightning.cli import main
from ftl_lightning.errors import UserError
from ftl_lightning.play.offline import COUNT, WEIGHTS, answers_of, pairs_of
from ftl_lightning.play.workspace import Workspace
from tests.conftest import refused
from tests.play.browser import DRIVER, browser

CONCEPTS = [{"id": f"t{number}", "kind": "training", "name": f"text {number}"} for number in range(6)]
LEARNED = [{"id": "l1", "kind": "learned", "name": "mine"}, {"id": "s1", "kind": "shipped", "name": "theirs"}]


def test_learned_concepts_are_mixed_with_known_ones_and_one_another() -> None:
    assert pairs_of(CONCEPTS) == [("t0", "t1"), ("t0", "t2"), ("t0", "t3"), ("t1", "t2")]
    assert pairs_of([*CONCEPTS, *LEARNED]) == [("l1", "t0"), ("l1", "t1"), ("l1", "t2"), ("l1", "s1")]
    assert pairs_of(CONCEPTS, [("text 5", "text 1")]) == [("t5", "t1")]
    with pytest.raises(UserError, match=r"^pairs: expected concepts of the model, found 'nobody'"):
        pairs_of(CONCEPTS, [("text 5", "nobody")])


def test_every_choice_has_an_answer() -> None:
    answers = answers_of(Workspace("object_rearrangement"), [("circle above square", "circle right of square")])
    samples = [answer for name, answer in answers.items() if name.startswith("/api/sample ")]
    assert len(samples) == len(WEIGHTS) ** 2
    assert all(len(answer["samples"]) == COUNT for answer in samples)
    state = answers["/api/state"]
    assert [one["name"] for one in state["concepts"]] == ["circle right of square", "circle above square"]


def test_the_page_moves_its_sliders_without_a_program(tmp_path: Path) -> None:
    assert (
        main(["generate", "object_rearrangement", "--task", "square diagonal to triangle", "--count", "3", "--out", "a.npz"]) == 0
    )
    assert main(["play", "object_rearrangement", "--demonstrations", "a.npz", "--static", "site"]) == 0
    first = (tmp_path / "site" / "object_rearrangement.html").read_bytes()
    if not DRIVER.exists():
        pytest.skip("needs Chromium and its driver")
    with browser(tmp_path) as page:
        page.open((tmp_path / "site" / "object_rearrangement.html").as_uri())
        page.until(lambda: int(page.data("samples") or 0) > 0)
        assert page.count("#slots canvas") == 3
        assert page.count("#show") == 0
        before = int(page.data("samples"))
        find = "document.querySelector('#mix input[type=range]')"
        page.js(f"({find}.value = 0.5, {find}.dispatchEvent(new Event('input', {{bubbles: true}})))")
        page.until(lambda: int(page.data("samples")) > before)
        assert not page.text("error-text")
        assert not page.errors()
    assert main(["play", "object_rearrangement", "--demonstrations", "a.npz", "--static", "site"]) == 0
    assert (tmp_path / "site" / "object_rearrangement.html").read_bytes() == first


def test_mistakes_are_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    refused(capsys, ["play", "strokes", "--pairs", '["circle"]', "--static", "site"], "pairs:", "'circle'")
    refused(capsys, ["play", "strokes", "--pairs", '["circle + wave"]'], "pairs:", "--static")
    refused(capsys, ["play", "nobody", "--browser", "false"], "nobody")
    refused(capsys, ["play", "strokes", "--port", "99999"], "port:")
    refused(capsys, ["play", "strokes", "--host", "example.org", "--browser", "false"], "host:", "127.0.0.1")
    refused(capsys, ["play", "strokes", "--demonstrations", "nothing.npz"], "nothing.npz")
