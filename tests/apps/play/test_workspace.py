"""What was done on the page is what Python and the command line do."""

import base64
import copy
import json
import runpy
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.strokes import drawn
from ftl_lightning.apps.play import requests, workspace
from ftl_lightning.apps.play.mixing import Json
from ftl_lightning.apps.play.same import VARIABLES, Learned
from ftl_lightning.apps.play.workspace import Stopped, Workspace
from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.settings import PAPER
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.concept_model import ConceptModel
from tests.conftest import ROOT

TASK = "square diagonal to triangle"
Taught = tuple[Workspace, list[Json]]


STEPS = 150
"""Of learning in a second or two: enough for most samples to be right."""


@pytest.fixture(scope="module")
def first() -> Workspace:
    """Object rearrangement, as it is opened."""
    return Workspace("object_rearrangement")


@pytest.fixture
def opened(first: Workspace) -> Workspace:
    return copy.deepcopy(first)


@pytest.fixture(scope="module")
def taught(first: Workspace) -> Taught:
    """The same after a concept was learned, and what was told; samples are shown once on the way."""
    changed = copy.deepcopy(first)
    with pytest.MonkeyPatch.context() as patch:
        for name, seconds in {"FIRST": 0.0, "INTERVAL": 1e9, "REPORT": 0.0}.items():
            patch.setattr(workspace, name, seconds)
        patch.setattr(Workspace, "_settings", quickly)
        return changed, learn(changed)


def quickly(of: Workspace, quick: bool) -> tuple[dict[str, Any], int]:
    """Settings of the page, with fewer steps."""
    return {"form": PAPER}, STEPS


@pytest.fixture
def after(taught: Taught) -> Workspace:
    return copy.deepcopy(taught[0])


@pytest.fixture
def key(taught: Taught) -> str:
    """Of the concept that was learned."""
    return str(taught[1][-1]["concept"]["id"])


def learn(of: Workspace, name: str = TASK, count: int = 5) -> list[Json]:
    """All lines that learning tells."""
    of.draw(requests.Drawn(TASK, count))
    told: list[Json] = []
    of.learn(requests.Learn(name), told.append, lambda: False)
    return told


def test_learning_tells_loss_and_samples_as_it_goes(taught: Taught) -> None:
    *_, last = told = taught[1]
    steps = [line["step"] for line in told if "loss" in line]
    assert steps == [*range(1, len(steps) + 1)]
    assert any("samples" in line and "done" not in line for line in told)
    assert last["done"]
    assert len(last["samples"]) == 8
    assert last["concept"]["accuracy"] > 0.8
    assert f"% of 40 samples right (accuracy: {TASK})" in last["quality"]["line"]
    assert "novelty" in last["quality"]["line"]
    assert "accuracy" in last["quality"]["line"]
    assert [one["kind"] for one in last["concepts"]].count("learned") == 1


@pytest.mark.slow
def test_it_is_the_concept_that_python_learns(after: Workspace, key: str, tmp_path: Path) -> None:
    asked = requests.Sample((requests.Mixed(key, 0.8), requests.Mixed("t0", 1.2)), count=3, seed=2, temperature=0.5)
    mixed = after.sample(asked)
    download(after, key)
    script = mixed["same"]["python"] + "samples.save('samples.safetensors')\nsquare_diagonal_to_triangle.save('own.safetensors')\n"
    Path("script.py").write_text(script)
    runpy.run_path("script.py")
    assert same_numbers(after, key, Path("own.safetensors"))
    samples = Demonstrations.load("samples.safetensors")
    drawn = [_circle(film) for film in mixed["samples"]]
    assert np.allclose(drawn, samples.states[:, 0, :2].numpy(), atol=2e-3)


@pytest.mark.slow
def test_it_is_the_concept_that_the_commands_learn(opened: Workspace) -> None:
    key = learn(opened)[-1]["concept"]["id"]
    told = opened.sample(requests.Sample((requests.Mixed(key), requests.Mixed("t0", 0.5)), count=2))["same"]["command"]
    download(opened, key)
    for command in told.splitlines():
        python, option, program, *arguments = shlex.split(command)
        assert (python, option, program) == ("python", "-m", "ftl_lightning")
        if arguments[0] == "invert":
            arguments += ["--evaluation.samples", "2", "--trainer.enable_progress_bar", "false"]
        assert main(arguments) == 0
    assert same_numbers(opened, key, Path("concepts") / opened.concept_file(key)[0])
    assert len(Demonstrations.load("states.safetensors")) == 2


def download(of: Workspace, key: str) -> None:
    """Save the demonstrations that a concept was learned from."""
    name, content = of.demonstrations_file(key)
    Path(name).write_bytes(content)


def same_numbers(of: Workspace, key: str, path: Path) -> bool:
    """Whether a file holds the concept that the page has."""
    return torch.equal(Concept.load(path).embeddings, saved(of, key, Path("page.safetensors")).embeddings)


def saved(of: Workspace, key: str, path: Path) -> Concept:
    """The concept's file."""
    path.write_bytes(of.concept_file(key)[1])
    return Concept.load(path)


def _circle(film: Json) -> tuple[float, float]:
    """Where the first shape of a film is."""
    left, lower, width, _ = film["window"]
    x, y = np.frombuffer(base64.b64decode(film["shapes"][0]["points"]), dtype="<i2")[:2]
    return left + x * width / 10_000, lower + y * width / 10_000


@pytest.mark.slow
def test_two_learned_concepts_are_mixed(after: Workspace, key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Workspace, "_settings", lambda self, quick: ({}, 5))
    after.clear(requests.Nothing())
    second = learn(after, "another", 3)[-1]["concept"]["id"]
    parts = tuple(requests.Mixed(one, 0.5) for one in (key, second))
    mixed = after.sample(requests.Sample(parts, count=2))
    assert len(mixed["samples"]) == 2
    assert "0.5 * square_diagonal_to_triangle + 0.5 * another" in mixed["same"]["python"]


@pytest.mark.slow
@pytest.mark.parametrize(("accuracy", "better"), [(0.0, True), (1.0, False)])
def test_learning_again_replaces_what_is_not_better(
    after: Workspace, key: str, accuracy: float, better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Workspace, "_settings", lambda self, quick: ({"form": "auto"}, 10))
    after.rename(requests.Renamed(key, "mine"))
    known = after._concepts[key] = replace(after._concepts[key], accuracy=accuracy)
    told: list[Json] = []
    after.learn(requests.Learn(again=key), told.append, lambda: False)
    (last,) = told
    now = after._concepts[key]
    assert ("concept" in last) == better
    assert (now is known) != better
    assert now.name == "mine"
    if better:
        assert last["concept"] in last["concepts"]
        assert last["concept"]["form"] not in ("", "one set")
        assert saved(after, key, Path("again.safetensors")).origin.name == "mine"
        assert "form='auto'" in after.work()["same"]["python"]


def test_a_concept_learned_again_replaces_the_former_which_comes_back(
    after: Workspace, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Workspace, "_settings", quickly)
    before, former = after.state()["concepts"], after.concept_file(key)
    told: list[Json] = []
    after.draw(requests.Drawn("circle right of square", 2))
    after.learn(requests.Learn(TASK, replaces=key), told.append, lambda: False)
    assert told[-1]["concept"]["id"] == key
    assert told[-1]["concept"]["former"]
    assert len(after.state()["concepts"]) == len(before)
    assert after.concept_file(key)[0] == former[0]
    assert after.concept_file(key)[1] != former[1]
    after.rename(requests.Renamed(key, "mine"))
    assert after.restore(requests.Named(key))["concept"]["name"] == "mine"
    after.rename(requests.Renamed(key, TASK))
    back = {"concepts": after.state()["concepts"]}
    assert back["concepts"] == before
    assert after.concept_file(key) == former
    with pytest.raises(UserError, match="expected a concept with a former version"):
        after.restore(requests.Named(key))


def test_learning_again_in_the_same_form_changes_nothing(after: Workspace, key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Workspace, "_settings", lambda self, quick: ({"form": PAPER}, 5))
    known = after._concepts[key]
    after.learn(requests.Learn(again=key), lambda line: None, lambda: False)
    assert after._concepts[key] is known
    with pytest.raises(UserError, match="id: expected a concept that was learned here, found 'circle right"):
        after.learn(requests.Learn(again="t0"), lambda line: None, lambda: False)


def test_learning_again_ends_with_the_concept(after: Workspace, key: str) -> None:
    def forgotten() -> bool:
        if key in after._concepts:
            after.forget(requests.Named(key))
        return False

    with pytest.raises(Stopped):
        after.learn(requests.Learn(again=key), lambda line: None, forgotten)


def test_changes_of_demonstrations_can_be_undone(opened: Workspace) -> None:
    first = opened.draw(requests.Drawn(TASK, 3))
    ids = [one["id"] for one in first["demonstrations"]]
    assert not first["demonstrations"][0]["flags"]
    fewer = opened.remove(requests.One(ids[1]))
    assert [one["id"] for one in fewer["demonstrations"]] == [ids[0], ids[2]]
    assert not opened.clear(requests.Nothing())["demonstrations"]
    assert [one["id"] for one in opened.undo(requests.Nothing())["demonstrations"]] == [ids[0], ids[2]]
    assert [one["id"] for one in opened.undo(requests.Nothing())["demonstrations"]] == ids
    assert not opened.undo(requests.Nothing())["undo"]


def test_what_a_check_finds_stands_beside_the_demonstration(opened: Workspace) -> None:
    drawn = opened.draw(requests.Drawn(TASK, 3))
    _, content = opened.demonstrations_file("")
    assert not any(one["flags"] for one in drawn["demonstrations"])
    opened.upload("again.npz", content)
    assert all(one["flags"] for one in opened.work()["demonstrations"])


def test_another_name_changes_neither_the_numbers_nor_the_code(after: Workspace, key: str) -> None:
    before = saved(after, key, Path("before.safetensors"))
    after.rename(requests.Renamed(key, "my  diagonal"))
    renamed = saved(after, key, Path("after.safetensors"))
    assert torch.equal(before.embeddings, renamed.embeddings)
    assert (before.origin.name, renamed.origin.name) == (TASK, "my diagonal")
    told = after.sample(requests.Sample((requests.Mixed(key),), count=1))["same"]
    assert f"my_diagonal = model.learn(Demonstrations.load('my_diagonal.npz'), name={TASK!r}" in told["python"]
    assert "concepts/square_diagonal_to_triangle.safetensors" in told["command"]
    with pytest.raises(UserError, match="found one of the model's"):
        after.rename(requests.Renamed("t0", "mine"))


def test_files_come_back_as_they_were(after: Workspace, key: str) -> None:
    file, content = after.concept_file(key)
    after.upload(file, content)
    opened = after.state()["concepts"][-1]
    assert (opened["kind"], opened["name"]) == ("opened", TASK)
    assert after.concept_file(opened["id"])[1] == content
    after.forget(requests.Named(opened["id"]))
    assert opened["id"] not in [one["id"] for one in after.state()["concepts"]]


def test_files_of_others_are_refused_by_the_name_that_the_person_knows(opened: Workspace) -> None:
    own = Concept.load(ROOT / "pretrained" / "mocap" / "jumping_jacks.safetensors")
    assert own.origin.domain == "mocap"
    content = (ROOT / "pretrained" / "mocap" / "jumping_jacks.safetensors").read_bytes()
    with pytest.raises(UserError, match=r"^jumping_jacks\.safetensors: "):
        opened.upload("jumping_jacks.safetensors", content)
    with pytest.raises(UserError, match=r"^five\.npz: "):
        opened.upload("five.npz", b"nothing")


def test_learning_stops_when_nobody_waits(opened: Workspace) -> None:
    opened.draw(requests.Drawn(TASK, 3))
    told: list[Json] = []
    with pytest.raises(Stopped):
        opened.learn(requests.Learn("left"), told.append, lambda: len(told) > 3)
    assert "left" not in [one["name"] for one in opened.state()["concepts"]]


@pytest.mark.slow
def test_the_list_of_concepts_does_not_hash_the_weights(opened: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(ConceptModel, "hash")
    assert all(concept["hash"] for concept in opened.state()["concepts"])


@pytest.mark.slow
def test_an_older_concept_of_the_same_kind_is_no_rival() -> None:
    strokes = Workspace("strokes")
    for name in ("first heart", "second heart"):
        strokes.clear(requests.Nothing())
        place = strokes.scene(requests.Pose())["scene"]
        for stroke in drawn("heart", 5, 3):
            path = [[[float(x), float(y)]] for x, y in stroke]
            strokes.record(requests.Recorded(place, path, [0.02 * step for step in range(len(path))]))
        told: list[Json] = []
        strokes.learn(requests.Learn(name), told.append, lambda: False)
        assert told[-1]["concept"]["accuracy"] > 0.8


def test_all_that_is_told_is_json(taught: Taught, key: str) -> None:
    of, told = taught
    for one in (*told, of.state(), of.thumbnail("t0"), of.thumbnail(key)):
        json.dumps(one, allow_nan=False)


@pytest.mark.parametrize(("name", "variable"), [("go to red bowl", "go_to_red_bowl"), ("5 steps!", "_5_steps"), ("---", "concept")])
def test_names_become_variables(name: str, variable: str) -> None:
    assert Learned("any", name).variable == variable
    assert variable.isidentifier()
    assert variable not in VARIABLES


def test_without_recordings_the_model_generates_demonstrations() -> None:
    space = Workspace("mocap")
    library = space.state()["library"]
    assert library["tasks"][:2] == ["arm circle", "jumping jacks"]
    assert "walk" in library["tasks"]
    assert "generates these demonstrations" in library["why"]
    collected = space._demonstrating
    collected.draw(requests.Drawn(task="jumping jacks", count=5))
    assert len(collected.report()["demonstrations"]) == 5
    again = collected.together("jumping jacks")
    assert again.states.shape == (5, 32, 42)
    with pytest.raises(UserError, match="task: expected a concept of this model, found squat"):
        collected.draw(requests.Drawn(task="squat", count=1))


def test_a_folder_of_recordings_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    library = Workspace("mocap", tmp_path).state()["library"]
    assert library["tasks"] == []
    assert "expected recordings.npz, found an empty folder" in library["why"]
