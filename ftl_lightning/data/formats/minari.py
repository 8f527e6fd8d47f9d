"""Minari data sets. Needs the extra ``minari``.

An episode is a demonstration. Its states are the flattened observations. If an observation is a dictionary, one part holds the
states, and its other vectors are observed features that are known at every time; keys of nested parts are joined by ``/``. Parts
that are not read are noted on standard error. A demonstration's text is the first ``concept`` in
the episode's ``infos`` (of its first step, if there is one for each step), the episode's metadata, or the data set's metadata; by
default, the data set's name.

Metadata of the data set hold what Minari cannot: the domain, names and units of columns, names of features that are known only at
the start, and provenance. Scenes are ``scene`` in an episode's ``infos``.
"""

import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import FORMATS, Contents, Demonstrations, Format
from ftl_lightning.data.formats.episodes import PART, Episode, Metadata, check_names, from_episodes, measured, metadata, to_episodes
from ftl_lightning.services.errors import UserError, about, note, require, short, shown
from ftl_lightning.services.files import check_readable, check_unpacked, read_text
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.text import line
from ftl_lightning.services.validation import LARGEST, check_json_size, check_type, from_mapping

CONCEPT, SCENE = "concept", "scene"
"""Keys of an episode's text and scene, see this module."""
MOST_PARTS = 2000
"""Maximum number of parts of an observation or an action."""
_HEADER = "ftl_lightning"  # metadata key of attributes that only write_minari knows
_DAMAGED = (
    *(ImportError, OSError, ValueError, KeyError, TypeError, AttributeError, AssertionError, NotImplementedError),
    *(IndexError, RuntimeError, OverflowError),
)
"""Exceptions of Minari, Gymnasium and h5py for damaged or foreign data sets."""


def read_minari(name: str, part: str = "", observed: Sequence[str] | None = None) -> Demonstrations:
    """Read demonstrations of an installed data set; nothing is downloaded.

    Args:
        name: name such as ``strokes/test-v0``. Minari looks in ``MINARI_DATASETS_PATH``, by default ``~/.minari/datasets``.
        part: key of the states in dictionaries, such as ``'goal/achieved'`` of a nested part; empty for ``'observation'`` or the
            only vector.
        observed: keys of observed features; ``None`` for all other vectors. Images are read only from data sets of
            :func:`write_minari`.

    Returns:
        Demonstrations, padded to the longest episode with the last state. An episode of n steps has n + 1 states.

    Raises:
        UserError: naming the data set, if it is not installed, damaged or empty, or its observations are no vectors.
    """
    with about(name):
        return Demonstrations(**_contents(name, part, observed))


def _contents(name: str, part: str = "", observed: Sequence[str] | None = None) -> Contents:
    check_extra("minari", f"{name}: expected a file, found none; a Minari data set of this name")
    import minari
    from minari.storage.datasets_root_dir import get_dataset_path

    from ftl_lightning.data.recording import feature_parts, parts_of, states_part

    try:
        folder = Path(get_dataset_path(name)) / "data"
        if not folder.exists():
            message = "expected a file or an installed Minari data set, found neither; see: minari list local"
            raise UserError(f"{name}: {message}")
        with about(name):
            _check_metadata(folder)
        with warnings.catch_warnings(action="ignore"):  # advice of Gymnasium about limits and precision
            dataset = minari.load_dataset(name)
        attributes = dataset.storage.metadata
        written = _HEADER in attributes
        with about(name):
            metadata = from_mapping(Metadata, attributes.get(_HEADER, {}), _HEADER)
            part = states_part(dataset.observation_space, part)
            features = feature_parts(dataset.observation_space, part, observed, images=written)
        if part not in ("", PART):  # names and units are those of the states that were written
            metadata = replace(metadata, state_names=None, state_units=None, state_kinds=())
        parts = {"": dataset.observation_space} | parts_of(dataset.observation_space)
        left = [key for key in parts if key not in ("", part, *features)]
        if observed is None and left:
            note(line(f"{name}: left out {short(', '.join(left), 150)}: only vectors are read"))
        text = _text(attributes) or name
        spaces = {key: parts[key] for key in (part, *features)}
        acts = dataset.action_space if hasattr(dataset.action_space, "low") and len(dataset.action_space.shape) == 1 else None
        acts = None if written and not metadata.acted else acts
        with about(name), _raw(dataset, folder) as raw:
            episodes = [_episode(number, episode, spaces, acts, text, written) for number, episode in enumerate(raw)]
    except _DAMAGED as error:
        message = short(str(error), 100)
        raise UserError(f"{name}: expected a Minari data set, found a damaged or foreign one ({message})") from error
    with about(name):
        contents = from_episodes(episodes, metadata)
    return {**contents, "provenance": contents["provenance"] or {"minari": name}}


def _check_metadata(folder: Path) -> None:
    """Refuse metadata that let Minari run code, or that ask for more memory than the data can fill."""
    path = folder / "metadata.json"
    text = read_text(path, "Minari")
    check_json_size(text, "metadata")
    content = check_type(json.loads(text), Mapping[str, Any], "")
    episodes = check_type(content.get("total_episodes"), int, "total_episodes")
    for key in ("observation_space", "action_space"):  # without them, Minari makes the environment that the file names
        _check_space(json.loads(check_type(content.get(key), str, key)), key)
    if check_type(content.get("data_format"), Literal["hdf5", "arrow", "parquet"], "data_format") == "hdf5":
        return
    numbers = {path.name for path in folder.iterdir()}
    require(all(str(number) in numbers for number in range(episodes)), "total_episodes", "a folder for each", str(episodes))


def _check_space(space: Any, key: str) -> int:
    """Number of parts of a space; refuse one of many parts or numbers, whose limits Minari makes."""
    space = check_type(space, Mapping[str, Any], key)
    shape: tuple[int, ...] = check_type(space.get("shape", []), tuple[int, ...], f"{key}.shape")
    require(prod(shape) <= LARGEST, f"key '{key}.shape'", f"at most {LARGEST} numbers", shown(shape))
    inner = space.get("subspaces", [])
    count = len(inner) if isinstance(inner, Mapping | list) else 0
    require(count <= MOST_PARTS, f"key '{key}.subspaces'", f"at most {MOST_PARTS}", str(count))
    for part in (inner.values() if isinstance(inner, Mapping) else inner) if count else ():
        count += _check_space(part, key)
        require(count <= MOST_PARTS, f"key '{key}.subspaces'", f"at most {MOST_PARTS}", "more")
    return count


@dataclass(frozen=True)
class _Raw:
    """Stored episode: a reader of a part of its observations by key, its actions, its infos and its metadata."""

    part: Callable[[str], Any]
    actions: Any
    infos: Mapping[str, Any]
    metadata: Mapping[str, Any]


@contextmanager
def _raw(dataset: Any, folder: Path) -> Iterator[Iterator[_Raw]]:
    """Episodes of a data set; of HDF5 files only what is needed is read, and no code of Minari reads them."""
    from ftl_lightning.data.recording import part_of

    if dataset.storage.FORMAT != "hdf5":
        _check_tables(dataset, folder)
        rows = zip(dataset, dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True)
        yield (
            _Raw(partial(part_of, episode.observations), episode.actions, episode.infos or {}, metadata)
            for episode, metadata in rows
        )
        return
    from ftl_lightning.data.formats.hdf5_file import opened

    with opened(folder / "main_data.hdf5") as file:
        count = sum(key.startswith("episode_") for key in file)
        require(dataset.total_episodes == count, "key 'total_episodes'", f"{count}, as in the file", dataset.total_episodes)

        def read(number: int) -> _Raw:
            group = file[f"episode_{number}"]
            infos = {key: _array(group, f"infos/{key}") for key in (CONCEPT, SCENE)}
            first = {key: found[:1] if found.shape else found[()] for key, found in infos.items() if found is not None}
            texts, actions = {CONCEPT: group.attrs.get(CONCEPT, "")}, _array(group, "actions")
            return _Raw(lambda key: _array(group["observations"], key), actions, first, texts)

        yield map(read, range(count))


def _array(node: Any, key: str) -> Any:
    """Array of an HDF5 file by its key below a group; ``None`` if it is missing, a group or empty."""
    for name in key.split("/") if key else ():
        node = None if not hasattr(node, "keys") else node.get(name, node.get(f"_index_{name}"))  # the latter is a Tuple's
    return None if node is None or getattr(node, "shape", None) is None else node


def _check_tables(dataset: Any, folder: Path) -> None:
    """Refuse Arrow and Parquet files that are much larger when unpacked, by the rows and the spaces."""
    import pyarrow.dataset

    from ftl_lightning.data.recording import parts_of

    kind, skipped = dataset.storage.FORMAT, ["_", ".", "metadata.json"]
    folders = [folder / str(number) for number in dataset.episode_indices]
    tables = (pyarrow.dataset.dataset(str(path), format=kind, ignore_prefixes=skipped) for path in folders)
    spaces = (parts_of(space) or {"": space} for space in (dataset.observation_space, dataset.action_space))
    width = sum(8 * prod(part.shape or ()) for parts in spaces for part in parts.values())
    packed = sum(check_readable(path, "Minari") for part in folders for path in part.iterdir())
    check_unpacked(sum(table.count_rows() for table in tables) * width, packed, "episodes")


def _episode(number: int, episode: _Raw, spaces: Mapping[str, Any], acts: Any, text: str, written: bool) -> Episode:
    """Convert an episode; ``spaces`` are those of the states, which are the first, and of the features, ``acts`` of actions."""
    parts = {key: _numbers(f"episode {number}: {key or 'observations'}", episode.part(key), space) for key, space in spaces.items()}
    (part, states), *features = parts.items()
    for key, values in features:
        expected = f"{len(states)} steps, as of {part!r}"
        require(len(values) == len(states), f"episode {number}: {key}", expected, str(len(values)))
    return Episode(
        states.reshape(len(states), -1),
        {key: measured(values) for key, values in features},
        _text(episode.infos) or _text(episode.metadata) or text,
        measured(episode.infos[SCENE])[0] if written and SCENE in episode.infos else None,
        None if acts is None else measured(_numbers(f"episode {number}: actions", episode.actions, acts)),
    )


def _numbers(place: str, values: Any, space: Any) -> NDArray[Any]:
    """Read numbers ``(step, *shape)`` of a part, float32, or uint8 for images, whose space has the shape of a step."""
    shape: tuple[int, ...] = getattr(values, "shape", ())
    kind = getattr(getattr(values, "dtype", None), "kind", "O")
    require(kind in "fiub", place, "numbers", "nothing" if values is None else "others")
    require(len(shape) and shape[1:] == space.shape, place, f"steps of shape {space.shape}, as in metadata", str(shape[1:]))
    require(shape[0], place, "at least one step", "none")
    array: NDArray[Any] = np.asarray(values[()])
    kept = np.uint8 if space.dtype == np.uint8 else np.float64
    return array if array.dtype == kept else array.astype(np.float32)


def _text(attributes: Mapping[str, Any] | None) -> str:
    """Text of the concept, or the first of several; empty if there is none."""
    texts = np.ravel((attributes or {}).get(CONCEPT, ""))
    first = texts[0] if len(texts) else ""
    return first.decode("utf-8") if isinstance(first, bytes) else str(first)


def write_minari(demonstrations: Demonstrations, name: str) -> None:
    """Write a data set for Minari and :func:`read_minari`, with an episode for each demonstration.

    With observed features, an observation is a dictionary: the states as ``'observation'``, and each feature by its name.
    Rewards, which Minari requires, are 0, and so are actions that are unknown. The action in the last state is left out.

    Args:
        demonstrations: at least two states each, since n steps have n + 1 observations.
        name: name of a new data set, such as ``strokes/test-v0``.

    Raises:
        UserError: naming the data set, if it exists or cannot be written, a demonstration is too short, or the name of an observed
            feature cannot be a key.
    """
    check_extra("minari", f"{name}: this data set")
    import gymnasium
    import minari
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    enough = int(demonstrations.lengths.min()) >= 2
    require(enough, name, "demonstrations of two states or more", "one of 1, which makes no step")
    check_names(demonstrations, PART, name)
    space: gymnasium.Space[Any] = Box(-np.inf, np.inf, demonstrations.states.shape[2:], np.float32)
    if demonstrations.observed:
        spaces = {PART: space}
        for key, feature in demonstrations.features.items():
            low, high, dtype = (0, 255, np.uint8) if feature.kind == "image" else (-np.inf, np.inf, np.float32)
            spaces[key] = Box(low, high, feature.shape, dtype)
        space = gymnasium.spaces.Dict(spaces)
    acts = Box(0, 0, (1,), np.float32)
    if demonstrations.actions is not None:
        acts = Box(-np.inf, np.inf, demonstrations.actions.shape[2:], np.float32)
    buffers = []
    for episode in to_episodes(demonstrations):
        steps = len(episode.states) - 1
        infos = {CONCEPT: episode.concept} | ({} if episode.scene is None else {SCENE: episode.scene})
        features = {PART: list(episode.states), **{key: list(values) for key, values in episode.observed.items()}}
        buffers.append(
            EpisodeBuffer(
                observations=features if episode.observed else features[PART],
                actions=list(np.zeros((steps, 1), np.float32) if episode.actions is None else episode.actions[:-1]),
                rewards=[0.0] * steps,
                terminations=[False] * steps,
                truncations=[False] * (steps - 1) + [True],
                infos={key: [value] * (steps + 1) for key, value in infos.items()},
            )
        )
    try:
        with warnings.catch_warnings(action="ignore"):  # advice about author, permalink and so on
            written = minari.create_dataset_from_buffers(
                name, buffers, observation_space=space, action_space=acts, jpeg_encoding=False
            )
            written.storage.update_metadata({_HEADER: metadata(demonstrations)})
    except (ImportError, OSError, ValueError, AttributeError, TypeError) as error:
        raise UserError(f"{name}: cannot be written as a Minari data set such as strokes/test-v0 ({error})") from error


FORMATS["minari"] = Format(_contents, write_minari)
