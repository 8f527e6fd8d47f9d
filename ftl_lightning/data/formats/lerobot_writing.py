"""Write demonstrations as LeRobot data sets, see :mod:`ftl_lightning.data.formats.lerobot`."""

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.formats.episodes import Episode, beside, check_names, episodes
from ftl_lightning.data.formats.lerobot import ACTION, BESIDE, EPISODE, LENGTH, OBSERVED, SCENE, STATE, TASK, VERSIONS
from ftl_lightning.services.errors import UserError, shown
from ftl_lightning.services.files import INFO, check_new_folder

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_DATA = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK, _MEGABYTES = 1000, 100
"""Files in a folder, and megabytes of a file, as in LeRobot."""


def write_lerobot(demonstrations: Demonstrations, folder: str | Path, fps: int = 10) -> None:
    """Write a data set for LeRobot and :func:`read_lerobot`, whole or not at all.

    Demonstrations have no actions. The action of a frame is the next state, of the last frame its state, as for a robot controlled
    by positions. Scenes and features known only at the start are repeated in each frame.

    Args:
        demonstrations: written without padding.
        folder: a new or empty folder.
        fps: frames per second, which demonstrations do not record.

    Raises:
        UserError: if the folder cannot be written or is not empty, or the name of an observed feature is not allowed.
    """
    if not isinstance(fps, int) or fps < 1:
        raise UserError(f"fps: expected a whole number from 1, found {shown(fps)}")
    check_names(demonstrations, STATE.removeprefix(OBSERVED), str(folder))
    texts = {text: number for number, text in enumerate(dict.fromkeys(demonstrations.concepts))}
    frames = [_frame_columns(episode, index, texts[episode.concept], fps) for index, episode in enumerate(episodes(demonstrations))]
    first = 0
    for columns in frames:
        columns["index"] = first + columns["frame_index"]
        first += len(columns["index"])
    with _new_folder(Path(folder)) as root:
        places = _write_data(root, frames)
        _write_episodes(root, frames, places, demonstrations.concepts)
        _write_parquet(root / "meta" / "tasks.parquet", _task_table(texts))
        info = {
            "codebase_version": VERSIONS[-1],
            "robot_type": None,
            "total_episodes": len(frames),
            "total_frames": first,
            "total_tasks": len(texts),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": _MEGABYTES,
            "video_files_size_in_mb": 5 * _MEGABYTES,
            "fps": fps,
            "splits": {"train": f"0:{len(frames)}"},
            "data_path": f"data/{_DATA}",
            "video_path": None,
            "features": {key: _described(demonstrations, key, values) for key, values in frames[0].items()},
        }
        every = {key: np.concatenate([columns[key] for columns in frames]) for key in frames[0]}
        for name, content in ((INFO, info), (Path("meta") / "stats.json", _statistics(every)), (BESIDE, beside(demonstrations))):
            (root / name).write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")


def _frame_columns(episode: Episode, number: int, task: int, fps: int) -> dict[str, NDArray[Any]]:
    """Columns of an episode by feature, ``(frame, *shape)``."""
    time = len(episode.states)
    scene = {} if episode.scene is None else {SCENE: np.repeat(episode.scene[None], time, axis=0)}
    steps = np.arange(time)
    return {
        STATE: episode.states,
        ACTION: np.concatenate((episode.states[1:], episode.states[-1:])),
        **{OBSERVED + name: values for name, values in episode.observed.items()},
        **scene,
        "timestamp": (steps / fps).astype(np.float32)[:, None],
        "frame_index": steps[:, None],
        EPISODE: np.full((time, 1), number),
        "index": steps[:, None],
        TASK: np.full((time, 1), task),
    }


def _described(demonstrations: Demonstrations, key: str, values: NDArray[Any]) -> dict[str, Any]:
    names = list(demonstrations.state_names) if key in (STATE, ACTION) else None
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]), "names": names}


def _write_data(root: Path, frames: Sequence[Mapping[str, NDArray[Any]]]) -> list[tuple[int, int]]:
    """Write frames, a row group for each episode; return the chunk and file of each episode."""
    places: list[tuple[int, int]] = []
    writer: pq.ParquetWriter | None = None
    size, file = 0, 0
    try:
        for columns in frames:
            table = pa.table({key: _arrow(values) for key, values in columns.items()})
            if writer is not None and size + table.nbytes > _MEGABYTES * 2**20:
                writer.close()
                writer, size, file = None, 0, file + 1
            place = divmod(file, _CHUNK)
            if writer is None:
                path = root / "data" / _DATA.format(chunk_index=place[0], file_index=place[1])
                path.parent.mkdir(parents=True, exist_ok=True)
                writer = pq.ParquetWriter(path, table.schema)
            writer.write_table(table)
            size += table.nbytes
            places.append(place)
    finally:
        if writer is not None:
            writer.close()
    return places


def _write_episodes(
    root: Path, frames: Sequence[Mapping[str, NDArray[Any]]], places: Sequence[tuple[int, int]], texts: Sequence[str]
) -> None:
    columns: dict[str, list[Any]] = {}
    for number, (episode, (chunk, file), text) in enumerate(zip(frames, places, texts, strict=True)):
        row = {
            EPISODE: number,
            "tasks": [text],
            LENGTH: len(episode["index"]),
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": int(episode["index"][0, 0]),
            "dataset_to_index": int(episode["index"][-1, 0]) + 1,
            **{f"stats/{key}/{name}": value for key, values in _statistics(episode).items() for name, value in values.items()},
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for key, value in row.items():
            columns.setdefault(key, []).append(value)
    _write_parquet(root / "meta" / "episodes" / _DATA.format(chunk_index=0, file_index=0), pa.table(columns))


def _task_table(texts: Mapping[str, int]) -> pa.Table:
    """Table with the texts as pandas' index, which LeRobot expects."""
    import pandas as pd

    frame = pd.DataFrame({TASK: list(texts.values())}, index=pd.Index(list(texts), name="task", dtype=object))
    return pa.Table.from_pandas(frame)


def _write_parquet(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _arrow(values: NDArray[Any]) -> pa.Array:
    """Convert ``(frame, *shape)``: shape (1,) to numbers, vectors to lists of fixed size, others to nested lists."""
    shape = values.shape[1:]
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    if shape == (1,):
        return flat
    if len(shape) == 1 and shape[0]:
        return pa.FixedSizeListArray.from_arrays(flat, shape[0])
    for axis in reversed(range(1, values.ndim)):
        count = prod(values.shape[:axis])
        flat = pa.ListArray.from_arrays(pa.array(np.arange(count + 1, dtype=np.int32) * values.shape[axis]), flat)
    return flat


def _statistics(columns: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, list[Any]]]:
    """Statistics of each feature but images, by which LeRobot normalises, as lists of its shape."""
    statistics: dict[str, dict[str, list[Any]]] = {}
    for key, values in columns.items():
        if values.dtype == np.uint8 or not values.size:
            continue
        exact = values.astype(np.float64)
        quantiles = np.quantile(exact, list(_QUANTILES.values()), axis=0)
        statistics[key] = {
            "min": values.min(axis=0).tolist(),
            "max": values.max(axis=0).tolist(),
            "mean": exact.mean(axis=0).tolist(),
            "std": exact.std(axis=0).tolist(),
            "count": [len(values)],
            **{name: quantile.tolist() for name, quantile in zip(_QUANTILES, quantiles, strict=True)},
        }
    return statistics


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to ``folder`` on success and removed on failure."""
    check_new_folder(folder)
    temporary: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name[:50]}.", dir=folder.parent))
        (temporary / "meta").mkdir()
        yield temporary
        temporary.chmod(0o755)
        temporary.replace(folder)
        temporary = None
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror or error}); choose a writable place with room") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
