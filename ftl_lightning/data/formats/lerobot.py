"""LeRobot data sets: LeRobotDataset v3.0, v2.1 and v2.0 are read, v3.0 is written. Needs the extra ``lerobot``.

A data set is a folder. ``meta/info.json`` describes the features of a frame, ``data/`` holds the frames of all episodes as Parquet
files, and ``meta`` holds tasks and episodes. An episode is a demonstration. Its states are ``observation.state``, other vectors
named ``observation.NAME`` are observed features that are known at every time, and the text of its task is the concept. Frames are
sorted by ``frame_index``. An episode whose task changes is cut into a demonstration for each part with one task. Faults of
``frame_index`` and ``timestamp`` are noted on standard error. Images and videos are not read.

The file ``meta/ftl_lightning.json``, ignored by other programs, holds what the format cannot: the domain, units of columns, names
of features that are known only at the start, and provenance.
"""

import itertools
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import FORMATS, Contents, Demonstrations, Format
from ftl_lightning.data.formats.episodes import Episode, Metadata, check_names, from_episodes, measured, metadata, to_episodes
from ftl_lightning.data.formats.frames import Frames
from ftl_lightning.services.errors import UserError, about, note, require, short, shown
from ftl_lightning.services.files import INFO, check_new_folder
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.text import line
from ftl_lightning.services.validation import LARGEST, check_type, from_mapping, read_json

VERSIONS = ("v2.0", "v2.1", "v3.0")
"""Versions that are read; the last is written."""
STATE = "observation.state"
"""Feature that holds the states."""
OBSERVED = "observation."
"""Prefix of observed features."""
ACTION, SCENE = "action", "scene"
EPISODE, TASK, LENGTH = "episode_index", "task_index", "length"
FRAME, TIME = "frame_index", "timestamp"
METADATA = Path("meta") / "ftl_lightning.json"
"""File of :class:`~ftl_lightning.data.formats.episodes.Metadata`, if this package has written the data set."""
MOST_FEATURES = 2000
"""Maximum number of features."""
_ADDED = (TIME, FRAME, EPISODE, "index", TASK)
"""Features that LeRobot adds to every frame."""
_DATA = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK, _MEGABYTES = 1000, 100
"""Files in a folder, and megabytes of a file, as in LeRobot."""
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


@dataclass(frozen=True)
class _Feature:
    """Feature in info.json; ``names`` are the columns of a vector, ``None`` if not given."""

    dtype: str
    shape: tuple[int, ...] = (1,)
    names: tuple[str, ...] | None = None

    @property
    def numeric(self) -> bool:
        return self.dtype == "bool" or self.dtype.startswith(("float", "int", "uint"))


def read_lerobot(folder: str | Path, part: str = "", observed: Sequence[str] | None = None) -> Demonstrations:
    """Read demonstrations of a local data set; nothing is downloaded.

    Args:
        folder: folder of the data set, with ``meta`` and ``data``.
        part: feature that holds the states, such as ``'action'``; empty for ``'observation.state'`` or the only observed vector.
        observed: names of observed features, without ``observation.``; ``None`` for all vectors.

    Returns:
        Demonstrations, padded to the longest episode with the last state.

    Raises:
        UserError: naming the file, if it is missing, damaged or of another version; naming the data set, if it lacks the feature or
            is incomplete.
    """
    with about(folder):
        return Demonstrations(**_contents(folder, part, observed))


def _contents(folder: str | Path, part: str = "", observed: Sequence[str] | None = None) -> Contents:
    check_extra("lerobot", f"{folder}: a LeRobot data set")
    from ftl_lightning.data.formats.parquet import read_columns

    root = Path(folder)
    version, episodes, fps, features = _info(root)
    with about(root):
        part = _part(features, part)
        names = _observed(features, part, observed)
    metadata, written = Metadata(), (root / METADATA).is_file()
    if written:
        content = read_json(root / METADATA)
        with about(root / METADATA):
            metadata = from_mapping(Metadata, content, "")
    if part != STATE:  # names and units are those of the states that were written
        metadata = replace(metadata, state_names=None, state_units=None, state_kinds=())
    metadata = replace(metadata, state_names=metadata.state_names or features[part].names)
    if images := short(", ".join(key for key, feature in features.items() if feature.dtype in ("image", "video")), 150):
        note(line(f"{root}: left out {images}: images and videos are not read"))
    lengths, texts = _lengths_and_texts(root, version)
    require(episodes == len(lengths), f"{root / INFO}: key 'total_episodes'", f"{len(lengths)}, as in meta", str(episodes))
    scene = [SCENE] if written and SCENE in features else []
    acts = metadata.acted if written else part != ACTION and ACTION in features and features[ACTION].numeric
    if acts and not written:
        metadata = replace(metadata, action_names=features[ACTION].names or ())
    shapes = {key: features[key].shape for key in (part, *names, *scene, *[ACTION] * acts)}
    numbers = dict.fromkeys((EPISODE, TASK, FRAME, TIME), (1,))
    columns = read_columns(root, "data/*/*.parquet", shapes | numbers, (EPISODE, TASK, FRAME), (FRAME, TIME, ACTION))
    seconds = columns[TIME].reshape(-1).astype(np.float64) if TIME in columns else None
    frames = Frames(columns[EPISODE], columns[TASK], columns.get(FRAME), seconds)
    order = frames.order()
    frames = frames.rows(order)
    columns = {key: values[order] for key, values in columns.items()}
    _check_counts(root, lengths, frames.episode)
    for text in frames.notes(order, fps):
        note(line(f"{root}: {text}"))
    read = []
    for start, stop in frames.segments():
        task = int(frames.task[start])
        require(task in texts, f"{root}: key {TASK!r}", "one of the tasks in meta", str(task))
        whole = not start or frames.episode[start - 1] != frames.episode[start]
        read.append(
            Episode(
                columns[part][start:stop].reshape(stop - start, -1),
                {name.removeprefix(OBSERVED): measured(columns[name][start:stop]) for name in names},
                texts[task],
                measured(columns[SCENE][start]) if scene and whole else None,  # a scene is the episode's initial state
                measured(columns[ACTION][start:stop]).reshape(stop - start, -1) if acts and ACTION in columns else None,
            )
        )
    with about(root):
        contents = from_episodes(read, metadata)
    return {**contents, "provenance": contents["provenance"] or {"lerobot": root.resolve().name}}


def _info(root: Path) -> tuple[str, int, float | None, dict[str, _Feature]]:
    """Version, number of episodes, frames per second if stated, and features by name."""
    content = read_json(root / INFO, "a LeRobot info file")
    with about(root / INFO):
        content = check_type(content, Mapping[str, Any], "")
        version = check_type(content.get("codebase_version"), str, "codebase_version")
        advice = f"{shown(version)}; convert it with LeRobot's own tools"
        require(version in VERSIONS, "key 'codebase_version'", " or ".join(VERSIONS), advice)
        data = check_type(content.get("data_path"), str, "data_path")
        inside = data.startswith("data/") and ".." not in Path(data).parts
        require(inside, "key 'data_path'", "files in the folder 'data'", shown(data))
        features = check_type(content.get("features"), Mapping[str, Mapping[str, Any]], "features")
        require(len(features) <= MOST_FEATURES, "key 'features'", f"at most {MOST_FEATURES}", len(features))
        episodes = check_type(content.get("total_episodes"), int, "total_episodes")
        fps: float | None = check_type(content.get("fps"), float | None, "fps")
        require(fps is None or fps > 0, "key 'fps'", "frames per second, more than 0", fps)
        return version, episodes, fps, {key: _feature(f"features.{short(key)}", fields) for key, fields in features.items()}


def _feature(key: str, fields: Mapping[str, Any]) -> _Feature:
    feature = _Feature(check_type(fields.get("dtype"), str, f"{key}.dtype"))
    if not feature.numeric:  # not read, such as images; any shape is allowed
        return feature
    shape: tuple[int, ...] = check_type(fields.get("shape"), tuple[int, ...], f"{key}.shape")
    names = fields.get("names")
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}, as in older data sets
        (names,) = names.values()
    if not isinstance(names, list) or len(names) != prod(shape) or not all(isinstance(name, str) for name in names):
        return _Feature(feature.dtype, shape)
    return _Feature(feature.dtype, shape, tuple(names))


def _part(features: Mapping[str, _Feature], part: str) -> str:
    """Feature that holds the states."""
    vectors = [key for key, feature in features.items() if feature.numeric and feature.dtype != "uint8" and key not in _ADDED]
    observed = [key for key in vectors if key.startswith(OBSERVED)]
    if not part and (STATE in vectors or len(observed) == 1):
        return STATE if STATE in vectors else observed[0]
    known = short(", ".join(vectors), 120) or "none"
    expected = f"the feature {STATE!r}, a single observed vector, or read_lerobot(folder, part) with one of {known}"
    require(part in vectors, "features", expected, repr(short(part)) if part else "none that is clear")
    return part


def _observed(features: Mapping[str, _Feature], part: str, observed: Sequence[str] | None) -> list[str]:
    """Keys of the observed features."""
    known = [key for key, feature in features.items() if key.startswith(OBSERVED) and feature.numeric]
    if observed is None:
        return [key for key in known if key != part]
    available = short(", ".join(key.removeprefix(OBSERVED) for key in known), 120) or "none"
    for name in observed:
        require(OBSERVED + name in known, "observed", f"some of {available}", f"{short(name)!r}")
    return [OBSERVED + name for name in observed]


def _check_counts(root: Path, lengths: Mapping[int, int], index: NDArray[np.int64]) -> None:
    """Refuse other numbers of frames than those in meta; ``index`` is the episode of each frame."""
    numbers, counts = np.unique(index, return_counts=True)
    actual = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    for number in {**lengths, **actual}:
        expected, count = lengths.get(number, 0), actual.get(number, 0)
        message = f"{count} in data; take another, whole copy"
        require(expected == count, f"{root}: episode {number}", f"{expected} frames, as in meta", message)


def _lengths_and_texts(root: Path, version: str) -> tuple[dict[int, int], dict[int, str]]:
    """Lengths of episodes and texts of tasks, by number."""
    from ftl_lightning.data.formats.parquet import read_columns, read_lines, read_texts

    meta = root / "meta"
    if not version.startswith("v3"):
        episodes = read_lines(meta / "episodes.jsonl", {EPISODE: "int64", LENGTH: "int64"})
        tasks = read_lines(meta / "tasks.jsonl", {TASK: "int64", "task": "string"})
        lengths, texts = (dict(zip(*rows.values(), strict=True)) for rows in (episodes, tasks))
        return lengths, {number: text for number, text in texts.items() if text is not None}
    columns = read_columns(root, "meta/episodes/*/*.parquet", {EPISODE: (1,), LENGTH: (1,)}, (EPISODE, LENGTH), rows=LARGEST)
    lengths = dict(zip(columns[EPISODE].tolist(), columns[LENGTH].tolist(), strict=True))
    return lengths, read_texts(meta / "tasks.parquet", TASK, "task")


def write_lerobot(demonstrations: Demonstrations, folder: str | Path, fps: int = 10) -> None:
    """Write a data set for LeRobot and :func:`read_lerobot`, atomically.

    Where actions are unknown, that of a frame is the next state, of the last frame its state, as for a robot controlled
    by positions. Scenes and features known only at the start are repeated in each frame.

    Args:
        demonstrations: written without padding.
        folder: a new or empty folder.
        fps: frames per second, which demonstrations do not record.

    Raises:
        UserError: if the folder cannot be written or is not empty, or the name of an observed feature is not allowed.
    """
    require(isinstance(fps, int) and fps >= 1, "fps", "a whole number from 1", fps)
    check_extra("lerobot", f"{folder}: this data set")
    check_names(demonstrations, STATE.removeprefix(OBSERVED), str(folder))
    from ftl_lightning.data.formats.parquet import write_rows, write_texts

    texts = {text: number for number, text in enumerate(dict.fromkeys(demonstrations.concepts))}
    frames: list[dict[str, NDArray[Any]]] = []
    total = 0
    for number, episode in enumerate(to_episodes(demonstrations)):
        frames.append(_columns(episode, number, texts[episode.concept], total, fps))
        total += len(episode.states)
    acts = demonstrations.state_names if demonstrations.actions is None else demonstrations.action_names or None
    names = {STATE: demonstrations.state_names, ACTION: acts}
    info = {
        "codebase_version": VERSIONS[-1],
        "robot_type": None,
        "total_episodes": len(frames),
        "total_frames": total,
        "total_tasks": len(texts),
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": _MEGABYTES,
        "video_files_size_in_mb": 5 * _MEGABYTES,
        "fps": fps,
        "splits": {"train": f"0:{len(frames)}"},
        "data_path": f"data/{_DATA}",
        "video_path": None,
        "features": {
            key: {"dtype": str(values.dtype), "shape": list(values.shape[1:]), "names": names.get(key)}
            for key, values in frames[0].items()
        },
    }
    statistics = _statistics({key: np.concatenate([columns[key] for columns in frames]) for key in frames[0]})
    with _new_folder(Path(folder)) as root:
        places = _write_data(root, frames)
        rows = [_row(*values) for values in zip(frames, places, demonstrations.concepts, strict=True)]
        write_rows(root / "meta" / "episodes" / _DATA.format(chunk_index=0, file_index=0), rows)
        write_texts(root / "meta" / "tasks.parquet", TASK, "task", texts)
        for name, content in ((INFO, info), (Path("meta") / "stats.json", statistics), (METADATA, metadata(demonstrations))):
            (root / name).write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")


def _columns(episode: Episode, number: int, task: int, first: int, fps: int) -> dict[str, NDArray[Any]]:
    """Columns of an episode by feature, ``(frame, *shape)``; ``first`` is the index of its first frame in the data set."""
    time = len(episode.states)
    steps = np.arange(time)[:, None]
    return {
        STATE: episode.states,
        ACTION: np.concatenate((episode.states[1:], episode.states[-1:])) if episode.actions is None else episode.actions,
        **{OBSERVED + name: values for name, values in episode.observed.items()},
        **({} if episode.scene is None else {SCENE: np.repeat(episode.scene[None], time, axis=0)}),
        TIME: (steps / fps).astype(np.float32),
        FRAME: steps,
        EPISODE: np.full((time, 1), number),
        "index": first + steps,
        TASK: np.full((time, 1), task),
    }


def _write_data(root: Path, frames: Sequence[Mapping[str, NDArray[Any]]]) -> list[tuple[int, int]]:
    """Write frames, a row group for each episode; return the chunk and file of each episode."""
    from ftl_lightning.data.formats.parquet import to_table, write_columns

    tables, places = [to_table(columns) for columns in frames], []
    size, file = 0, 0
    for table in tables:
        if size and size + table.nbytes > _MEGABYTES * 2**20:
            size, file = 0, file + 1
        size += table.nbytes
        places.append(divmod(file, _CHUNK))
    for (chunk, index), group in itertools.groupby(zip(places, tables, strict=True), key=lambda pair: pair[0]):
        write_columns(root / "data" / _DATA.format(chunk_index=chunk, file_index=index), [table for _, table in group])
    return places


def _row(columns: Mapping[str, NDArray[Any]], place: tuple[int, int], text: str) -> dict[str, Any]:
    """Description of an episode in ``meta/episodes``."""
    return {
        EPISODE: int(columns[EPISODE][0, 0]),
        "tasks": [text],
        LENGTH: len(columns["index"]),
        "data/chunk_index": place[0],
        "data/file_index": place[1],
        "dataset_from_index": int(columns["index"][0, 0]),
        "dataset_to_index": int(columns["index"][-1, 0]) + 1,
        **{f"stats/{key}/{name}": value for key, values in _statistics(columns).items() for name, value in values.items()},
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


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
    """Yield a temporary folder with a folder ``meta``; it is renamed to ``folder`` on success and removed on failure."""
    check_new_folder(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name[:50]}.", dir=folder.parent) as temporary:
            root = Path(temporary) / "new"
            (root / "meta").mkdir(parents=True)
            yield root
            root.replace(folder)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror or error}); choose a writable place with room") from error


FORMATS["lerobot"] = Format(_contents, write_lerobot)
