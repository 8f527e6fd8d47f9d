"""Record demonstrations by a wrapper of any Gymnasium environment. Needs ``gymnasium``, which every environment brings."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.formats.episodes import PART, Episode, Metadata, from_episodes
from ftl_lightning.services.errors import UserError, require, short

Part = str | Callable[[Any], ArrayLike]
"""Part of an observation: a key, of a nested part such as ``'goal/achieved'``, or a function of the observation."""


def parts_of(space: gymnasium.Space[Any]) -> dict[str, gymnasium.Space[Any]]:
    """Parts of an observation that is a dictionary, by key; keys of nested parts are joined by ``/``."""
    return dict(_leaves(space, "")) if isinstance(space, gymnasium.spaces.Dict) else {}


def _leaves(space: gymnasium.Space[Any], key: str) -> Iterator[tuple[str, gymnasium.Space[Any]]]:
    if isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
        inner = space.spaces.items() if isinstance(space, gymnasium.spaces.Dict) else enumerate(space.spaces)
        for name, part in inner:
            yield from _leaves(part, f"{key}/{name}" if key else str(name))
    else:
        yield key, space


def part_of(observation: Any, key: str) -> Any:
    """Part of an observation by its key in :func:`parts_of`; the observation itself for the empty key."""
    for name in key.split("/") if key else ():
        observation = observation[int(name) if isinstance(observation, tuple) else name]
    return observation


def states_part(space: gymnasium.Space[Any], part: str = "") -> str:
    """Key of the states in an observation, see :func:`parts_of`; empty if the observation is itself a vector.

    Args:
        space: observation space.
        part: requested key; empty for :data:`PART` or the only vector.

    Raises:
        UserError: if the part is no vector or ambiguous.
    """
    if isinstance(space, gymnasium.spaces.Dict):
        vectors = [key for key, box in parts_of(space).items() if _is_vector(box)]
        keys = short(", ".join(vectors), 120) or "none"
        expected = f"observations with one vector or {PART!r}, or the key of the states, one of {keys}"
    else:
        vectors = [""] if _is_vector(space) else []
        expected = "observations that are vectors (a Box of numbers)"
    if not part and (PART in vectors or len(vectors) == 1):
        return PART if PART in vectors else vectors[0]
    if not part or part not in vectors:
        raise UserError(f"expected {expected}, found {repr(short(part)) if part else type(space).__name__}")
    return part


def feature_parts(
    space: gymnasium.Space[Any], states: str, observed: Sequence[str] | None = None, *, images: bool = False
) -> tuple[str, ...]:
    """Keys of the observed features in an observation.

    Args:
        space: observation space.
        states: key of the states, which is excluded unless requested.
        observed: requested keys; ``None`` for all other vectors.
        images: whether to include images (uint8).

    Raises:
        UserError: for a key without such a part.
    """
    known = [key for key, box in parts_of(space).items() if _is_vector(box) or (images and isinstance(box, Box))]
    for key in observed or ():
        require(key in known, "observed", f"some of {short(', '.join(known), 120) or 'none'}", f"{short(key)!r}")
    return tuple(key for key in known if key != states) if observed is None else tuple(observed)


def _is_vector(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and space.dtype != np.uint8  # the type of images


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Record every episode of an environment as a demonstration, whoever acts in it: a person, a script or a policy.

    An episode of n steps has n + 1 states; the last action, if actions are vectors, is repeated in the last state. It ends
    when the environment terminates or truncates it; later steps are not recorded.
    The wrapper does not change the environment's behaviour.

    Args:
        env: environment whose observations are vectors or dictionaries; with functions, anything.
        state: part of an observation that is the state, a key or a function that returns a vector; empty for the observation
            itself, or for the part ``'observation'`` or the only vector of a dictionary.
        observed: parts that are observed features, known at every time: keys, or keys or functions by name. Images (uint8,
            ``(height, width, channel)``) are stored with their channels first.
        concept: text of the episodes. Set the attribute to change it for later episodes.
        keep_unfinished: whether to keep episodes that were reset before their end, and the running episode, if they have a step. By
            default they are dropped: an early reset mostly means that something went wrong.
        state_names, state_units: names and units of the state's columns; by default numbers and no units.
        domain: name of the demonstrations' domain; empty for none.

    Attributes:
        concept: text of the next episode.
        dropped: number of dropped episodes.

    Raises:
        UserError: for a part that observations lack, or if the state is ambiguous.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        state: Part = "",
        observed: Sequence[str] | Mapping[str, Part] = (),
        concept: str = "",
        keep_unfinished: bool = False,
        state_names: Sequence[str] | None = None,
        state_units: Sequence[str] | None = None,
        domain: str = "",
    ) -> None:
        super().__init__(env)
        space = env.observation_space
        self._state = states_part(space, state) if isinstance(state, str) else state
        self._observed: dict[str, Part] = dict(observed if isinstance(observed, Mapping) else zip(observed, observed, strict=True))
        feature_parts(space, "", [part for part in self._observed.values() if isinstance(part, str)], images=True)
        names, units = (None if labels is None else tuple(labels) for labels in (state_names, state_units))
        self._extra = Metadata(domain, names, units, None, {"environment": str(env)})
        self._keep_unfinished, self.concept, self.dropped = keep_unfinished, concept, 0
        self._done: list[Episode] = []
        self._running: list[dict[str, NDArray[Any]]] = []
        self._actions: list[NDArray[Any]] = []
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._text = concept

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin an episode. A running episode is kept or dropped."""
        observation, info = super().reset(seed=seed, options=options)
        kept = self._unfinished()
        self._done += kept
        self.dropped += bool(self._running) and not kept
        self._text, self._running, self._actions = self.concept, [], []
        self._record(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record action and observation."""
        if self._running and _is_vector(self.action_space):
            self._actions.append(_numbers(action).reshape(-1))
        observation, reward, terminated, truncated, info = super().step(action)
        if self._running:
            self._record(observation)
            if terminated or truncated:
                self._done.append(self._episode())
                self._running = []
        return observation, reward, terminated, truncated, info

    def demonstrations(self) -> Demonstrations:
        """Demonstrations recorded so far, padded to the longest with the last state.

        Raises:
            UserError: if there are none, the number of columns varies, or numbers are not finite.
        """
        episodes = [*self._done, *self._unfinished()]
        advice = "step the environment to its end, or give keep_unfinished=True"
        unfinished = f"none, and {self.dropped + bool(self._running)} that did not; {advice}"
        require(episodes, "recorder", "an episode that ended", unfinished)
        return Demonstrations(**from_episodes(episodes, self._extra))

    def save(self, path: str | Path) -> None:
        """Write the demonstrations in any known format, see :meth:`ftl_lightning.data.demonstrations.Demonstrations.save`."""
        self.demonstrations().save(path)

    def _record(self, observation: Any) -> None:
        values = {"state": _numbers(_part_of(observation, self._state)).reshape(-1)}
        values |= {f"observed {name}": _numbers(_part_of(observation, part)) for name, part in self._observed.items()}
        self._shapes = self._shapes or {name: array.shape for name, array in values.items()}
        for name, array in values.items():  # a function may return any shape
            shape = self._shapes[name]
            require(array.shape == shape, name, f"shape {shape}, as in the first observation", str(array.shape))
        self._running.append(values)

    def _episode(self) -> Episode:
        states, *features = (np.stack([values[name] for values in self._running]) for name in self._shapes)
        actions = np.stack(self._actions) if self._actions else None
        return Episode(states, dict(zip(self._observed, features, strict=True)), self._text, actions=actions)

    def _unfinished(self) -> list[Episode]:
        """The running episode, if it is to be kept."""
        return [self._episode()] if self._keep_unfinished and len(self._running) > 1 else []


def _part_of(observation: Any, part: Part) -> Any:
    return part(observation) if callable(part) else part_of(observation, part)


def _numbers(values: Any) -> NDArray[Any]:
    """Copy values, since environments may change them: to float32, or images with their channels first."""
    array = np.array(values)
    if array.dtype != np.uint8:
        with np.errstate(over="ignore"):  # overflow is reported later as a number that is not finite
            return np.atleast_1d(array.astype(np.float32))
    return np.moveaxis(array, -1, 0) if array.ndim == 3 else array
