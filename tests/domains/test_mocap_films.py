"""The script that makes films for raters, with made-up recordings: nobody moves in them as concepts say."""

import json
from functools import partialmethod
from pathlib import Path

import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap.skeleton import HORIZON
from ftl_lightning.domains.mocap.source import FILE
from ftl_lightning.few_shot.learner import FewShot
from tests.conftest import ROOT
from tests.domains.mocap_samples import motion, recordings, script

CONDITIONS = {"ours", "ours with adapter", "text", "demonstrations", "people"}


@pytest.fixture(autouse=True)
def _few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Films of two steps of the sampler; nobody looks at them."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "experiments"))
    monkeypatch.setattr(FewShot, "sample", partialmethod(FewShot.sample, steps=2))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of recordings in which people stand as demonstrators and as others."""
    return recorded(tmp_path_factory.mktemp("recordings"), others=True)


def recorded(folder: Path, others: bool) -> Path:
    trials = {f"02_{number:02}": ("walk", motion(60, number)) for number in range(1, 4)}
    trials |= {"13_29": ("jumping jacks, side twists, bend over, squats", motion(1148, 30))}
    if others:
        trials |= {"14_14": ("jumping jacks, jog, squats", motion(1000, 31))}
    recordings(trials).save(folder / FILE)
    return folder


def made(root: Path, out: Path, *options: str) -> int:
    """What the script returns for two films of each condition."""
    code: int = script("mocap_films").main(["--root", str(root), "--out", str(out), "--count=2", "--scenarios=2", *options])
    return code


def test_films_of_every_condition_become_a_page_for_raters(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert made(root, out, "--text=walk") == 0
    told = capsys.readouterr().out
    assert "jumping jacks: text is 'walk'" in told
    assert "drawn demonstrations are not those" in told  # they are made up
    assert {path.name for path in (out / "films").iterdir()} == CONDITIONS
    found = {path: Demonstrations.load(path) for path in (out / "films").glob("*/*.safetensors")}
    assert len(found) == 2 * len(CONDITIONS)
    assert {tuple(one.states.shape) for one in found.values()} == {(2, HORIZON, 42)}
    assert {one.concepts for one in found.values()} == {("jumping jacks",) * 2, ("arm circle",) * 2}
    first, *others = (
        found[out / "films" / name / "arm_circle.safetensors"].states[:, 0] for name in ("ours", "ours with adapter", "text")
    )
    assert all(torch.allclose(first, other, atol=0.15) for other in others)
    key = json.loads((out / "study" / "key.json").read_text())
    assert {film["method"] for film in key["films"].values()} >= CONDITIONS
    assert (out / "study" / "study.html").is_file()
    assert made(root, out) == 2  # they belong to the page
    assert "error: out: expected a folder without films" in capsys.readouterr().err


def test_without_others_in_the_recordings_their_condition_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert made(recorded(tmp_path, others=False), out) == 0
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
    root: Path, changed: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert made(root, tmp_path / "out", *changed) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert expected in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert not (ROOT / "films").exists()
