"""Pages with fixed content: of ``play --static``, and of ``view`` for files of every kind."""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.apps.play.page import COUNT, MOST_SHOWN, WEIGHTS, answers_of, holds_results, pairs_of, results_page, viewed
from ftl_lightning.apps.play.workspace import Workspace
from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import UserError
from tests.apps.play.served import here
from tests.conftest import ROOT, Once, refused, succeed

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


@pytest.fixture
def five(tmp_path: Path) -> Path:
    """Hearts, the third of which is there twice, and circles."""
    hearts = strokes("heart", 4, 1)
    states = np.concatenate((hearts, hearts[2:3], strokes("circle", 3, 1)))
    np.savez(tmp_path / "five.npz", states=states, concepts=["heart"] * 5 + ["circle"] * 3)
    return tmp_path / "five.npz"


def test_demonstrations_stand_by_concept_with_what_is_odd_in_them(five: Path) -> None:
    shown = viewed(str(five))["viewer"]
    assert [group["concept"] for group in shown["groups"]] == ["heart", "circle"]
    assert [len(group["films"]) for group in shown["groups"]] == [5, 3]
    flagged = [film["label"] for film in shown["groups"][0]["films"] if film["flags"]]
    assert flagged == ["3", "5"]
    json.dumps(shown, allow_nan=False)


@pytest.mark.parametrize("name", ["object_rearrangement", "driving", "mocap"])
def test_samples_are_drawn_as_their_domain_draws(name: str, tmp_path: Path) -> None:
    domain = load_domain(name)
    text = domain.concepts.training[0]
    arguments = ["sample", "--pretrained", name, "--compose", text, "--goal", text if name != "mocap" else "walk", "--count", "2"]
    assert main([*arguments, "--out", "samples.safetensors"]) == 0
    (group,) = viewed("samples.safetensors")["viewer"]["groups"]
    assert len(group["films"]) == 2
    assert ("space" in group["films"][0]["film"]) == (name == "mocap")


@pytest.mark.slow
def test_a_concept_is_shown_by_its_samples_in_words() -> None:
    shown = viewed(str(ROOT / "pretrained" / "mocap" / "jumping_jacks.safetensors"))["viewer"]
    assert "jumping jacks" in shown["told"][0]
    assert len(shown["groups"][0]["films"]) == 16


def test_of_many_the_first_are_shown(tmp_path: Path) -> None:
    np.savez(tmp_path / "many.npz", states=strokes("wave", MOST_SHOWN + 1, 0), concepts="wave")
    shown = viewed(str(tmp_path / "many.npz"))["viewer"]
    assert len(shown["groups"][0]["films"]) == MOST_SHOWN
    assert any(f"the first {MOST_SHOWN} of {MOST_SHOWN + 1}" in told for told in shown["told"])


def test_missing_numbers_are_told_and_what_is_left_is_drawn(tmp_path: Path) -> None:
    states = strokes("wave", 3, 0)
    states[1, 5] = np.nan
    np.savez(tmp_path / "gap.npz", states=states, concepts="wave")
    (group,) = viewed(str(tmp_path / "gap.npz"))["viewer"]["groups"]
    assert [bool(film["flags"]) for film in group["films"]] == [False, True, False]


def test_data_sets_are_shown(five: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
    Demonstrations.load(five).save(f"lerobot:{tmp_path / 'set'}")
    assert [group["concept"] for group in viewed(str(tmp_path / "set"))["viewer"]["groups"]] == ["heart", "circle"]


def test_results_are_the_page_of_the_report(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    folder.mkdir()
    shutil.copy(ROOT / "results" / "object_rearrangement.csv", folder)
    assert holds_results(str(folder))
    assert holds_results(str(folder / "object_rearrangement.csv"))
    assert not holds_results(str(tmp_path / "five.npz"))
    assert "ftl-lightning: results to watch" in results_page(str(folder))


def test_what_is_none_is_refused_before_a_page_is_served(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.npz").write_bytes(b"notes")
    refused(capsys, ["view", "notes.npz", "--browser", "false"], "notes.npz")
    refused(capsys, ["view", "nothing.safetensors", "--browser", "false"], "nothing.safetensors")


@pytest.mark.browser
def test_the_page_shows_them(five: Path, tmp_path: Path, chromium: "Browser") -> None:
    with here(tmp_path, "view", str(five)) as server:
        page = chromium
        page.open(server.address)
        page.until(lambda: page.count("#view-films canvas") == 8)
        page.click("view-over")
        page.until(lambda: page.count("#view-films canvas") == 2)
        assert not page.errors()


def test_files_and_results_are_served(five: Path, tmp_path: Path) -> None:
    with here(tmp_path, "view", str(five)) as server:
        assert [group["concept"] for group in server.get("/api/state")["viewer"]["groups"]] == ["heart", "circle"]
    with here(tmp_path, "view", str(ROOT / "results" / "object_rearrangement.csv")) as server:
        assert b"ftl-lightning: results to watch" in server.ask("GET", f"/?token={server.token}")[1]
