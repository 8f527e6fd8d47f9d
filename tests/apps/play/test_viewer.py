"""What ``view`` shows of files of every kind."""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from ftl_lightning.apps.benchmark.strokes import strokes
from ftl_lightning.apps.play.viewer import MOST_SHOWN, holds_results, results_page, viewed
from ftl_lightning.cli.main import main
from ftl_lightning.data.container import Demonstrations
from ftl_lightning.domains.registry import load_domain
from tests.apps.play.served import here
from tests.conftest import ROOT, refused

if TYPE_CHECKING:
    from tests.apps.play.browser import Browser


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
