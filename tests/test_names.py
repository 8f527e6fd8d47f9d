"""Names of concepts: names that are alike, and names that would lead out of a folder."""

from pathlib import Path

import numpy as np
import pytest

from ftl_lightning.apps.benchmark.strokes import TRAINING, strokes
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.concept import Concept, file_name
from ftl_lightning.igm.library import concept_files
from ftl_lightning.services.text import alike
from tests import tiny
from tests.conftest import main, succeed

Told = pytest.CaptureFixture[str]
NAMES = [
    "..",
    "../../evil",
    "/etc/passwd",
    "a/b",
    "a\\b",
    ".hidden",
    "a\x1b[31m",
    "tab\tand\nline",
    "x" * 300,
    "ü" * 300,
    "圓" * 90,
]
NAMES += ["a b", "a_b", "Walk", "walk", "cafe\u0301", "caf\u00e9", "..."]


def written(names: list[str]) -> str:
    """A file with two strokes of each name."""
    states = np.concatenate([strokes(TRAINING[0], 2, number) for number in range(len(names))])
    np.savez("named.npz", states=states, concepts=np.repeat(names, 2))
    return "named.npz"


def test_files_are_safe_and_inside_the_folder_and_each_is_of_one_concept() -> None:
    files = concept_files(NAMES, Path("out"), "out")
    assert list(files) == NAMES
    assert all((path.parent == Path("out") and path.name[0].isalnum()) or path.name[0] == "_" for path in files.values())
    assert all(len(path.name.encode()) <= 255 and path.name.isprintable() for path in files.values())
    assert len({path.name.casefold() for path in files.values()}) == len(NAMES)  # where a file system does not know case
    assert files["Walk"].name == "Walk.safetensors"
    assert files["walk"].name == "walk_1.safetensors"
    assert file_name("go to red bowl, v1.2") == "go_to_red_bowl__v1.2"


@pytest.mark.slow
def test_names_come_back_from_the_files_of_an_inversion(capsys: Told) -> None:
    succeed("invert", "strokes", written(NAMES), "--steps=1", "--form=paper", "--out=out")
    notes = [line for line in capsys.readouterr().err.splitlines() if "names differ only by" in line]
    assert len(notes) == 2
    assert "'Walk' and 'walk' are different concepts" in notes[0]
    assert r"'cafe\u0301' and 'caf\xe9'" in notes[1]
    assert sorted(Concept.load(path).origin.name for path in Path("out").iterdir()) == sorted(NAMES)
    assert {path.name for path in Path().iterdir()} - {"cache", "data"} == {"named.npz", "out"}


@pytest.mark.parametrize("names", [("go up", "Go up"), ("go up", "go  up"), ("go up", " go up "), ("é", "e\u0301"), ("ﬁ", "fi")])
def test_names_that_are_alike_are_told(names: tuple[str, str], capsys: Told) -> None:
    assert len(list(alike(names))) == 1
    succeed("check", written(list(names)))
    assert capsys.readouterr().err.count("note: ") == 1
    with pytest.warns(UserWarning, match="are different concepts, but their names differ only by case, spaces or Unicode form"):
        FewShot.from_pretrained("strokes").learn_all(Demonstrations.load("named.npz"), steps=1, form="paper")


def test_other_names_are_not_told(capsys: Told) -> None:
    assert not list(alike([*TRAINING, *TRAINING, "go up", "goup", "go-up", "1", "2"]))
    succeed("check", written(["go up", "goup"]))
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_fit_tells_names_that_are_alike_and_refuses_them_where_they_have_one_embedding(capsys: Told) -> None:
    arguments = tiny.fit(Path("own.yaml"), f"--data.demonstrations={written(['go up', 'Go  up', 'rest'])}")
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert ": 'go up' and 'Go up' are different concepts" in told.replace("  ", " ")
    assert "error: concepts: 'go up' and 'Go up' have the same embedding" in told


# Recordings that are long


@pytest.mark.slow
def test_long_recordings_are_learned_in_windows_with_a_note_and_a_long_horizon_is_refused(capsys: Told) -> None:
    time = np.linspace(0, 60, 6000)
    states = np.stack([np.stack((np.sin(rate * time), np.cos(rate * time)), axis=1) for rate in (1, 1.01, 1.02, 2, 2.02, 2.04)])
    np.savez("long.npz", states=states, concepts=np.repeat(["slow", "fast"], 3))
    fit = tiny.fit(Path("own.yaml"), "--data.demonstrations=long.npz", "--trainer.max_steps=2", "--data.batch_size=4")
    fit += ["--evaluation.samples=2", "--evaluation.figures=0"]
    succeed(*fit)
    note = "note: data.horizon: demonstrations have up to 6000 steps, so plans are windows of 256; --data.horizon N"
    assert note in capsys.readouterr().err
    assert FewShot.from_pretrained("logs/own/fit/pretrained").model.horizon == 256
    for options in (["--data.horizon=6000"], ["--data.horizon=3000", "--data.metrics={}"]):
        assert main([*fit, *options]) == 2
        (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
        assert error.startswith("error: horizon: expected at most 2048 states for ")
        assert error.endswith("; set data.horizon")
    succeed(*fit, "--data.horizon=64")
    assert "note: data.horizon" not in capsys.readouterr().err
