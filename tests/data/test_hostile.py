"""Files made to take the machine, and good files that must not be blamed: each through the program."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.data.check import check
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.validation import parse_json
from tests.conftest import ROOT, refused, succeed

Told = pytest.CaptureFixture[str]
STATES = np.cumsum(np.random.default_rng(0).normal(size=(3, 12, 2)), axis=1).astype(np.float32)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


TINY = {
    "lists": ("[" + "[]," * 400_000 + "[]]", "lists and mappings"),
    "mappings": ('{"states": [' + "{}," * 400_000 + "{}]}", "lists and mappings"),
    "keys": ("{" + ", ".join(f'"{number}": 1' for number in range(400_000)) + "}", "keys"),
    "values": ("[" + "1," * 5_000_000 + "1]", "values"),
}


@pytest.mark.parametrize("name", TINY)
def test_a_json_text_of_tiny_parts_is_refused_before_it_is_parsed(name: str, capsys: Told) -> None:
    text, what = TINY[name]
    Path("x.json").write_text(text)
    begin = time.process_time()
    refused(capsys, ["check", "x.json"], "x.json", "at most", what)
    assert time.process_time() - begin < 2


def test_numbers_and_texts_of_json_are_checked_as_before() -> None:
    assert parse_json('[1, 2.5, "a", null, true, [], {"b": [0.5, 1.5]}]') == [1, 2.5, "a", None, True, [], {"b": [0.5, 1.5]}]
    for text in ("[1.5, 1e999]", "[1e999]", "[[0.5, NaN]]", '["a", "\\ud800"]', '{"a": "\\ud800"}', "[1, 2.5, Infinity]"):
        with pytest.raises(UserError, match=r"expected (finite numbers|texts of Unicode)"):
            parse_json(text)


def _wide(count: int) -> dict[str, np.ndarray]:
    return {"states": np.zeros((1, 2, count), np.float32)}


ARCHIVES: dict[str, tuple[Callable[[], object], str]] = {
    "too many arrays": (lambda: np.savez("x.npz", states=STATES, **{f"observed/{i}": STATES for i in range(2000)}), "2000 arrays"),
    "too many columns": (lambda: np.savez("x.npz", **_wide(10_001)), "at most 10000 columns, found 10001"),
    "unpacked": (lambda: np.savez_compressed("x.npz", states=np.zeros((4, 3_000_000), np.float32)), "without compression"),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_an_archive_larger_than_any_demonstrations_is_refused(name: str, capsys: Told) -> None:
    make, expected = ARCHIVES[name]
    make()
    refused(capsys, ["check", "x.npz"], "x.npz", expected)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_twice_in_an_archive_is_refused(capsys: Told) -> None:
    import zipfile

    np.save("s.npy", STATES)
    for second in ("states.npy", "states"):
        with zipfile.ZipFile("x.npz", "w") as file:
            for name in ("states.npy", second):
                file.write("s.npy", name)
        refused(capsys, ["check", "x.npz"], "x.npz: key 'states': expected it once, found it several times")


@pytest.mark.slow
def test_of_many_demonstrations_and_concepts_the_first_are_checked(capsys: Told) -> None:
    states = np.random.default_rng(0).normal(size=(3000, 4, 1)).cumsum(axis=1)
    np.savez("many.npz", states=states, concepts="walk")
    succeed("check", "many.npz")
    assert "the first 1000 of 3000 demonstrations are checked" in capsys.readouterr().out
    np.savez("names.npz", states=states, concepts=[f"walk {number}" for number in range(3000)])
    succeed("check", "names.npz")
    told = capsys.readouterr()
    assert "note: names.npz: the first 200 of 3000 concepts are checked" in told.err
    assert told.out.count("walk ") == 200


def test_images_are_compared_in_bounded_memory_and_time() -> None:
    paths = torch.randn(200, 6, 2, generator=torch.Generator().manual_seed(0)).cumsum(dim=1)
    paths[7] = paths[3]
    images = torch.zeros(200, 3, 64, 64, dtype=torch.uint8)
    good = Demonstrations.of(list(paths), "walk", observed={"camera": images})
    assert [finding.rows for finding in check(good) if "the same" in finding.text] == [(3, 7)]
    images[7] = 255
    assert not [finding for finding in check(replace(good, observed={"camera": images})) if "the same" in finding.text]


def test_a_rarely_used_column_makes_no_outlier_of_a_good_demonstration() -> None:
    """As the corner pixel of hand-written digits, which few of them reach."""
    states = torch.rand(80, 8, 8, generator=torch.Generator().manual_seed(0))
    states[:, :, 0] = 0
    states[40, 3, 0] = 0.5
    assert not [finding for finding in check(Demonstrations.of(list(states), "four")) if finding.severity != "note"]
    states[40] += 30
    (odd,) = [finding for finding in check(Demonstrations.of(list(states), "four")) if finding.severity != "note"]
    assert odd.rows == (40,)


def test_kinds_are_those_of_the_whole_file(capsys: Told) -> None:
    """One concept alone would show a quaternion, or two values; the file shows more."""
    draw = np.random.default_rng(0)
    unit = draw.normal(size=(3, 20, 4))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    switch = draw.integers(0, 2, (3, 20, 1)).astype(float)
    first = np.concatenate((unit, switch), axis=-1)
    second = np.concatenate((draw.normal(size=(3, 20, 4)), draw.normal(size=(3, 20, 1))), axis=-1)
    np.savez("x.npz", states=np.concatenate((first, second)), concepts=["a"] * 3 + ["b"] * 3)
    succeed("check", "x.npz")
    told = capsys.readouterr()
    assert "quaternion" not in told.out + told.err
    assert "binary" not in told.out + told.err
    np.savez("x.npz", states=np.concatenate((first, first[::-1])), concepts=["a"] * 3 + ["b"] * 3)
    succeed("check", "x.npz")
    told = capsys.readouterr()
    assert told.err.count("quaternion") == 1
    assert "x.npz: column 4: binary" in told.err


def test_lists_of_whole_numbers_and_texts_are_still_checked(capsys: Told) -> None:
    for lengths, expected in (([2, -1, 2], "lengths"), (["a"] * 3, "lengths")):
        Path("x.json").write_text(json.dumps({"states": STATES.tolist(), "lengths": lengths}))
        refused(capsys, ["check", "x.json"], "x.json", expected)


@pytest.mark.parametrize("text", ["[" * 50_000, "{a: " * 20_000, "- " * 50_000, "a: " + "1:" + "9:" * 5000 + "1"])
def test_a_configuration_that_is_too_deep_or_of_endless_digits_is_one_line(text: str, capsys: Told) -> None:
    Path("c.yaml").write_text(text)
    refused(capsys, ["fit", "--config", "c.yaml"], "c.yaml: expected a configuration file (YAML), found")


def test_a_model_of_a_million_training_concepts_is_refused(capsys: Told) -> None:
    shutil.copytree(ROOT / "pretrained" / "strokes", "model")
    config = Path("model/config.json")
    config.write_text(json.dumps(json.loads(config.read_text()) | {"training_concepts": ["a"] * 10**6}))
    np.savez("five.npz", states=STATES, concepts="walk")
    refused(capsys, ["invert", "model", "five.npz"], "model/config.json", "training_concepts", "20000")
