"""LeRobot data sets: what is written is read back, what LeRobot itself wrote is read, and what is damaged is one line."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.from_file import read_demonstrations, read_own
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.services.errors import Note, UserError
from ftl_lightning.training.data import OwnData
from tests.conftest import refused, succeed
from tests.data.samples import everything, expect_same

pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")

import pyarrow.parquet as pq  # noqa: E402

from ftl_lightning.data.formats.lerobot import read_lerobot, write_lerobot  # noqa: E402

OFFICIAL = Path(__file__).parent / "lerobot_v30"
"""Written by LeRobot 0.4.4, see its README."""


def info(folder: str = "robot") -> dict[str, Any]:
    found: dict[str, Any] = json.loads((Path(folder) / "meta" / "info.json").read_text("utf-8"))
    return found


def change(folder: str, **changes: Any) -> None:
    (Path(folder) / "meta" / "info.json").write_text(json.dumps(info(folder) | changes), "utf-8")


def test_what_is_written_is_read_back() -> None:
    written = everything((1, 5, 3))
    written.save("lerobot:robot")
    expect_same(Demonstrations.load("robot"), written)
    expect_same(Demonstrations.load("lerobot:robot"), written)
    plain = Demonstrations(torch.rand(2, 3, 1), torch.tensor([3, 3]), "", ("x",), ("",), ("", ""))
    plain.save("lerobot:plain")
    found = Demonstrations.load("plain")
    expect_same(found, plain, provenance=False)
    assert found.provenance == {"lerobot": "plain"}
    assert read_own("plain").concepts == ("plain", "plain")


def test_what_is_written_says_all_that_lerobot_needs() -> None:
    written = everything()
    write_lerobot(written, "robot", fps=20)
    found = info()
    expected = {"codebase_version": "v3.0", "total_episodes": 6, "total_frames": 24, "total_tasks": 2, "fps": 20}
    assert {key: found[key] for key in expected} == expected
    assert found["splits"] == {"train": "0:6"}
    assert found["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    assert found["features"]["observation.state"] == {"dtype": "float32", "shape": [2], "names": ["x", "y"]}
    assert found["features"]["timestamp"] == {"dtype": "float32", "shape": [1], "names": None}
    frames = pq.read_table("robot/data/chunk-000/file-000.parquet")
    assert set(frames.column_names) == set(found["features"])
    assert frames.schema.field("observation.state").type == pa.list_(pa.float32(), 2)
    assert frames.schema.field("observation.goal").type == pa.float32()
    assert frames.column("index").to_pylist() == list(range(24))
    assert frames.column("frame_index").to_pylist()[:8] == [0, 1, 2, 3, 4, 0, 1, 2]
    assert frames.column("timestamp").to_pylist()[1] == pytest.approx(0.05)
    states, actions = (np.stack(frames.column(key).to_numpy()) for key in ("observation.state", "action"))
    assert (actions[:4] == states[1:5]).all()
    assert (actions[4] == states[4]).all()
    episodes = pq.read_table("robot/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    one = {key: episodes[1][key] for key in ("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index")}
    assert one == {"episode_index": 1, "tasks": ["go dówn"], "length": 3, "dataset_from_index": 5, "dataset_to_index": 8}
    assert {episodes[1][key] for key in ("data/chunk_index", "data/file_index", "meta/episodes/file_index")} == {0}
    assert episodes[1]["stats/observation.state/max"] == pytest.approx(states[5:8].max(axis=0).tolist())
    statistics = json.loads(Path("robot/meta/stats.json").read_text("utf-8"))["observation.state"]
    assert statistics["count"] == [24]
    assert statistics["mean"] == pytest.approx(states.mean(axis=0, dtype=np.float64).tolist())
    assert {"min", "max", "std", "q01", "q99"} <= statistics.keys()
    import pandas as pd

    assert pd.read_parquet("robot/meta/tasks.parquet").loc["go dówn"].task_index == 1


def test_large_data_are_several_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftl_lightning.data.formats.lerobot._MEGABYTES", 1e-6)
    monkeypatch.setattr("ftl_lightning.data.formats.lerobot._CHUNK", 4)
    written = everything()
    written.save("lerobot:robot")
    files = sorted(str(path.relative_to("robot/data")) for path in Path("robot/data").rglob("*.parquet"))
    assert files == [f"chunk-00{number // 4}/file-00{number % 4}.parquet" for number in range(6)]
    expect_same(Demonstrations.load("robot"), written)


def test_what_lerobot_wrote_is_read() -> None:
    with pytest.warns(Note, match="left out observation.image: images and videos are not read"):
        found = Demonstrations.load(OFFICIAL)
    assert found.concepts == ("push", "pull", "push")
    assert found.lengths.tolist() == [4, 5, 6]
    assert found.state_names == ("x", "y")
    assert found.states[1].tolist() == [[1, 0], [1, 1], [1, 2], [1, 3], [1, 4], [1, 4]]
    assert found.per_step == ("environment_state",)
    assert found.observed["environment_state"][2, 0].tolist() == [20, 1, 2]
    assert found.provenance == {"lerobot": "lerobot_v30"}
    assert read_lerobot(OFFICIAL, observed=()).observed == {}
    actions = read_lerobot(OFFICIAL, "action", ["state"])
    assert actions.states[0].tolist() == [[0, 1], [0, 2], [0, 3], [0, 4], [0, 4], [0, 4]]
    assert torch.equal(actions.observed["state"], found.states)
    everything().save("lerobot:robot")
    winds = read_lerobot("robot", "observation.wind", ["goal", "view"])
    assert (winds.state_names, winds.state_units, winds.per_step) == (("0", "1", "2"), ("", "", ""), ("view",))
    assert torch.equal(winds.states, everything().observed["wind"])


def old(folder: str, version: str = "v2.1") -> None:
    """Two episodes as LeRobot wrote them before v3.0."""
    root = Path(folder)
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    shape: dict[str, Any] = {"dtype": "float32", "shape": [2]}
    features = {
        "observation.state": shape | {"names": {"motors": ["hip", "knee"]}},
        "action": shape | {"names": None},
        "observation.images.top": {"dtype": "video", "shape": [8, 8, 3], "names": ["height", "width", "channels"]},
        "episode_index": {"dtype": "int64", "shape": [1], "names": None},
        "task_index": {"dtype": "int64", "shape": [1], "names": None},
    }
    data = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    told = {"codebase_version": version, "fps": 30.0, "total_episodes": 2, "data_path": data, "features": features}
    (root / "meta" / "info.json").write_text(json.dumps(told))
    (root / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "kick"}\n{"task_index": 1, "task": "wave"}\n')
    (root / "meta" / "episodes.jsonl").write_text(
        "".join(f'{{"episode_index": {one}, "tasks": ["x"], "length": {3 + one}}}\n' for one in (0, 1))
    )
    for one in (0, 1):
        states = [[float(one), float(step)] for step in range(3 + one)]
        columns = {"observation.state": states, "episode_index": [one] * len(states), "task_index": [1 - one] * len(states)}
        pq.write_table(pa.table(columns), root / "data" / "chunk-000" / f"episode_{one:06d}.parquet")


@pytest.mark.parametrize("version", ["v2.0", "v2.1"])
def test_older_versions_are_read(version: str) -> None:
    old("older", version)
    found = Demonstrations.load("older")
    assert found.concepts == ("wave", "kick")
    assert found.lengths.tolist() == [3, 4]
    assert found.state_names == ("hip", "knee")
    assert found.states[0].tolist() == [[0, 0], [0, 1], [0, 2], [0, 2]]


def test_a_data_set_stands_for_a_file_wherever_one_can_be_given(capsys: pytest.CaptureFixture[str]) -> None:
    written = everything()
    written.save("lerobot:robot")
    data = OwnData("robot", encoder="hashing", validation_share=0.4)
    assert data.domain.concepts.training == ("go up", "go dówn")
    assert data.domain.observed.keys() == written.observed.keys()
    succeed("check", "robot")
    assert "go dówn: 3 demonstrations" in capsys.readouterr().out
    scenes = ["generate", "object_rearrangement", "--task=circle right of square", "--count=2", "--out=lerobot:scenes"]
    succeed(*scenes)
    assert capsys.readouterr().out == "lerobot:scenes: 2 demonstrations of circle right of square\n"
    domain = load_domain("object_rearrangement")
    found = read_demonstrations("scenes", domain)
    assert torch.equal(found.states, domain.source(None).draw("circle right of square", 2, 0).states)
    refused(capsys, scenes, "out: scenes: expected an empty folder or nothing there, found one with files")


def test_missing_numbers_are_told_by_check(capsys: pytest.CaptureFixture[str]) -> None:
    old("older")
    path = Path("older/data/chunk-000/episode_000001.parquet")
    table = pq.read_table(path)
    states = table.column("observation.state").to_pylist()
    states[2][0] = None
    pq.write_table(table.set_column(0, "observation.state", pa.array(states)), path)
    with pytest.raises(UserError, match=r"older: key 'states': expected finite numbers, found nan"):
        Demonstrations.load("older")
    succeed("check", "older")
    assert "not finite" in capsys.readouterr().out


def frames(**columns: Callable[[Any], Any]) -> Callable[[], None]:
    """A change of columns of the frames."""

    def mend() -> None:
        path = Path("robot/data/chunk-000/file-000.parquet")
        table = pq.read_table(path)
        for name, made in columns.items():
            key = "observation.state" if name == "state" else name
            table = table.set_column(table.column_names.index(key), key, pa.array(made(table.column(key).to_pylist())))
        pq.write_table(table, path)

    return mend


def cut(name: str, bytes_left: int = 100) -> Callable[[], None]:
    def mend() -> None:
        path = Path("robot") / name
        path.write_bytes(path.read_bytes()[:bytes_left])

    return mend


def beside(text: str) -> Callable[[], object]:
    """What stands beside LeRobot's files, for this program alone."""
    return lambda: Path("robot/meta/ftl_lightning.json").write_text(text)


def feature(**changes: Any) -> Callable[[], None]:
    def mend() -> None:
        features = info()["features"]
        features["observation.state"] |= changes
        change("robot", features=features)

    return mend


DAMAGES: dict[str, tuple[Callable[[], object], str]] = {
    "version": (lambda: change("robot", codebase_version="v1.6"), "key 'codebase_version': expected v2.0 or v2.1 or v3.0"),
    "no version": (lambda: change("robot", codebase_version=None), "key 'codebase_version': expected a text, found None"),
    "way out": (
        lambda: change("robot", data_path="data/../../etc/{episode_index}"),
        "key 'data_path': expected files in the folder",
    ),
    "elsewhere": (lambda: change("robot", data_path="/etc/passwd"), "key 'data_path': expected files in the folder 'data'"),
    "no path": (lambda: change("robot", data_path=7), "key 'data_path': expected a text, found 7"),
    "no features": (lambda: change("robot", features=[]), "key 'features': expected a mapping, found []"),
    "no state": (lambda: change("robot", features={}), "features: expected the feature 'observation.state'"),
    "no type": (feature(dtype=3), "key 'features.observation.state.dtype': expected a text, found 3"),
    "shape": (feature(shape=[-1]), "key 'features.observation.state.shape[0]': expected a whole number from 0"),
    "large shape": (feature(shape=[10**6, 10**6]), "column 'observation.state': expected 5 times 1000000000000 numbers"),
    "other shape": (feature(shape=[3]), "column 'observation.state': expected 5 times 3 numbers, as info.json says, found 10"),
    "count": (lambda: change("robot", total_episodes=10**12), "key 'total_episodes': expected a whole number from 0"),
    "other count": (lambda: change("robot", total_episodes=7), "key 'total_episodes': expected 6, as in meta, found 7"),
    "negative": (lambda: change("robot", total_episodes=-1), "key 'total_episodes': expected a whole number from 0"),
    "no JSON": (cut("meta/info.json"), "info.json: expected a LeRobot info file, found damaged text"),
    "no task": (frames(task_index=lambda old: [9] * len(old)), "key 'task_index': expected one of the tasks in meta, found 9"),
    "task": (frames(task_index=lambda old: [0.5] * len(old)), "column 'task_index': expected whole numbers, found double"),
    "episode": (frames(episode_index=lambda old: [0] * len(old)), "episode 0: expected 5 frames, as in meta, found 24 in data"),
    "no numbers": (frames(state=lambda old: [["a", "b"]] * len(old)), "column 'observation.state': expected numbers of shape (2,)"),
    "uneven": (frames(state=lambda old: [[1.0], [1.0, 2.0, 3.0]] * (len(old) // 2)), "expected 2 numbers in each list"),
    "gaps": (frames(state=lambda old: [None, *old[1:]]), "expected 24 times 2 numbers, as info.json says, found 47"),
    "cut frames": (cut("data/chunk-000/file-000.parquet"), "file-000.parquet: expected a Parquet file, found a damaged one"),
    "cut tasks": (cut("meta/tasks.parquet"), "tasks.parquet: expected a Parquet file, found a damaged one"),
    "no tasks": (lambda: Path("robot/meta/tasks.parquet").unlink(), "tasks.parquet: expected a tasks file, found nothing"),
    "no frames": (lambda: shutil.rmtree("robot/data"), "robot: expected Parquet files data/*/*.parquet, at most 20000, found 0"),
    "beside": (beside('{"domain": 1}'), "key 'domain': expected a text, found 1"),
    "beside names": (beside('{"state_names": ["x"]}'), "robot: key 'state_names': expected 2 entries, found 1"),
}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set that no test changes."""
    folder = tmp_path_factory.mktemp("lerobot") / "robot"
    everything().save(f"lerobot:{folder}")
    return folder


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_data_set_is_one_line(name: str, robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage, expected = DAMAGES[name]
    shutil.copytree(robot, "robot")
    damage()
    with pytest.raises(UserError) as mistake:
        Demonstrations.load("robot")
    assert str(mistake.value).startswith("robot")
    assert expected in str(mistake.value)
    assert "\n" not in str(mistake.value)
    if name in ("version", "cut frames"):
        assert refused(capsys, ["check", "robot"], expected).count("\n") == 1


def test_a_small_file_that_holds_a_billion_numbers_is_refused_before_it_is_read() -> None:
    everything().save("lerobot:robot")
    rows = 40_000_000
    path = Path("robot/data/chunk-000/file-000.parquet")
    zeros = pa.array(np.zeros(100_000, np.int64))
    one = pa.table(dict.fromkeys(("observation.state", "episode_index", "task_index"), zeros))
    with pq.ParquetWriter(path, one.schema, compression="zstd") as writer:
        for _ in range(rows // len(zeros)):
            writer.write_table(one)
    features = {"observation.state": {"dtype": "float32", "shape": [1], "names": None}}
    change("robot", features=features)
    with pytest.raises(UserError, match=r"robot: frames: expected at most \d+ bytes in a file of \d+, found 960000000"):
        Demonstrations.load("robot")


def test_padding_that_would_take_all_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    everything((100, 1, 1, 1, 1, 1)).save("lerobot:robot")
    monkeypatch.setattr("ftl_lightning.data.formats.episodes.most_bytes", lambda: 40000)
    with pytest.raises(UserError, match=r"robot: episodes: expected at most 40000 bytes, found \d+, 6 episodes padded"):
        Demonstrations.load("robot")


def test_nothing_is_left_of_what_cannot_be_written() -> None:
    for name, expected in (("state", "other than 'state'"), ("a/b", "without '/'")):
        unnamed = Demonstrations(torch.rand(1, 2, 1), torch.tensor([2]), "", ("x",), ("",), ("a",), {name: torch.rand(1, 2)}, ())
        with pytest.raises(UserError, match=expected):
            unnamed.save("lerobot:robot")
    Path("taken").write_text("a file")
    with pytest.raises(UserError, match="taken: expected a folder or nothing there, found a file"):
        everything().save("lerobot:taken")
    with pytest.raises(UserError, match="fps: expected a whole number from 1, found 0"):
        write_lerobot(everything(), "robot", fps=0)
    assert [path.name for path in Path().iterdir()] == ["taken"]


def test_parts_that_are_not_there_are_told() -> None:
    with pytest.raises(UserError, match=r"one of observation.state, action, observation.environment_state, found 'speed'"):
        read_lerobot(OFFICIAL, "speed")
    with pytest.raises(UserError, match=r"observed: expected some of state, environment_state, found 'image'"):
        read_lerobot(OFFICIAL, observed=["image"])
