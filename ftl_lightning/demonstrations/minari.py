"""Demonstrations as Minari data sets, and back. Needs the extra ``minari``.

An episode is a demonstration and its observations, flattened, are the states. Its text is the first that is found of ``concept``
in the episode's ``infos`` (of its first step, if there is one a step), in the episode's metadata, and in the data set's metadata;
where there is none, the data set's name stands for it.

What Minari has no place for is kept in the data set's metadata: the domain, names and units of the columns. Observed features and
scenes are left out.
"""

import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium
import minari
import numpy as np
import torch
from gymnasium.spaces import Box
from minari.data_collector import EpisodeBuffer
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations, padded
from ftl_lightning.errors import UserError

CONCEPT = "concept"
"""Where an episode's text is, see this module."""
PART = "observation"
"""Part of an observation that is read where it has several, as in Gymnasium's environments with goals."""
_HEADER = "ftl_lightning"
"""Key of the data set's metadata for what only :func:`write_minari` knows."""


def read_minari(name: str, part: str = "") -> Demonstrations:
    """Demonstrations of an installed data set; nothing is downloaded.

    Args:
        name: such as ``strokes/test-v0``. Minari looks in ``MINARI_DATASETS_PATH``, by default ``~/.minari/datasets``.
        part: of observations that are dictionaries, the key of the states; empty for ``'observation'`` or the only vector.

    Returns:
        Without observed features, padded to the longest episode. An episode of n steps has n + 1 states.

    Raises:
        UserError: naming the data set, if it is not installed, damaged or empty, or its observations are no vectors.
    """
    try:
        found = minari.load_dataset(name)
        part = _part(name, found.observation_space, part)
        episodes = [(_states(one.observations, part), _text(one.infos)) for one in found]
        beside = [_text(one) for one in found.storage.get_episode_metadata(found.episode_indices)]
        metadata = found.storage.metadata
    except FileNotFoundError as error:
        raise UserError(
            f"{name}: expected a file or an installed Minari data set, found neither; see: minari list local"
        ) from error
    except (ImportError, OSError, ValueError, KeyError, TypeError, AssertionError) as error:
        raise UserError(f"{name}: expected a Minari data set, found a damaged or foreign one ({error})") from error
    if not episodes:
        raise UserError(f"{name}: expected at least one episode, found none")
    states, lengths = padded([values for values, _ in episodes])
    header = metadata.get(_HEADER, {})
    whole = _text(metadata) or name
    columns = states.shape[2]
    try:
        return Demonstrations(
            states=states,
            lengths=lengths,
            domain=header.get("domain", ""),
            state_names=tuple(header.get("state_names", map(str, range(columns)))),
            state_units=tuple(header.get("state_units", ("",) * columns)),
            concepts=tuple(own or other or whole for (_, own), other in zip(episodes, beside, strict=True)),
            provenance={"minari": name},
        )
    except UserError as error:
        raise UserError(f"{name}: {error}") from None


def write_minari(demonstrations: Demonstrations, name: str) -> None:
    """Write a data set that Minari and :func:`read_minari` read, one episode a demonstration.

    Demonstrations are states without actions: the actions that Minari asks for are a single 0, and so are the rewards.

    Args:
        demonstrations: of two states or more each, since n steps have n + 1 observations.
        name: such as ``strokes/test-v0``, of a data set that is not there yet.

    Raises:
        UserError: naming the data set, if it is there already or cannot be written, or a demonstration is too short.
    """
    if int(demonstrations.lengths.min()) < 2:
        raise UserError(f"{name}: expected demonstrations of two states or more, found one of 1, which makes no step")
    rows = zip(demonstrations.states, demonstrations.lengths.tolist(), demonstrations.concepts, strict=True)
    try:
        with warnings.catch_warnings(action="ignore"):  # advice about author, permalink and so on
            written = minari.create_dataset_from_buffers(
                name,
                [_episode(states[:length], text) for states, length, text in rows],
                observation_space=Box(-np.inf, np.inf, demonstrations.states.shape[2:], np.float32),
                action_space=Box(0, 0, (1,), np.float32),
            )
            header = {
                "domain": demonstrations.domain,
                "state_names": list(demonstrations.state_names),
                "state_units": list(demonstrations.state_units),
            }
            written.storage.update_metadata({_HEADER: header})
    except (ImportError, OSError, ValueError, AttributeError, TypeError) as error:
        raise UserError(f"{name}: cannot be written as a Minari data set such as strokes/test-v0 ({error})") from error


def _episode(states: Tensor, text: str) -> EpisodeBuffer:
    steps = len(states) - 1
    return EpisodeBuffer(
        observations=list(states.numpy()),
        actions=list(np.zeros((steps, 1), np.float32)),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
        infos={CONCEPT: [text] * (steps + 1)},
    )


def _part(name: str, space: gymnasium.Space[Any], part: str) -> str:
    """Which part of an observation holds the states; empty where it has none.

    Raises:
        UserError: where that is no vector, or not clear.
    """
    if not isinstance(space, gymnasium.spaces.Dict):
        vectors = [""] if _is_vector(space) else []
        expected = "observations that are vectors (a Box of numbers)"
    else:
        vectors = [key for key, own in space.spaces.items() if _is_vector(own)]
        told = ", ".join(vectors) or "none"
        expected = f"observations with one vector or {PART!r}, or read_minari(name, part) with one of {told}"
    if not part and (PART in vectors or len(vectors) == 1):
        return PART if PART in vectors else vectors[0]
    if not part or part not in vectors:
        raise UserError(f"{name}: expected {expected}, found {repr(part) if part else type(space).__name__}")
    return part


def _is_vector(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and space.dtype != np.uint8  # which images are


def _states(observations: Any, part: str) -> Tensor:
    """``(time, state)`` float32."""
    values = np.asarray(observations[part] if part else observations, dtype=np.float32)
    return torch.from_numpy(values.reshape(len(values), -1))


def _text(where: Mapping[str, Any] | None) -> str:
    """The concept's text, or the first of several; empty where there is none."""
    found = np.ravel((where or {}).get(CONCEPT, ""))
    first = found[0] if len(found) else ""
    return first.decode("utf-8") if isinstance(first, bytes) else str(first)
