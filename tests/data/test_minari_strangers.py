"""Minari data sets of other people: nested parts, and files that are damaged or made to harm."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Text, Tuple

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import Note, UserError
from tests.conftest import refused, succeed

minari = pytest.importorskip("minari", reason="the extra 'minari' is not installed")
h5py = pytest.importorskip("h5py", reason="the extra 'minari' is not installed")

from ftl_lightning.data.formats.minari import read_minari  # noqa: E402
from tests.data.test_minari import IMAGE, VECTOR, episode, make, vectors  # noqa: E402

DATA = Path("minari") / "robot-v0" / "data"
FILE = DATA / "main_data.hdf5"


@pytest.fixture(autouse=True)
def _data_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


NESTED = Dict(
    {
        "observation": VECTOR,
        "goal": Dict({"achieved": VECTOR, "desired": Dict({"place": VECTOR, "kind": Discrete(3)})}),
        "hands": Tuple((VECTOR, Box(-1, 1, (2,), np.float32))),
        "words": Text(5),
        "camera": IMAGE,
    }
)


def nested(steps: int) -> dict[str, Any]:
    desired = {"place": vectors(steps, 0.3), "kind": [2] * (steps + 1)}
    return {
        "observation": vectors(steps, 0.1),
        "goal": {"achieved": vectors(steps, 0.2), "desired": desired},
        "hands": (vectors(steps, 0.4), list(np.full((steps + 1, 2), 0.6, np.float32))),
        "words": ["abc"] * (steps + 1),
        "camera": list(np.zeros((steps + 1, 4, 4, 3), np.uint8)),
    }


@pytest.mark.parametrize("form", ["hdf5", "arrow", "parquet"])
def test_all_nested_parts_are_read_or_named(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    if form != "hdf5":
        pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    episodes = [episode(nested(2), 2, {"concept": ["go"] * 3}), episode(nested(3), 3)]
    action = Box(-1, 1, (1,), np.float32)
    minari.create_dataset_from_buffers("robot-v0", episodes[:1], observation_space=NESTED, action_space=action, data_format=form)
    with pytest.warns(Note, match="robot-v0: left out camera, goal/desired/kind, words: only vectors are read"):
        found = Demonstrations.load("robot-v0")
    means = {name: (tuple(values.shape), round(float(values.mean()), 4)) for name, values in found.observed.items()}
    assert means == {
        "goal/achieved": ((1, 3, 3), 0.2),
        "goal/desired/place": ((1, 3, 3), 0.3),
        "hands/0": ((1, 3, 3), 0.4),
        "hands/1": ((1, 3, 2), 0.6),
    }
    assert float(found.states.mean()) == pytest.approx(0.1)
    assert found.concepts == ("go",)
    goals = read_minari("robot-v0", "goal/desired/place", ["hands/1"])
    assert float(goals.states.mean()) == pytest.approx(0.3)
    assert [*goals.observed] == ["hands/1"]
    assert capsys.readouterr().err == ""
    found.save("robot.safetensors")
    assert torch.equal(Demonstrations.load("robot.safetensors").observed["goal/achieved"], found.observed["goal/achieved"])
    succeed("check", "robot-v0")


def test_which_part_holds_the_states_is_asked_if_a_nested_part_may_do() -> None:
    space = Dict({"observation": Dict({"arm": VECTOR, "base": VECTOR}), "goal": VECTOR})
    both = {"observation": {"arm": vectors(2, 0.1), "base": vectors(2, 0.2)}, "goal": vectors(2, 0.3)}
    make("robot-v0", [episode(both, 2)], space)
    with pytest.raises(UserError, match=r"the states, one of goal, observation/arm, observation/base, found Dict"):
        read_minari("robot-v0")
    assert float(read_minari("robot-v0", "observation/arm").states.mean()) == pytest.approx(0.1)


def test_grey_images_are_written_without_loss() -> None:
    image = torch.arange(32 * 32).remainder(256).to(torch.uint8).reshape(1, 1, 32, 32)
    written = Demonstrations(
        torch.rand(1, 2, 1), torch.tensor([2]), "", ("x",), ("",), ("a",), {"grid": image.repeat(1, 2, 1, 1)}, ("grid",)
    )
    written.save("minari:grey-v0")
    assert torch.equal(Demonstrations.load("minari:grey-v0").observed["grid"], written.observed["grid"])


def changed(change: Callable[[Any], object]) -> Callable[[], None]:
    """A change of the HDF5 file."""

    def mend() -> None:
        with h5py.File(FILE, "a") as file:
            change(file)

    return mend


def told(**changes: Any) -> Callable[[], None]:
    """A change of the metadata; ``None`` removes a key."""

    def mend() -> None:
        path = DATA / "metadata.json"
        content = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))

    return mend


def put(file: Any, name: str, values: Any, **options: Any) -> None:
    del file[name]
    file.create_dataset(name, data=values, **options)


def virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((3, 3), "f8")
    layout[:] = h5py.VirtualSource("secret.h5", "x", (3, 3))
    del file["episode_0/observations"]
    file.create_virtual_dataset("episode_0/observations", layout)


def outside(file: Any, name: str = "episode_0/observations") -> None:
    Path("secret").write_bytes(bytes(72))
    del file[name]
    file.create_dataset(name, (3, 3), "f8", external=[("secret", 0, 72)])


def linked(name: str, link: Any) -> Callable[[], None]:
    return changed(lambda file: (file.pop(name, None), file.__setitem__(name, link)))


STATES = "episode_0/observations"
SECRET = "expected data of this file, found "
HUGE = json.dumps({"type": "Box", "dtype": "float32", "shape": [1000, 1000, 1000], "low": 0, "high": 1})
ENVIRONMENT = json.dumps({"id": "x-v0", "entry_point": "os:system", "kwargs": {"command": "touch owned"}})
DEEP: Any = {"type": "Dict", "subspaces": {"a": 1}}
HARMS: dict[str, tuple[Callable[[], object], str]] = {
    "soft cycle": (linked("episode_0/infos/again", h5py.SoftLink("/episode_0")), f"episode_0/infos/again: {SECRET}a link"),
    "soft states": (linked(STATES, h5py.SoftLink("/episode_1/observations")), f"{STATES}: {SECRET}a link"),
    "hard cycle": (
        changed(lambda file: file["episode_0/infos"].__setitem__("again", file["episode_0"])),
        "episode_0/infos/again: expected an object of a single name",
    ),
    "root cycle": (changed(lambda file: file["episode_0"].__setitem__("top", file["/"])), "episode_0/top: expected an object of a"),
    "shared": (
        changed(lambda file: file.__setitem__("episode_2", file["episode_1"])),
        "episode_2: expected an object of a single name",
    ),
    "external": (linked(STATES, h5py.ExternalLink("/etc/secret.h5", "/x")), f"{STATES}: {SECRET}a link to another place or file"),
    "storage": (changed(outside), f"{STATES}: {SECRET}external storage"),
    "actions": (changed(lambda file: outside(file, "episode_0/actions")), f"episode_0/actions: {SECRET}external storage"),
    "virtual": (changed(virtual), f"{STATES}: {SECRET}a virtual data set"),
    "width": (
        changed(lambda file: put(file, "episode_1/observations", np.zeros((3, 4)))),
        "episode 1: observations: expected steps of shape (3,), as in metadata, found (4,)",
    ),
    "depth": (
        changed(lambda file: put(file, STATES, np.zeros((3, 3, 1)))),
        "episode 0: observations: expected steps of shape (3,)",
    ),
    "scalar": (changed(lambda file: put(file, STATES, 1.0)), "episode 0: observations: expected steps of shape (3,)"),
    "no steps": (changed(lambda file: put(file, STATES, np.zeros((0, 3)))), "episode 0: observations: expected at least one step"),
    "texts": (changed(lambda file: put(file, STATES, [["a"] * 3] * 3)), "episode 0: observations: expected numbers, found others"),
    "group": (
        changed(lambda file: (file.pop(STATES), file.create_group(STATES))),
        "episode 0: observations: expected numbers, found",
    ),
    "missing": (changed(lambda file: file.pop(STATES)), "expected a Minari data set, found a damaged"),
    "bomb": (
        changed(lambda file: (file.pop(STATES), file.create_dataset(STATES, (10**9, 3), "f8", compression="gzip"))),
        "arrays: expected at most",
    ),
    "hole": (changed(lambda file: (file.pop(STATES), file.create_dataset(STATES, (10**12, 3), "f8"))), "arrays: expected at most"),
    "number": (changed(lambda file: file.move("episode_1", "episode_7")), "expected a Minari data set, found a damaged"),
    "one more": (told(total_episodes=3), "key 'total_episodes': expected 2, as in the file, found 3"),
    "one less": (told(total_episodes=1), "key 'total_episodes': expected 2, as in the file, found 1"),
    "billion": (told(total_episodes=10**9), "key 'total_episodes': expected a whole number from 0 to 1000000, found 1000000000"),
    "negative": (told(total_episodes=-1), "key 'total_episodes': expected a whole number"),
    "no count": (told(total_episodes=None), "key 'total_episodes': expected a whole number"),
    "huge space": (told(observation_space=HUGE), "key 'observation_space.shape': expected at most 1000000 numbers"),
    "huge action": (told(action_space=HUGE), "key 'action_space.shape': expected at most 1000000 numbers"),
    "code": (told(observation_space=None, env_spec=ENVIRONMENT), "key 'observation_space': expected a text, found None"),
    "no space": (told(observation_space="{}"), "expected a Minari data set, found a damaged"),
    "odd space": (told(observation_space='{"type": "Dict", "subspaces": 3}'), "expected a Minari data set, found a damaged"),
    "other space": (told(observation_space='{"type": "Graph"}'), "expected a Minari data set, found a damaged"),
    "deep space": (told(observation_space='{"subspaces": [' * 5000), "expected a Minari data set, found a damaged"),
    "format": (told(data_format="pickle"), "key 'data_format': expected one of"),
    "arrow": (told(data_format="arrow"), "total_episodes: expected a folder for each, found 2"),
    "version": (told(minari_version="9.9.9" + "x" * 100_000), "expected a Minari data set, found a damaged"),
    "no JSON": (lambda: (DATA / "metadata.json").write_text("{" * 100_000), "expected a Minari data set, found a damaged"),
    "no metadata": (lambda: (DATA / "metadata.json").unlink(), "expected a Minari file, found nothing"),
    "torn": (lambda: FILE.write_bytes(FILE.read_bytes()[:3000]), "expected a Minari data set, found a damaged"),
    "no file": (lambda: FILE.unlink(), "expected a Minari data set, found a damaged"),
    "overflow": (changed(lambda file: put(file, STATES, np.full((3, 3), 1e300))), "key 'states': expected finite numbers"),
}


@pytest.mark.parametrize("name", HARMS)
def test_a_damaged_or_hostile_data_set_is_one_line(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    make("robot-v0", [episode(vectors(2), 2, {"speed": [1.0] * 3}), episode(vectors(2), 2)])
    assert len(read_minari("robot-v0")) == 2
    harm, expected = HARMS[name]
    harm()
    capfd.readouterr()
    with pytest.raises(UserError) as mistake:
        read_minari("robot-v0")
    message = str(mistake.value)
    assert message.startswith("robot-v0: ") or "metadata.json" in message
    assert expected in message
    assert "\n" not in message
    assert len(message) <= 400
    assert capfd.readouterr().err == ""
    assert not Path("owned").exists()


@pytest.mark.parametrize("name", ["hard cycle", "external", "width", "billion"])
def test_the_program_says_so_in_one_line(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    make("robot-v0", [episode(vectors(2), 2, {"speed": [1.0] * 3}), episode(vectors(2), 2)])
    harm, expected = HARMS[name]
    harm()
    refused(capsys, ["check", "robot-v0"], expected)


def test_the_first_text_is_read_of_any_array_of_texts() -> None:
    make("robot-v0", [episode(vectors(2), 2, {"concept": ["go", "wait", "wait"]}), episode(vectors(2), 2, {"speed": [1.0] * 3})])
    with h5py.File(FILE, "a") as file:
        file["episode_1/infos/concept"] = "stop"
    assert read_minari("robot-v0").concepts == ("go", "stop")
