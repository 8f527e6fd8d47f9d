"""Pages that need no program."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ftl_lightning.apps.play.offline import COUNT, WEIGHTS, answers_of, pairs_of
from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.services.errors import UserError
from tests.conftest import Once, refused, succeed

if TYPE_CHECKING:
    from tests.apps.play.browser import Browser

CONCEPTS = [{"id": f"t{number}", "kind": "training", "name": f"text {number}"} for number in range(6)]
LEARNED = [{"id": "l1", "kind": "learned", "name": "mine"}, {"id": "s1", "kind": "shipped", "name": "theirs"}]
TASK = "square diagonal to triangle"


def test_learned_concepts_are_mixed_with_known_ones_and_one_another() -> None:
    assert pairs_of(CONCEPTS) == [("t0", "t1"), ("t0", "t2"), ("t0", "t3"), ("t1", "t2")]
    assert pairs_of([*CONCEPTS, *LEARNED]) == [("l1", "t0"), ("l1", "t1"), ("l1", "t2"), ("l1", "s1")]
    assert pairs_of(CONCEPTS, [("text 5", "text 1")]) == [("t5", "t1")]
    with pytest.raises(UserError, match=r"^pairs: expected concepts of the model, found 'nobody'"):
        pairs_of(CONCEPTS, [("text 5", "nobody")])


@pytest.mark.slow
def test_every_choice_has_an_answer() -> None:
    answers = answers_of(Workspace("object_rearrangement"), [("circle above square", "circle right of square")])
    samples = [answer for name, answer in answers.items() if name.startswith("/api/sample ")]
    assert len(samples) == len(WEIGHTS) ** 2
    assert all(len(answer["samples"]) == COUNT for answer in samples)
    state = answers["/api/state"]
    assert [one["name"] for one in state["concepts"]] == ["circle right of square", "circle above square"]


@pytest.fixture
def written(once: Once) -> Path:
    """A folder with a page of demonstrations and a pair of concepts: what is learned from them, and a training concept."""

    def write(folder: Path) -> None:
        succeed("generate", "object_rearrangement", "--task", TASK, "--count", "3", "--out", "a.npz")
        succeed(*STATIC, "--static", "site")

    return once("page_without_program", write)


STATIC = ("play", "object_rearrangement", "--demonstrations", "a.npz")
STATIC += ("--pairs", f'["{TASK} + circle above square"]')


@pytest.mark.slow
def test_the_same_page_is_written_again(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(written)
    succeed(*STATIC, "--static", "again")
    first, again = ((written / name / "object_rearrangement.html").read_bytes() for name in ("site", "again"))
    assert first == again


@pytest.mark.browser
def test_the_page_moves_its_sliders_without_a_program(written: Path, chromium: "Browser") -> None:
    page = chromium
    page.open((written / "site" / "object_rearrangement.html").as_uri())
    page.sampled()
    assert page.count("#slots canvas") == 3
    assert page.count("#show") == 0
    before = int(page.data("samples"))
    find = "document.querySelector('#mix input[type=range]')"
    page.js(f"({find}.value = 0.5, {find}.dispatchEvent(new Event('input', {{bubbles: true}})))")
    page.sampled(before)
    assert not page.text("error-text")
    assert not page.errors()


def test_mistakes_are_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    refused(capsys, ["play", "strokes", "--pairs", '["circle"]', "--static", "site"], "pairs:", "'circle'")
    refused(capsys, ["play", "strokes", "--pairs", '["circle + wave"]'], "pairs:", "--static")
    refused(capsys, ["play", "nobody", "--browser", "false"], "nobody")
    refused(capsys, ["play", "strokes", "--port", "99999"], "port:")
    refused(capsys, ["play", "strokes", "--host", "example.org", "--browser", "false"], "host:", "127.0.0.1")
    refused(capsys, ["play", "strokes", "--demonstrations", "nothing.npz"], "nothing.npz")
