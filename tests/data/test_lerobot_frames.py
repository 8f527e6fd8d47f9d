"""Frames of LeRobot data sets: their order, their times and their tasks, and tables that are larger than their bytes."""

import json
import resource
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import Note, UserError
from tests.conftest import refused, succeed
from tests.data.test_lerobot import old

pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")

import pyarrow.parquet as pq  # noqa: E402

STEPS = 12
ADDED = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def table(episodes: int = 4, fps: float = 10) -> pd.DataFrame:
    """Frames of episodes whose state is ``(episode, step)``."""
    parts = []
    for number in range(episodes):
        steps = np.arange(STEPS)
        states = np.stack((np.full(STEPS, number), steps), axis=1).astype("f4")
        parts.append(
            pd.DataFrame(
                {
                    "observation.state": list(states),
                    "timestamp": (steps / fps).astype("f4"),
                    "frame_index": steps,
                    "episode_index": number,
                    "index": steps + number * STEPS,
                    "task_index": number % 2,
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def write(frames: pd.DataFrame, folder: str = "robot", tasks: tuple[str, ...] = ("reach", "push"), **changes: Any) -> None:
    """Write a data set of version 3, whose meta fits the frames."""
    root = Path(folder)
    for part in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / part).mkdir(parents=True, exist_ok=True)
    frames.to_parquet(root / "data/chunk-000/file-000.parquet", index=False)
    counts = frames.groupby("episode_index").size()
    rows = pd.DataFrame({"episode_index": counts.index, "length": counts.to_numpy()})
    rows.to_parquet(root / "meta/episodes/chunk-000/file-000.parquet", index=False)
    texts = pd.DataFrame({"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task", dtype=object))
    texts.to_parquet(root / "meta/tasks.parquet")
    features = {key: {"dtype": "int64", "shape": [1], "names": None} for key in ADDED if key in frames}
    features["observation.state"] = {"dtype": "float32", "shape": [2], "names": None}
    info = {"codebase_version": "v3.0", "fps": 10, "total_episodes": len(counts), "data_path": "data/x", "features": features}
    (root / "meta/info.json").write_text(json.dumps(info | changes))


def read(folder: str = "robot") -> tuple[Demonstrations, list[str]]:
    """Demonstrations and the notes on them, without their beginning."""
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", Note)
        found = Demonstrations.load(folder)
    lines = [str(note.message) for note in notes]
    assert all(line.startswith(f"{folder}: ") for line in lines)
    return found, [line.removeprefix(f"{folder}: ") for line in lines]


def changed(column: str, rows: slice | list[int], values: Any) -> pd.DataFrame:
    frames = table()
    frames.loc[frames.index[rows], column] = values
    return frames


SECOND = slice(STEPS, 2 * STEPS)  # rows of episode 1


def test_frames_are_in_the_order_of_their_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    write(table())
    whole, notes = read()
    assert notes == []
    assert whole.states[:, :, 1].tolist() == [list(range(STEPS))] * 4
    write(table().sample(frac=1, random_state=0))
    found, notes = read()
    assert found.hash == whole.hash
    assert notes == ["episodes 0, 1, 2, 3: frames in another order than 'frame_index'; sorted"]
    write(table().iloc[[*range(2 * STEPS, 4 * STEPS), *range(2 * STEPS)]])  # files in another order are none of frames
    found, notes = read()
    assert (found.hash, notes) == (whole.hash, [])
    backwards = changed("frame_index", SECOND, np.arange(STEPS)[::-1])
    backwards.loc[backwards.index[SECOND], "timestamp"] = (np.arange(STEPS)[::-1] / 10).astype("f4")
    write(backwards)
    found, notes = read()
    assert found.states[1, :, 1].tolist() == list(range(STEPS))[::-1]
    assert notes == ["episode 1: frames in another order than 'frame_index'; sorted"]
    write(backwards.drop(columns="frame_index"))
    found, notes = read()
    assert found.states[1, :, 1].tolist() == list(range(STEPS))[::-1]
    assert notes == ["episode 1: frames in another order than 'timestamp'; sorted"]
    succeed("check", "robot")
    assert "note: robot: episode 1: frames in another order" in capsys.readouterr().err


TIMES: dict[str, tuple[Callable[[], pd.DataFrame], list[str]]] = {
    "gap": (lambda: table().drop(index=[STEPS + 5, STEPS + 6]), ["episode 1: gaps in 'frame_index'; frames are missing"]),
    "no start": (lambda: table().drop(index=[0, 1]), ["episode 0: gaps in 'frame_index'; frames are missing"]),
    "twice": (
        lambda: table().iloc[[0, 1, 2, 3, 3, *range(4, 4 * STEPS)]],
        ["episode 0: several frames of the same 'frame_index'"],
    ),
    "rate": (
        lambda: changed("timestamp", SECOND, (np.arange(STEPS) / 20).astype("f4")),
        ["episode 1: 20 frames a second by 'timestamp', not 10 as in info.json"],
    ),
    "slower": (lambda: table(fps=9.5), ["episodes 0, 1, 2, 3: 9.5 frames a second by 'timestamp', not 10 as in info.json"]),
    "back": (lambda: changed("timestamp", [STEPS + 4], 0.05), ["episode 1: 'timestamp' that does not increase"]),
    "stands": (lambda: changed("timestamp", SECOND, 0.0), ["episode 1: 'timestamp' that does not increase"]),
    "late": (
        lambda: changed("timestamp", slice(STEPS + 6, 2 * STEPS), (np.arange(6, 12) / 10 + 1).astype("f4")),
        ["episode 1: 'timestamp' with uneven steps"],
    ),
    "not finite": (lambda: changed("timestamp", [STEPS + 4], np.inf), ["episode 1: 'timestamp' that is not finite"]),
    "missing": (lambda: changed("timestamp", [STEPS + 4], np.nan), ["episode 1: 'timestamp' that is not finite"]),
    "later start": (lambda: table().assign(timestamp=lambda frames: frames.timestamp + np.float32(7)), []),
    "NTSC": (lambda: table(fps=9.99), []),
    "no columns": (lambda: table().drop(columns=["timestamp", "frame_index", "index"]), []),
}


@pytest.mark.parametrize("name", TIMES)
def test_faults_of_times_are_told_by_episode(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    frames, expected = TIMES[name]
    write(frames())
    found, notes = read()
    notes = [note for note in notes if "uneven" not in note] if name in ("back", "twice") else notes
    assert notes == expected
    assert len(found) == 4


def test_many_episodes_are_counted_and_an_unknown_rate_is_no_fault(capsys: pytest.CaptureFixture[str]) -> None:
    write(table(12, fps=5))
    expected = "episodes 0, 1, 2, 3, 4, 5, 6, 7 and 4 others: 5 frames a second by 'timestamp', not 10 as in info.json"
    assert read()[1] == [expected]
    write(table(12, fps=5), fps=None)
    assert read()[1] == []
    for fps in (0, -1, "ten", True):
        write(table(), fps=fps)
        refused(capsys, ["check", "robot"], "robot/meta/info.json: key 'fps': expected")


def test_an_episode_of_several_tasks_is_a_demonstration_for_each(capsys: pytest.CaptureFixture[str]) -> None:
    frames = table()
    frames.loc[frames.index[SECOND], "task_index"] = [0] * 3 + [1] * 4 + [0] * 5
    write(frames.sample(frac=1, random_state=1))
    found, notes = read()
    assert notes[1:] == ["episode 1: several tasks; each is a demonstration"]
    assert found.concepts == ("reach", "reach", "push", "reach", "reach", "push")
    assert found.lengths.tolist() == [12, 3, 4, 5, 12, 12]
    cut = [found.states[row, : found.lengths[row], 1].tolist() for row in (1, 2, 3)]
    assert cut == [[0, 1, 2], [3, 4, 5, 6], [7, 8, 9, 10, 11]]


def test_older_versions_are_sorted_too(capsys: pytest.CaptureFixture[str]) -> None:
    old("robot")
    path = Path("robot/data/chunk-000/episode_000001.parquet")
    frames = pq.read_table(path).append_column("frame_index", pa.array([2, 0, 1, 3]))
    pq.write_table(frames, path)
    pq.write_table(
        pq.read_table(first := path.with_name("episode_000000.parquet")).append_column("frame_index", pa.array([0, 1, 2])), first
    )
    found, notes = read()
    assert found.states[1, :, 1].tolist() == [1, 2, 0, 3]
    assert "episode 1: frames in another order than 'frame_index'; sorted" in notes


def peak() -> int:
    """Memory in kilobytes that the process has taken at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.parametrize("encoding", ["dictionary", "DELTA_BYTE_ARRAY"])
def test_texts_that_are_stored_once_and_decoded_often_are_refused(encoding: str, capsys: pytest.CaptureFixture[str]) -> None:
    write(table())
    texts = ["x" * 900_000 + str(number if encoding != "dictionary" else 0) for number in range(100)]
    rows = pa.table({"task_index": range(100), "task": pa.array(texts, pa.large_string()).dictionary_encode().dictionary_decode()})
    how: dict[str, Any] = {"use_dictionary": ["task"]}
    if encoding != "dictionary":
        how = {"use_dictionary": False, "column_encoding": {"task_index": "PLAIN", "task": encoding}}
    pq.write_table(rows, "robot/meta/tasks.parquet", compression="zstd", write_statistics=False, **how)
    assert Path("robot/meta/tasks.parquet").stat().st_size < 100_000
    del texts, rows
    before = peak()
    refused(capsys, ["check", "robot"], "tasks.parquet: expected texts of at most 8388608 bytes, found more when they are decoded")
    assert peak() - before < 300_000


def test_a_column_of_texts_in_place_of_numbers_is_refused_before_it_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    frames = table()
    write(frames)
    for column in ("observation.state", "frame_index", "timestamp"):
        texts = pa.array(["x" * 2_000_000] * len(frames)).dictionary_encode().dictionary_decode()
        rows = pa.table({name: texts if name == column else frames[name].tolist() for name in frames})
        pq.write_table(rows, "robot/data/chunk-000/file-000.parquet", write_statistics=False)
        refused(capsys, ["check", "robot"], f"column '{column}'")


def test_lines_of_episodes_are_read_at_once_and_others_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    old("robot")
    path = Path("robot/meta/episodes.jsonl")
    good = path.read_bytes()
    path.write_bytes(b"\xef\xbb\xbf" + good.replace(b"\n", b"\r\n\n"))
    assert Demonstrations.load("robot").lengths.tolist() == [3, 4]
    path.write_text("".join(f'{{"length":3,"episode_index":{number}}}\n' for number in range(900_000)))
    assert path.stat().st_size > 25_000_000
    refused(capsys, ["check", "robot"], "key 'total_episodes': expected 900000, as in meta, found 2")
    for damage in (
        b"{",
        b'["x"]',
        b'{"episode_index": "0", "length": 3}',
        b'{"episode_index": 0.5, "length": 3}',
        b"\xff",
        b"x" * 99999,
    ):
        path.write_bytes(good + damage + b"\n")
        refused(
            capsys, ["check", "robot"], "episodes.jsonl: expected a JSON object with 'episode_index' (int64) and 'length' (int64)"
        )
    path.write_bytes(good.replace(b"length", b"size"))
    refused(capsys, ["check", "robot"], "episode 0: expected")
    path.write_text("")
    refused(capsys, ["check", "robot"], "key 'total_episodes': expected 0, as in meta, found 2")
    path.write_bytes(b"\n" * (33 * 2**20))
    refused(capsys, ["check", "robot"], "episodes.jsonl: expected a LeRobot file of at most 33554432 bytes")


def test_numbers_that_overflow_are_refused_without_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    frames = table()
    frames["observation.state"] = [np.array([1e300, -1e300])] * len(frames)
    write(frames)
    with pytest.raises(UserError, match="robot: key 'states': expected finite numbers"):
        Demonstrations.load("robot")
    assert capsys.readouterr().err == ""
