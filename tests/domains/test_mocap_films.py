"""The script that makes films for raters, with made-up recordings: nobody moves in them as concepts say."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
import torch

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.domains.mocap.recordings import FILE
from ftl_lightning.domains.mocap.skeleton import HORIZON
from tests.conftest import ROOT
from tests.domains.mocap_samples import motion, recordings

CONDITIONS = {"ours", "ours with adapter", "text", "demonstrations", "people"}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    spec = importlib.util.spec_from_file_location("mocap_films", ROOT / "benchmarks" / "mocap_films.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recorded(folder: Path, others: bool) -> list[str]:
    """Arguments that name a folder in which people stand as demonstrators and, if wanted, as others."""
    trials = {f"02_{number:02}": ("walk", motion(60, number)) for number in range(1, 4)}
    trials |= {"13_29": ("jumping jacks, side twists, bend over, squats", motion(1148, 30))}
    if others:
        trials |= {"14_14": ("jumping jacks, jog, squats", motion(1000, 31))}
    folder.mkdir()
    recordings(trials).save(folder / FILE)
    return ["--root", str(folder), "--count", "2", "--scenarios", "2"]


def test_films_of_every_condition_become_a_page_for_raters(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert script.main([*recorded(tmp_path / "recordings", others=True), "--out", str(out), "--text", "walk"]) == 0
    told = capsys.readouterr().out
    assert "jumping jacks: text is 'walk'" in told
    assert "drawn demonstrations are not those" in told  # they are made up
    assert {path.name for path in (out / "films").iterdir()} == CONDITIONS
    found = {path: Demonstrations.load(path) for path in (out / "films").glob("*/*.safetensors")}
    assert len(found) == 2 * len(CONDITIONS)
    assert {tuple(one.states.shape) for one in found.values()} == {(2, HORIZON, 42)}
    assert {one.concepts for one in found.values()} == {("jumping jacks",) * 2, ("arm circle",) * 2}
    starts = [found[out / "films" / name / "arm_circle.safetensors"].states[:, 0] for name in ("ours", "ours with adapter", "text")]
    assert torch.allclose(starts[0], starts[1], atol=0.15)
    assert torch.allclose(starts[0], starts[2], atol=0.15)
    key = json.loads((out / "study" / "key.json").read_text())
    assert {film["method"] for film in key["films"].values()} >= CONDITIONS
    assert (out / "study" / "study.html").is_file()
    assert script.main(["--root", str(tmp_path / "recordings"), "--out", str(out)]) == 2  # they belong to the page
    assert "error: out: expected a folder without films" in capsys.readouterr().err


def test_without_others_in_the_recordings_their_condition_is_left_out(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert script.main([*recorded(tmp_path / "recordings", others=False), "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "no condition 'people': nobody but the demonstrators shows jumping jacks, arm circle in" in told
    assert "jumping jacks: text is 'jump'" in told
    assert {path.name for path in (out / "films").iterdir()} == CONDITIONS - {"people"}


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["--out", str(ROOT / "films")], "error: out: expected a folder outside the project, as recordings are written to it"),
        (["--text", "juggling"], "juggling"),
        (["--scenarios", "3"], "error: scenarios: "),
        (["--concepts", "nowhere"], "jumping_jacks.safetensors"),
    ],
)
def test_mistakes_are_one_line(
    script: ModuleType, changed: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert script.main([*recorded(tmp_path / "recordings", others=True), "--out", str(out), *changed]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert expected in told
    assert told.count("\n") == 1
    assert not out.exists()
    assert not (ROOT / "films").exists()
