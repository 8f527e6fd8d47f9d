"""Minari data sets. Needs the extra ``minari``.

An episode is a demonstration. Its states are the flattened observations. If an observation is a dictionary, a part holds the
states, and its other vectors are observed features that are known at every time. A demonstration's text is the first ``concept`` in
the episode's ``infos`` (of its first step, if they are per step), the episode's metadata, or the data set's metadata; by
default, the data set's name.

Metadata of the data set hold what Minari cannot: the domain, names and units of columns, names of features that are known only at
the start, and provenance. Scenes are ``scene`` in an episode's ``infos``.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ftl_lightning.data.demonstrations import FORMATS, Contents, Demonstrations, Format
from ftl_lightning.data.formats.episodes import PART, Episode, Metadata, check_names, from_episodes, measured, metadata, to_episodes
from ftl_lightning.services.errors import UserError, about, require, short
from ftl_lightning.services.shipped import check_extra
from ftl_lightning.services.validation import from_mapping

CONCEPT, SCENE = "concept", "scene"
"""Keys of an episode's text and scene, see this module."""
_HEADER = "ftl_lightning"  # metadata key of attributes that only write_minari knows


def read_minari(name: str, part: str = "", observed: Sequence[str] | None = None) -> Demonstrations:
    """Read demonstrations of an installed data set; nothing is downloaded.

    Args:
        name: name such as ``strokes/test-v0``. Minari looks in ``MINARI_DATASETS_PATH``, by default ``~/.minari/datasets``.
        part: key of the states in dictionaries; empty for ``'observation'`` or the only vector.
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

    from ftl_lightning.data.recording import feature_parts, states_part

    try:
        dataset = minari.load_dataset(name)
        attributes = dataset.storage.metadata
        written = _HEADER in attributes
        with about(name):
            metadata = from_mapping(Metadata, attributes.get(_HEADER, {}), _HEADER)
            part = states_part(dataset.observation_space, part)
            features = feature_parts(dataset.observation_space, part, observed, images=written)
        if part not in ("", PART):  # names and units are those of the states that were written
            metadata = replace(metadata, state_names=None, state_units=None)
        texts = [_text(entry) for entry in dataset.storage.get_episode_metadata(dataset.episode_indices)]
        texts = [text or _text(attributes) or name for text in texts]
        episodes = [_episode(episode, part, features, text, written) for episode, text in zip(dataset, texts, strict=True)]
    except FileNotFoundError as error:
        message = "expected a file or an installed Minari data set, found neither; see: minari list local"
        raise UserError(f"{name}: {message}") from error
    except (ImportError, OSError, ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
        message = short(str(error), 100)
        raise UserError(f"{name}: expected a Minari data set, found a damaged or foreign one ({message})") from error
    with about(name):
        contents = from_episodes(episodes, metadata)
    return {**contents, "provenance": contents["provenance"] or {"minari": name}}


def _episode(episode: Any, part: str, features: Sequence[str], text: str, written: bool) -> Episode:
    observations, infos = episode.observations, episode.infos or {}
    states = np.asarray(observations[part] if part else observations, dtype=np.float32)
    return Episode(
        states.reshape(len(states), -1),
        {key: measured(observations[key]) for key in features},
        _text(infos) or text,
        np.asarray(infos[SCENE], dtype=np.float32)[0] if written and SCENE in infos else None,
    )


def _text(attributes: Mapping[str, Any] | None) -> str:
    """Text of the concept, or the first of several; empty if there is none."""
    texts = np.ravel((attributes or {}).get(CONCEPT, ""))
    first = texts[0] if len(texts) else ""
    return first.decode("utf-8") if isinstance(first, bytes) else str(first)


def write_minari(demonstrations: Demonstrations, name: str) -> None:
    """Write a data set for Minari and :func:`read_minari`, with an episode for each demonstration.

    With observed features, an observation is a dictionary: the states as ``'observation'``, and each feature by its name.
    Demonstrations have no actions: the actions and rewards that Minari requires are 0.

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
    buffers = []
    for episode in to_episodes(demonstrations):
        steps = len(episode.states) - 1
        infos = {CONCEPT: episode.concept} | ({} if episode.scene is None else {SCENE: episode.scene})
        features = {PART: list(episode.states), **{key: list(values) for key, values in episode.observed.items()}}
        buffers.append(
            EpisodeBuffer(
                observations=features if episode.observed else features[PART],
                actions=list(np.zeros((steps, 1), np.float32)),
                rewards=[0.0] * steps,
                terminations=[False] * steps,
                truncations=[False] * (steps - 1) + [True],
                infos={key: [value] * (steps + 1) for key, value in infos.items()},
            )
        )
    try:
        with warnings.catch_warnings(action="ignore"):  # advice about author, permalink and so on
            written = minari.create_dataset_from_buffers(
                name, buffers, observation_space=space, action_space=Box(0, 0, (1,), np.float32)
            )
            written.storage.update_metadata({_HEADER: metadata(demonstrations)})
    except (ImportError, OSError, ValueError, AttributeError, TypeError) as error:
        raise UserError(f"{name}: cannot be written as a Minari data set such as strokes/test-v0 ({error})") from error


FORMATS["minari"] = Format(_contents, write_minari)
