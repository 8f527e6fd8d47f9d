"""The library of a model: training concepts, learned ones beside it, and saved ones; whatever else lies there is passed by."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ftl_lightning.cli.main import main
from ftl_lightning.igm.concept import KIND, VERSION, Concept, Origin, QualityRecord
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.igm.library import HEADINGS, concepts_folder, library, summary
from ftl_lightning.services.errors import LONGEST, UserError
from ftl_lightning.services.tensor_file import save_tensors
from tests.conftest import ROOT, refused

MOCAP = ROOT / "pretrained" / "mocap"
CONFIG = json.loads((MOCAP / "config.json").read_text())
HASH = CONFIG["hash"]
ORIGIN = Origin("a new one", "mocap", CONFIG["encoder"], HASH, "d", 5, "fixed", 0.1)
QUALITY = QualityRecord(40, 0.9, 0.8, 1.1, "rule", 0.825)
Told = pytest.CaptureFixture[str]


def concept(**changes: object) -> Concept:
    return Concept(torch.zeros(2, 1, 384), torch.ones(2), replace(ORIGIN, **changes))  # type: ignore[arg-type]


def saved(path: str | Path, **changes: object) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    concept(**changes).save(path)


def names(*folders: str) -> list[str]:
    return [entry.name for entry in library(HASH, (), None, folders)]


# What a file says of itself


def test_a_summary_tells_the_form_without_the_tensors() -> None:
    plain = concept()
    several = Modes(torch.zeros(3, 2, 1, 384), torch.ones(3, 2), False)
    forms = {
        "one set": plain,
        "3 modes": replace(plain, modes=several),
        "mixtures": replace(plain, modes=replace(several, mixed=True)),
        "one set over time": Concept(torch.zeros(2, 4, 384), torch.ones(2), ORIGIN),
    }
    for form, own in forms.items():
        own.save("c.safetensors")
        told = summary("c.safetensors")
        assert (told.form, told.origin, told.quality) == (form, ORIGIN, None)
    tensors = {"embeddings": torch.zeros(2, 4, 384), "weights": torch.ones(2)}
    tensors |= {"adapter/net.0/down": torch.zeros(2, 1, 4), "adapter/net.0/up": torch.zeros(2, 3, 1)}
    save_tensors("c.safetensors", KIND, tensors, ORIGIN.__dict__, VERSION)
    told = summary("c.safetensors")
    assert told.form == "adapter over time"
    assert summary(MOCAP / "model.safetensors") is summary(MOCAP / "judge.safetensors") is None


def test_quality_is_a_key_that_is_there_only_where_somebody_looked() -> None:
    concept().save("plain.safetensors")
    replace(concept(), quality=QUALITY).save("judged.safetensors")
    plain, judged = Path("plain.safetensors").read_bytes(), Path("judged.safetensors").read_bytes()
    assert b"quality" not in plain
    found = Concept.load("judged.safetensors")
    assert found.quality == QUALITY
    found.save("again.safetensors")
    assert Path("again.safetensors").read_bytes() == judged
    replace(found, quality=None).save("again.safetensors")
    assert Path("again.safetensors").read_bytes() == plain
    told = summary("judged.safetensors")
    assert told.quality == QUALITY


@pytest.mark.parametrize(
    ("quality", "expected"),
    [
        (QUALITY.__dict__ | {"right": 1.5}, "'quality.right': expected a number from 0"),
        (QUALITY.__dict__ | {"novelty": -1.0}, "'quality.novelty': expected 0 or more"),
        ({"samples": 40}, "'quality.novelty': expected a value, found none"),
        ({"samples": 40, "evil": "x"}, "'quality.evil': expected one of"),
        ("good", "'quality': expected a mapping, found 'good'"),
    ],
    ids=str,
)
def test_a_quality_that_is_none_is_told(quality: object, expected: str) -> None:
    tensors = {"embeddings": torch.zeros(2, 1, 384), "weights": torch.ones(2)}
    save_tensors("c.safetensors", KIND, tensors, {**ORIGIN.__dict__, "quality": quality}, VERSION)
    for read in (summary, Concept.load):
        with pytest.raises(UserError, match=expected):
            read("c.safetensors")


# What is in a library


def test_a_library_holds_training_concepts_then_shipped_then_saved_ones() -> None:
    saved("mine/first.safetensors")
    saved(concepts_folder() / HASH / "second.safetensors", name="kept")
    found = library(HASH, CONFIG["training_concepts"], MOCAP, ["mine"])
    kinds = [entry.kind for entry in found]
    assert kinds == ["training"] * len(CONFIG["training_concepts"]) + ["shipped"] * 3 + ["saved"] * 2
    assert [entry.name for entry in found.learned] == ["arm circle", "jumping jacks", "jumping jacks", "a new one", "kept"]
    assert {entry.model for entry in found} == {HASH}
    assert (found.others, found.damaged, found.notes) == (0, (), ())
    first = found.entries[0]
    assert (first.name, first.form) == (CONFIG["training_concepts"][0], "")
    assert (first.count, first.accuracy, first.path) == (None, None, None)
    shipped = found.learned[0]
    assert (shipped.count, shipped.form, shipped.path) == (5, "5 modes over time", MOCAP / "arm_circle.safetensors")
    assert "3 shipped concepts, 2 saved concepts" in repr(found)


def test_accuracy_is_what_the_file_says() -> None:
    replace(concept(), quality=QUALITY).save("c.safetensors")
    (entry,) = library(HASH, (), None, ["."])
    assert (entry.accuracy, entry.metric) == (0.825, "rule")
    assert "0.82 (rule)" in str(library(HASH, (), None, ["."]))


def test_a_file_that_two_folders_hold_is_one_concept() -> None:
    saved("mine/first.safetensors")
    Path("linked").symlink_to("mine")
    assert names("mine", "linked", "mine/../mine") == ["a new one"]


def test_concepts_of_other_models_are_counted_and_damaged_files_told() -> None:
    saved("mine/own.safetensors")
    for number in range(3):
        saved(f"mine/other{number}.safetensors", pretrained="0" * 16)
    Path("mine/cut.safetensors").write_bytes(Path("mine/own.safetensors").read_bytes()[:300])
    Path("mine/text.safetensors").write_text("hello")
    Path("mine/empty.safetensors").touch()
    os.mkfifo("mine/pipe.safetensors")
    Path("mine/zero.safetensors").symlink_to("/dev/zero")
    Path("mine/loop.safetensors").symlink_to("loop.safetensors")
    Path("mine/folder.safetensors").mkdir()
    with Path("mine/huge.safetensors").open("wb") as file:
        file.truncate(3 * 2**30)
    Path("mine/.hidden.safetensors").write_text("hello")
    found = library(HASH, (), None, ["mine"])
    assert [entry.name for entry in found] == ["a new one"]
    assert found.others == 3
    assert found.notes[0] == "not listed: 3 concepts of other models"
    told = "\n".join(found.damaged)
    assert all(name in told for name in ("cut", "text", "empty", "pipe", "zero", "loop", "folder", "huge"))
    assert "hidden" not in told
    assert len(found.damaged) == 8
    assert max(map(len, found.damaged)) <= LONGEST


def test_names_of_strangers_stay_in_their_line(capsys: Told) -> None:
    saved("mine/named.safetensors", name="red\x1b[31m\nrm -rf\u202e | x" + "y" * 500)
    Path(os.fsdecode(b"mine/\xfd.safetensors")).write_text("hello")
    assert main(["concepts", "mocap", "--folder=mine"]) == 0
    told = capsys.readouterr()
    (row,) = [one for one in told.out.splitlines() if "saved" in one]
    assert "\x1b" not in told.out + told.err
    assert "\u202e" not in row
    assert "red?[31m rm -rf" in row
    assert row.index("saved") < 100
    assert told.err.startswith("not listed: mine/?.safetensors: expected a concept file")
    assert told.err.count("\n") == 1


def test_a_folder_that_is_none_is_told_in_one_line(capsys: Told) -> None:
    Path("file").touch()
    for place, found in (("nowhere", "nothing"), ("file", "a file")):
        with pytest.raises(UserError, match=f"folder: expected a folder of learned concepts, found {found} at {place}"):
            names(place)
    for option, expected in (
        ("--folder=nowhere", "folder: expected a folder of learned concepts, found nothing"),
        ("--folder", "folder: expected a value, found none"),
        ("--folder=", "folder: expected a value, found none"),
    ):
        refused(capsys, ["concepts", "agent", option], expected)
        assert capsys.readouterr().out == ""


# By name


def test_a_learned_concept_is_found_by_its_name_or_else_its_files() -> None:
    saved("mine/a/concept.safetensors", name="one")
    saved("mine/b.safetensors", name="two")
    saved("mine/two.safetensors", name="three")
    found = library(HASH, (), None, ["mine"])

    def place(name: str) -> str:
        entry = found.learned_as(name)
        return str(entry.path) if entry is not None else ""

    assert place("one") == place("a") == "mine/a/concept.safetensors"
    assert place("two") == place("b") == "mine/b.safetensors"  # names go before files
    assert place("three") == "mine/two.safetensors"
    assert place("on") == place("concept") == place("") == place("../mine/b") == ""
    saved("mine/c.safetensors", name="one")
    with pytest.raises(UserError) as told:
        library(HASH, (), None, ["mine"]).learned_as("one")
    expected = "concept 'one': expected one, found mine/c.safetensors and mine/a/concept.safetensors; give one of these files"
    assert str(told.value) == expected


# On the command line


def test_the_verb_lists_training_concepts_first_and_alone_where_it_is_told_to(capsys: Told) -> None:
    saved("mine/first.safetensors")
    saved("yours/second.safetensors", pretrained="0" * 16)
    Path("yours/cut.safetensors").write_text("hello")
    assert main(["concepts", "mocap", "--plain=true"]) == 0
    plain = capsys.readouterr()
    assert plain.out.splitlines() == CONFIG["training_concepts"]
    assert plain.err == ""
    assert main(["concepts", "mocap", "--folder", "mine", "--folder=yours"]) == 0
    told = capsys.readouterr()
    training, learned = told.out.split("\n\n")
    assert training.splitlines() == CONFIG["training_concepts"]
    heading, *rows = learned.splitlines()
    assert tuple(heading.split()) == HEADINGS
    assert [row.split("  ")[0] for row in rows] == ["arm circle", "jumping jacks", "jumping jacks", "a new one"]
    assert {row.index(HASH) for row in rows} == {heading.index("model")}
    assert rows[-1].endswith("mine/first.safetensors")
    assert told.err.splitlines()[0] == "not listed: 1 concept of other models"
    assert "yours/cut.safetensors" in told.err.splitlines()[1]
