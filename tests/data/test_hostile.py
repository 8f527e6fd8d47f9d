"""Files made to take the machine, and good files that must not be blamed: each through the program."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.data.check import check, with_kinds
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


def test_a_hundred_thousand_demonstrations_are_read_at_once_and_as_many_concepts_refused(capsys: Told) -> None:
    states = np.random.default_rng(0).normal(size=(100_000, 4, 1)).cumsum(axis=1).astype(np.float32)
    np.savez("many.npz", states=states, concepts="walk")
    np.savez("names.npz", states=states, concepts=[f"walk {number}" for number in range(len(states))])
    np.savez("more.npz", states=np.zeros((200_001, 1, 1), np.float32))
    begin = time.process_time()
    assert with_kinds(Demonstrations.load("many.npz"))[1] == []
    refused(capsys, ["check", "names.npz"], "names.npz: key 'concepts': expected at most 20000 different texts, found 100000")
    refused(capsys, ["check", "more.npz"], "more.npz: key 'states': expected at most 200000 demonstrations, found 200001")
    assert time.process_time() - begin < 4


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
    (outlier,) = [finding for finding in check(Demonstrations.of(list(states), "four")) if finding.severity != "note"]
    assert outlier.rows == (40,)


@pytest.mark.parametrize("count", [5, 8, 10])
def test_pictures_of_digits_have_no_outlier(count: int) -> None:
    """Row by row of 8 columns; few of them use the columns at the edge."""
    digits = pytest.importorskip("sklearn.datasets").load_digits()
    for digit in range(10):
        pictures = digits.images[digits.target == digit][: 2 * count].reshape(2, count, 8, 8)
        for part in pictures:
            assert not [finding for finding in check(Demonstrations.of(list(part), "a")) if finding.severity != "note"]


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


HEAD = "demonstration,time,x\n"
TABLES: dict[str, tuple[str, str]] = {
    "decimal commas": (HEAD + '1,0,"0,5"\n1,1,"1,5"\n', "column 'x': expected numbers such as 1234.5, found '0,5'"),
    "thousands": (HEAD + '1,0,"1,000.5"\n1,1,"2,000.5"\n', "column 'x': expected numbers such as 1234.5"),
    "semicolons": ("demonstration;x;y\n1;0,5;2\n1;1,5;3\n", "line 1: expected commas between names, found ';'"),
    "tabs": ("demonstration\tx\n1\t0.5\n1\t1.5\n", "line 1: expected commas between names"),
    "texts and numbers": (HEAD + "1,1,2\n1,2,a\n", "column 'x': expected numbers, found 'a' in row 2"),
    "many texts": ("\n".join(",".join(f"a{row}x{column}" for column in range(1500)) for row in range(700)), "columns of numbers"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_of_other_marks_or_many_texts_is_refused_at_once(name: str, capsys: Told) -> None:
    text, expected = TABLES[name]
    Path("x.csv").write_text(text)
    begin = time.process_time()
    refused(capsys, ["check", "x.csv"], "x.csv", expected)
    assert time.process_time() - begin < 5


def test_texts_with_commas_are_still_left_out_with_a_note(capsys: Told) -> None:
    rows = "".join(f'1,{time},{time}.5,"left, then {time}"\n' for time in range(9))
    Path("x.csv").write_text("demonstration,time,x,remark\n" + rows)
    succeed("check", "x.csv")
    assert "column 'remark' is not read, as it holds no numbers" in capsys.readouterr().err


def test_precision_is_that_of_all_columns_of_a_large_array(monkeypatch: pytest.MonkeyPatch) -> None:
    """Columns are examined in blocks."""
    from ftl_lightning.data import features

    values = np.cumsum(np.random.default_rng(0).normal(size=(2, 50, 7)), axis=1)
    far = values + np.where(np.arange(7) == 6, 5.8e7, 0)
    for block in (10**9, 300, 1):
        monkeypatch.setattr(features, "BLOCK", block)
        assert features.precise(values).dtype == np.float32
        assert features.precise(far).dtype == np.float64


def _deep(file: Any, depth: int) -> None:
    import h5py

    group = file.id
    for _ in range(depth):
        group = h5py.h5g.create(group, b"g")


@pytest.mark.parametrize("kind", ["groups", "arrays", "deep"])
def test_an_hdf5_file_of_many_or_deep_groups_is_refused(kind: str, capsys: Told) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File("x.h5", "w") as file:
        file["states"] = STATES
        for number in range(2500 if kind != "deep" else 0):
            file.create_group(f"g{number}") if kind == "groups" else file.create_dataset(f"observed/{number}", data=[1.0])
        if kind == "deep":
            _deep(file, 5000)
    refused(capsys, ["check", "x.h5"], "x.h5", "at most 40 deep" if kind == "deep" else "at most 2000 groups and arrays")


LISTED: dict[str, object] = {
    "number": [torch.ones(4, 2), 3],
    "text": [torch.ones(4, 2), "a"],
    "nothing": [torch.ones(4, 2), None],
    "flat": [torch.ones(4, 2), torch.ones(3)],
    "single numbers": [torch.tensor(1.0), torch.tensor([2.0])],
}


@pytest.mark.parametrize("name", LISTED)
def test_a_list_of_tensors_and_others_is_one_line(name: str, capsys: Told) -> None:
    torch.save(LISTED[name], "x.pt")
    refused(capsys, ["check", "x.pt"], "x.pt: key 'states'", "expected")


@pytest.mark.parametrize("key", ["states", "unread"])
def test_a_list_that_stands_for_many_is_refused(key: str, capsys: Told) -> None:
    listed: list[object] = [1.0] * 10
    for _ in range(9):
        listed = [listed] * 10
    torch.save({"states": torch.from_numpy(STATES), key: listed}, "x.pt")
    refused(capsys, ["check", "x.pt"], "x.pt: content: expected at most", "found more")


def test_wide_states_are_checked_in_part(capsys: Told) -> None:
    states = np.random.default_rng(0).normal(size=(3, 12, 1200)).cumsum(axis=1)
    np.savez("x.npz", states=states, concepts="walk")
    succeed("check", "x.npz")
    assert "the first 1000 of 1200 columns are checked" in capsys.readouterr().out


def test_a_kind_that_is_unknown_is_refused_by_check_too(capsys: Told) -> None:
    np.savez("x.npz", states=STATES, state_kinds=["linear", "foo"])
    refused(capsys, ["check", "x.npz"], "x.npz: key 'state_kinds': expected one of linear, angle", "'foo'")


def test_a_minari_space_of_many_parts_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Told) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    Demonstrations.of(list(STATES), "a").save("minari:robot-v0")
    path = tmp_path / "sets" / "robot-v0" / "data" / "metadata.json"
    box = {"type": "Box", "dtype": "float32", "shape": [1], "low": [0], "high": [1]}
    flat = {"type": "Tuple", "subspaces": [box] * 3000}
    deep = {"type": "Tuple", "subspaces": [{"type": "Tuple", "subspaces": [box] * 1000}] * 3}
    for space in (flat, deep):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"observation_space": json.dumps(space)}))
        refused(capsys, ["check", "robot-v0"], "robot-v0: key 'observation_space.subspaces': expected at most 2000")


@pytest.mark.parametrize("text", [b"," * 10**6, b"domain,task\n" + b"," * 10**6])
def test_results_of_endless_cells_are_refused(text: bytes, capsys: Told) -> None:
    Path("x.csv").write_bytes(text)
    expected = "x.csv: rows: expected at most 10000 cells in each, found 1000001"
    refused(capsys, ["report", "--results", "x.csv", "--out", "out"], expected)


def test_a_listing_of_too_many_films_is_refused(capsys: Told) -> None:
    Path("films").mkdir()
    Path("films/films.json").write_text(json.dumps([{"concept": "a", "method": "m", "file": "x"}] * 20_000))
    arguments = ["study", "mocap", "--films", "films", "--out", "out"]
    refused(capsys, arguments, "films.json: films: expected at most 10000, found 20000")


STAGE = {"verb": "invert", "config": "conf/agent.yaml"}
PLANS: dict[str, tuple[dict[str, object], str]] = {
    "no stages": ({"stages": []}, "stages: expected one or more, found none"),
    "cells": ({"stages": [STAGE | {"grid": {f"model.x{number}": list(range(100)) for number in range(4)}}]}, "20000 cells"),
    "each": ({"stages": [STAGE | {"each": {f"x{number}": ["a"] * 100 for number in range(4)}}]}, "20000 cells"),
    "unknown": (
        {"stages": [STAGE | {"options": {"model.output": "x/{nothing}"}}]},
        "placeholders among {seed}, found {nothing}",
    ),
    "attribute": ({"stages": [STAGE | {"name": "{seed.__class__}"}]}, "found {seed.__class__}"),
    "format": ({"stages": [STAGE | {"done": "{seed:03d}"}]}, "found {seed:03d}"),
    "in the file": ({"stages": [STAGE | {"config": "conf/{domain}.yaml"}]}, "found {domain}"),
}


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_of_endless_cells_or_unknown_placeholders_is_refused(name: str, capsys: Told) -> None:
    content, expected = PLANS[name]
    Path("plan.yaml").write_text(json.dumps(content | {"results": "r.csv"}))
    refused(capsys, ["ablate", "--config", "plan.yaml", "--status=true"], expected)
