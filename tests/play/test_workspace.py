"""What was done on the page is what Python and the command line do."""

import base64
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.errors import UserError
from ftl_lightning.play import requests
from ftl_lightning.play.films import Json
from ftl_lightning.play.same import VARIABLES, Learned
from ftl_lightning.play.workspace import Stopped, Workspace
from ftl_lightning.testing.more_strokes import drawn
from tests.conftest import ROOT

TASK = "square diagonal to triangle"


@pytest.fixture
def workspace() -> Workspace:
    return Workspace("object_rearrangement")


def learned(workspace: Workspace, name: str = TASK, count: int = 5) -> tuple[Json, list[Json]]:
    """The last line that learning tells, and all of them."""
    workspace.draw(requests.Drawn(TASK, count))
    told: list[Json] = []
    workspace.learn(requests.Learn(name), told.append, lambda: False)
    return told[-1], told


def test_learning_tells_loss_and_samples_as_it_goes(workspace: Workspace) -> None:
    last, told = learned(workspace)
    steps = [line["step"] for line in told if "loss" in line]
    assert steps == sorted(set(steps))
    assert steps[0] == 1
    assert any("samples" in line and "done" not in line for line in told)
    assert last["done"]
    assert len(last["samples"]) == 8
    assert last["concept"]["accuracy"] > 0.8
    assert f"% right (accuracy: {TASK})" in last["quality"]["line"]
    assert "novelty" in last["quality"]["line"]
    assert "accuracy" in last["quality"]["line"]
    assert [one["kind"] for one in last["concepts"]].count("learned") == 1


def test_it_is_the_concept_that_python_learns(workspace: Workspace, tmp_path: Path) -> None:
    last, _ = learned(workspace)
    key = last["concept"]["id"]
    asked = requests.Sample((requests.Mixed(key, 0.8), requests.Mixed("t0", 1.2)), count=3, seed=2, temperature=0.5)
    mixed = workspace.sample(asked)
    name, content = workspace.demonstrations_file(key)
    (tmp_path / name).write_bytes(content)
    script = mixed["same"]["python"] + "samples.save('samples.safetensors')\nsquare_diagonal_to_triangle.save('own.safetensors')\n"
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"})
    file, concept = workspace.concept_file(key)
    (tmp_path / file).write_bytes(concept)
    own, other = Concept.load(tmp_path / "own.safetensors"), Concept.load(tmp_path / file)
    assert torch.equal(own.embeddings, other.embeddings)
    samples = Demonstrations.load(tmp_path / "samples.safetensors")
    drawn = [_circle(film) for film in mixed["samples"]]
    assert np.allclose(drawn, samples.states[:, 0, :2].numpy(), atol=2e-3)


def test_it_is_the_concept_that_the_commands_learn(workspace: Workspace, tmp_path: Path) -> None:
    last, _ = learned(workspace)
    key = last["concept"]["id"]
    told = workspace.sample(requests.Sample((requests.Mixed(key), requests.Mixed("t0", 0.5)), count=2))["same"]["command"]
    name, content = workspace.demonstrations_file(key)
    (tmp_path / name).write_bytes(content)
    for command in told.splitlines():
        command = command.replace("python ", f"{sys.executable} ", 1) + (
            " --evaluation.samples 2 --trainer.enable_progress_bar false" if " invert " in command else ""
        )
        subprocess.run(command, check=True, cwd=tmp_path, shell=True, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"})
    file, concept = workspace.concept_file(key)
    (tmp_path / "page.safetensors").write_bytes(concept)
    own, other = Concept.load(tmp_path / "concepts" / file), Concept.load(tmp_path / "page.safetensors")
    assert torch.equal(own.embeddings, other.embeddings)
    assert len(Demonstrations.load(tmp_path / "states.safetensors")) == 2


def _circle(film: Json) -> tuple[float, float]:
    """Where the first shape of a film is."""
    left, lower, width, _ = film["window"]
    x, y = np.frombuffer(base64.b64decode(film["shapes"][0]["points"]), dtype="<i2")[:2]
    return left + x * width / 10_000, lower + y * width / 10_000


def test_two_learned_concepts_are_mixed(workspace: Workspace) -> None:
    first, _ = learned(workspace)
    workspace.clear(requests.Nothing())
    second, _ = learned(workspace, "another", 3)
    parts = tuple(requests.Mixed(one["concept"]["id"], 0.5) for one in (first, second))
    mixed = workspace.sample(requests.Sample(parts, count=2))
    assert len(mixed["samples"]) == 2
    assert "0.5 * square_diagonal_to_triangle + 0.5 * another" in mixed["same"]["python"]


def test_changes_of_demonstrations_can_be_undone(workspace: Workspace) -> None:
    first = workspace.draw(requests.Drawn(TASK, 3))
    ids = [one["id"] for one in first["demonstrations"]]
    assert not first["demonstrations"][0]["flags"]
    fewer = workspace.remove(requests.One(ids[1]))
    assert [one["id"] for one in fewer["demonstrations"]] == [ids[0], ids[2]]
    assert not workspace.clear(requests.Nothing())["demonstrations"]
    assert [one["id"] for one in workspace.undo(requests.Nothing())["demonstrations"]] == [ids[0], ids[2]]
    assert [one["id"] for one in workspace.undo(requests.Nothing())["demonstrations"]] == ids
    assert not workspace.undo(requests.Nothing())["undo"]


def test_what_a_check_finds_stands_beside_the_demonstration(workspace: Workspace) -> None:
    drawn = workspace.draw(requests.Drawn(TASK, 3))
    _, content = workspace.demonstrations_file("")
    assert not any(one["flags"] for one in drawn["demonstrations"])
    workspace.upload("again.npz", content)
    assert all(one["flags"] for one in workspace.work()["demonstrations"])


def test_another_name_changes_neither_the_numbers_nor_the_code(workspace: Workspace, tmp_path: Path) -> None:
    last, _ = learned(workspace)
    key = last["concept"]["id"]
    before = Concept.load(saved(workspace, key, tmp_path / "before.safetensors"))
    workspace.rename(requests.Renamed(key, "my  diagonal"))
    after = Concept.load(saved(workspace, key, tmp_path / "after.safetensors"))
    assert torch.equal(before.embeddings, after.embeddings)
    assert (before.origin.name, after.origin.name) == (TASK, "my diagonal")
    told = workspace.sample(requests.Sample((requests.Mixed(key),), count=1))["same"]
    assert f"my_diagonal = model.learn(Demonstrations.load('my_diagonal.npz'), name={TASK!r}" in told["python"]
    assert "concepts/square_diagonal_to_triangle.safetensors" in told["command"]
    with pytest.raises(UserError, match="found one of the model's"):
        workspace.rename(requests.Renamed("t0", "mine"))


def saved(workspace: Workspace, key: str, path: Path) -> Path:
    """The concept's file."""
    path.write_bytes(workspace.concept_file(key)[1])
    return path


def test_files_come_back_as_they_were(workspace: Workspace, tmp_path: Path) -> None:
    last, _ = learned(workspace)
    file, content = workspace.concept_file(last["concept"]["id"])
    workspace.upload(file, content)
    opened = workspace.state()["concepts"][-1]
    assert (opened["kind"], opened["name"]) == ("opened", TASK)
    assert workspace.concept_file(opened["id"])[1] == content
    workspace.forget(requests.Named(opened["id"]))
    assert opened["id"] not in [one["id"] for one in workspace.state()["concepts"]]


def test_files_of_others_are_refused_by_the_name_that_the_person_knows(workspace: Workspace) -> None:
    own = Concept.load(ROOT / "pretrained" / "mocap" / "jumping_jacks.safetensors")
    assert own.origin.domain == "mocap"
    content = (ROOT / "pretrained" / "mocap" / "jumping_jacks.safetensors").read_bytes()
    with pytest.raises(UserError, match=r"^jumping_jacks\.safetensors: "):
        workspace.upload("jumping_jacks.safetensors", content)
    with pytest.raises(UserError, match=r"^five\.npz: "):
        workspace.upload("five.npz", b"nothing")


def test_learning_stops_when_nobody_waits(workspace: Workspace) -> None:
    workspace.draw(requests.Drawn(TASK, 3))
    told: list[Json] = []
    with pytest.raises(Stopped):
        workspace.learn(requests.Learn("left"), told.append, lambda: len(told) > 3)
    assert "left" not in [one["name"] for one in workspace.state()["concepts"]]


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


def test_all_that_is_told_is_json(workspace: Workspace) -> None:
    last, told = learned(workspace)
    for one in (*told, workspace.state(), workspace.thumbnail("t0"), workspace.thumbnail(last["concept"]["id"])):
        json.dumps(one, allow_nan=False)


@pytest.mark.parametrize(("name", "variable"), [("go to red bowl", "go_to_red_bowl"), ("5 steps!", "_5_steps"), ("---", "concept")])
def test_names_become_variables(name: str, variable: str) -> None:
    assert Learned("any", name).variable == variable
    assert variable.isidentifier()
    assert variable not in VARIABLES
