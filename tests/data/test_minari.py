"""Minari data sets, made here in a temporary folder."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.from_file import read_demonstrations, read_own
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import UserError
from ftl_lightning.training.data import OwnData

minari = pytest.importorskip("minari", reason="the extra 'minari' is not installed")
pytest.importorskip("h5py", reason="the extra 'minari' is not installed")

from minari.data_collector import EpisodeBuffer  # noqa: E402

from ftl_lightning.data.formats.minari import read_minari, write_minari  # noqa: E402
from tests.conftest import ROOT, succeed  # noqa: E402
from tests.data.samples import everything, expect_same  # noqa: E402

VECTOR = gymnasium.spaces.Box(-1, 1, (3,), np.float64)
IMAGE = gymnasium.spaces.Box(0, 255, (4, 4, 3), np.uint8)


@pytest.fixture(autouse=True)
def _data_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def episode(observations: Any, steps: int, infos: dict[str, Any] | None = None) -> EpisodeBuffer:
    return EpisodeBuffer(
        observations=observations,
        actions=list(np.zeros((steps, 1), np.float32)),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
        infos=infos,
    )


def make(name: str, episodes: list[EpisodeBuffer], space: gymnasium.Space[Any] = VECTOR) -> Any:
    action = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    return minari.create_dataset_from_buffers(name, episodes, observation_space=space, action_space=action)


def vectors(steps: int, value: float = 0.5) -> list[np.ndarray[Any, Any]]:
    return list(np.full((steps + 1, 3), value))


def own() -> Demonstrations:
    """Of states alone."""
    return replace(everything(), domain="", observed={}, per_step=(), scenes=None, provenance={})


def test_what_is_written_is_read_back() -> None:
    write_minari(own(), "strokes/test-v0")
    expect_same(read_minari("strokes/test-v0"), own(), provenance=False)
    episodes = list(minari.load_dataset("strokes/test-v0"))
    assert [len(one) for one in episodes] == [4, 2, 3, 4, 1, 4]
    assert episodes[0].truncations.tolist() == [False, False, False, True]


def test_features_scenes_and_names_are_read_back() -> None:
    written = everything()
    written.save("minari:strokes/all-v0")
    expect_same(Demonstrations.load("minari:strokes/all-v0"), written)
    expect_same(Demonstrations.load("strokes/all-v0"), written)
    space = minari.load_dataset("strokes/all-v0").observation_space
    assert sorted(space.spaces) == ["goal", "grid", "observation", "view", "wind"]
    assert read_minari("strokes/all-v0", observed=["wind", "goal"]).per_step == ("wind",)
    winds = read_minari("strokes/all-v0", "wind", [])
    assert (winds.state_names, winds.per_step) == (("0", "1", "2"), ())
    assert torch.equal(winds.states, written.observed["wind"])


def test_data_sets_of_the_form_before_features_are_read() -> None:
    made = make("form-v0", [episode(vectors(2), 2)])
    made.storage.update_metadata({"ftl_lightning": {"domain": "d", "state_names": ["x", "y", "z"], "state_units": ["m"] * 3}})
    found = read_minari("form-v0")
    assert (found.domain, found.state_names, found.state_units) == ("d", ("x", "y", "z"), ("m", "m", "m"))
    made.storage.update_metadata({"ftl_lightning": {"domain": 1}})
    with pytest.raises(UserError, match=r"form-v0: key 'ftl_lightning.domain': expected a text, found 1"):
        read_minari("form-v0")


def test_names_that_cannot_be_keys_are_refused() -> None:
    for name in ("observation", "a/b"):
        written = Demonstrations(torch.rand(1, 2, 1), torch.tensor([2]), "", ("x",), ("",), ("a",), {name: torch.rand(1, 2)})
        with pytest.raises(UserError, match=r"x-v0: expected the name of an observed feature other than 'observation' and without"):
            write_minari(written, "x-v0")


def test_a_texts_place_is_the_episode_then_its_metadata_then_the_data_set() -> None:
    infos = [{"concept": ["go left"] * 3}, None, {"speed": [1.0] * 3}]
    made = make("three-v0", [episode(vectors(2, row / 4), 2, info) for row, info in enumerate(infos)])
    made.storage.update_episode_metadata([{"concept": "go right"}], [1])
    assert read_minari("three-v0").concepts == ("go left", "go right", "three-v0")
    made.storage.update_metadata({"concept": "wait"})
    found = read_minari("three-v0")
    assert found.concepts == ("go left", "go right", "wait")
    assert found.states.dtype == torch.float32
    assert found.states[:, 0, 0].tolist() == [0.0, 0.25, 0.5]
    make("long-v0", [episode(vectors(2), 2), episode(vectors(5), 5)])
    found = read_minari("long-v0")  # a shorter episode is padded
    assert found.lengths.tolist() == [3, 6]
    assert found.states.shape == (2, 6, 3)


def test_of_several_parts_the_observation_or_the_only_vector_is_read() -> None:
    parts = {"observation": VECTOR, "goal": VECTOR}
    both = {"observation": vectors(2, 0.25), "goal": vectors(2, 0.75)}
    make("goal-v0", [episode(both, 2)], gymnasium.spaces.Dict(parts))
    found = read_minari("goal-v0")
    assert (found.states == 0.25).all()
    assert (found.observed["goal"] == 0.75).all()
    assert (found.per_step, found.observed["goal"].shape) == (("goal",), (1, 3, 3))
    assert read_minari("goal-v0", observed=()).observed == {}
    assert (read_minari("goal-v0", "goal", ()).states == 0.75).all()
    with pytest.raises(UserError, match=r"goal-v0: observed: expected some of goal, observation, found 'speed'"):
        read_minari("goal-v0", observed=["speed"])
    with pytest.raises(UserError, match=r"goal-v0: expected .* one of goal, observation, found 'speed'"):
        read_minari("goal-v0", "speed")
    pose = {"pose": vectors(2), "camera": list(np.zeros((3, 4, 4, 3), np.uint8))}
    make("camera-v0", [episode(pose, 2)], gymnasium.spaces.Dict({"pose": VECTOR, "camera": IMAGE}))
    assert read_minari("camera-v0").states.shape == (1, 3, 3)
    assert read_minari("camera-v0").observed == {}


def test_what_is_no_data_set_of_vectors_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none-v0: expected a file or an installed Minari data set, found neither"):
        read_minari("none-v0")
    make("image-v0", [episode(list(np.zeros((3, 4, 4, 3), np.uint8)), 2)], IMAGE)
    with pytest.raises(UserError, match=r"image-v0: expected observations that are vectors .*, found Box"):
        read_minari("image-v0")
    make("nan-v0", [episode(vectors(2, float("nan")), 2)])
    with pytest.raises(UserError, match=r"nan-v0: key 'states': expected finite numbers"):
        read_minari("nan-v0")
    make("torn-v0", [episode(vectors(2), 2)])
    (tmp_path / "minari" / "torn-v0" / "data" / "main_data.hdf5").write_bytes(b"torn")
    with pytest.raises(UserError, match=r"torn-v0: expected a Minari data set, found a damaged"):
        read_minari("torn-v0")


def test_a_data_set_is_not_written_over_and_single_states_are_no_episodes() -> None:
    write_minari(own(), "twice-v0")
    with pytest.raises(UserError, match=r"twice-v0: cannot be written .*already exists"):
        write_minari(own(), "twice-v0")
    with pytest.raises(UserError, match=r"no name: cannot be written"):
        write_minari(own(), "no name")
    scenes = load_domain("object_rearrangement").source(None).draw("circle right of square", 2, 0)
    with pytest.raises(UserError, match=r"scenes-v0: expected demonstrations of two states or more"):
        write_minari(scenes, "scenes-v0")


def test_the_name_of_a_data_set_stands_for_a_file() -> None:
    write_minari(own(), "strokes/own-v0")
    assert read_own("strokes/own-v0").concepts == own().concepts
    data = OwnData("strokes/own-v0", encoder="hashing", validation_share=0.4)
    assert data.domain.concepts.training == ("go up", "go dówn")
    data.setup("fit")
    assert len(data.training) == 4
    with pytest.raises(UserError, match=r"strokes/own-v0: key 'states': expected states of 21 columns"):
        read_demonstrations("strokes/own-v0", load_domain("object_rearrangement"))


def test_demonstrations_of_a_domain_are_generated_into_a_data_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "examples" / "ftl-strokes")
    succeed("generate", "ftl_strokes:DOMAIN", "--task=arc upwards", "--count=3", "--out=minari:strokes/arcs-v0")
    strokes = load_domain("ftl_strokes:DOMAIN")
    found = read_demonstrations("strokes/arcs-v0", strokes)
    assert torch.equal(found.states, strokes.source(None).draw("arc upwards", 3, 0).states)
    assert found.concepts == ("arc upwards",) * 3
