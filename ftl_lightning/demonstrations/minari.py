"""Demonstrations as Minari data sets, and back. Needs the extra ``minari``.

An episode is a demonstration and its observations, flattened, are the states. Where an observation is a dictionary, one part of it
is the states and its other vectors are observed features, known at every time. A demonstration's text is the first that is found of
``concept`` in the episode's ``infos`` (of its first step, if there is one a step), in the episode's metadata, and in the data set's
metadata; where there is none, the data set's name stands for it.

What Minari has no place for is kept in the data set's metadata: the domain, names and units of the columns, which features are
known at the start alone, and where the demonstrations come from. Scenes are ``scene`` in an episode's ``infos``.
"""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import minari
import numpy as np
from gymnasium.spaces import Box
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.episodes import Beside, Episode, beside, contents, episodes, expect_names
from ftl_lightning.demonstrations.file_format import Contents
from ftl_lightning.demonstrations.observations import PART, feature_parts, states_part
from ftl_lightning.errors import UserError, about, short
from ftl_lightning.schema import from_mapping

CONCEPT = "concept"
"""Where an episode's text is, see this module."""
SCENE = "scene"
"""Where its scene is."""
_HEADER = "ftl_lightning"
"""Key of the data set's metadata for what only :func:`write_minari` knows."""


def read_minari(name: str, part: str = "", observed: Sequence[str] | None = None) -> Demonstrations:
    """Demonstrations of an installed data set; nothing is downloaded.

    Args:
        name: such as ``strokes/test-v0``. Minari looks in ``MINARI_DATASETS_PATH``, by default ``~/.minari/datasets``.
        part: of observations that are dictionaries, the key of the states; empty for ``'observation'`` or the only vector.
        observed: other keys that are observed features; ``None`` for all vectors. Images are read from data sets that
            :func:`write_minari` made, and else left out.

    Returns:
        Padded to the longest episode with the last state. An episode of n steps has n + 1 states.

    Raises:
        UserError: naming the data set, if it is not installed, damaged or empty, or its observations are no vectors.
    """
    with about(name):
        return Demonstrations(**read_contents(name, part, observed))


def read_contents(name: str, part: str = "", observed: Sequence[str] | None = None) -> Contents:
    """The same before it is looked at whether values fit each other, see :func:`read_minari`, with the same arguments.

    Raises:
        UserError: naming the data set, if it is none, is damaged or has other parts.
    """
    try:
        found = minari.load_dataset(name)
        metadata = found.storage.metadata
        with about(name):
            told = from_mapping(Beside, metadata.get(_HEADER, {}), _HEADER)
        own = _HEADER in metadata
        with about(name):
            part = states_part(found.observation_space, part)
            features = feature_parts(found.observation_space, part, observed, images=own)
        if observed is not None or part not in ("", PART):
            told = told.of(features, part in ("", PART))
        texts = [_text(one) for one in found.storage.get_episode_metadata(found.episode_indices)]
        whole = _text(metadata) or name
        read = [_read(one, part, features, other or whole, own) for one, other in zip(found, texts, strict=True)]
    except FileNotFoundError as error:
        raise UserError(
            f"{name}: expected a file or an installed Minari data set, found neither; see: minari list local"
        ) from error
    except (ImportError, OSError, ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
        told_error = short(str(error), 100)
        raise UserError(f"{name}: expected a Minari data set, found a damaged or foreign one ({told_error})") from error
    with about(name):
        made = contents(read, told)
    return {**made, "provenance": made["provenance"] or {"minari": name}}


def write_minari(demonstrations: Demonstrations, name: str) -> None:
    """Write a data set that Minari and :func:`read_minari` read, one episode a demonstration.

    Where features are observed, an observation is a dictionary: the states as ``'observation'``, and each feature by its name.
    Demonstrations are states without actions: the actions that Minari asks for are a single 0, and so are the rewards.

    Args:
        demonstrations: of two states or more each, since n steps have n + 1 observations.
        name: such as ``strokes/test-v0``, of a data set that is not there yet.

    Raises:
        UserError: naming the data set, if it is there already or cannot be written, a demonstration is too short, or an observed
            feature has a name that cannot be a key.
    """
    if int(demonstrations.lengths.min()) < 2:
        raise UserError(f"{name}: expected demonstrations of two states or more, found one of 1, which makes no step")
    expect_names(demonstrations, PART, name)
    space: gymnasium.Space[Any] = Box(-np.inf, np.inf, demonstrations.states.shape[2:], np.float32)
    if demonstrations.observed:
        parts = {key: _space(feature.kind == "image", feature.shape) for key, feature in demonstrations.features.items()}
        space = gymnasium.spaces.Dict({PART: space, **parts})
    try:
        with warnings.catch_warnings(action="ignore"):  # advice about author, permalink and so on
            written = minari.create_dataset_from_buffers(
                name,
                [_buffer(one) for one in episodes(demonstrations)],
                observation_space=space,
                action_space=Box(0, 0, (1,), np.float32),
            )
            written.storage.update_metadata({_HEADER: beside(demonstrations)})
    except (ImportError, OSError, ValueError, AttributeError, TypeError) as error:
        raise UserError(f"{name}: cannot be written as a Minari data set such as strokes/test-v0 ({error})") from error


def _space(image: bool, shape: tuple[int, ...]) -> Box:
    return Box(0, 255, shape, np.uint8) if image else Box(-np.inf, np.inf, shape, np.float32)


def _buffer(episode: Episode) -> EpisodeBuffer:
    times = len(episode.states)
    steps = times - 1
    scene = {} if episode.scene is None else {SCENE: [episode.scene] * times}
    return EpisodeBuffer(
        observations={PART: list(episode.states), **{key: list(values) for key, values in episode.observed.items()}}
        if episode.observed
        else list(episode.states),
        actions=list(np.zeros((steps, 1), np.float32)),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
        infos={CONCEPT: [episode.concept] * times, **scene},
    )


def _read(found: Any, part: str, features: Sequence[str], text: str, own: bool) -> Episode:
    observations = found.observations
    states = np.asarray(observations[part] if part else observations, dtype=np.float32)
    infos = found.infos or {}
    return Episode(
        states.reshape(len(states), -1),
        {key: _numbers(observations[key]) for key in features},
        _text(infos) or text,
        np.asarray(infos[SCENE], dtype=np.float32)[0] if own and SCENE in infos else None,
    )


def _numbers(values: Any) -> NDArray[Any]:
    found = np.asarray(values)
    return found if found.dtype == np.uint8 else found.astype(np.float32)


def _text(where: Mapping[str, Any] | None) -> str:
    """The concept's text, or the first of several; empty where there is none."""
    found = np.ravel((where or {}).get(CONCEPT, ""))
    first = found[0] if len(found) else ""
    return first.decode("utf-8") if isinstance(first, bytes) else str(first)
