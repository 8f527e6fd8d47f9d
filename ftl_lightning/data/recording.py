"""Record demonstrations by a wrapper of any Gymnasium environment."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.formats.episodes import Beside, Episode, contents
from ftl_lightning.data.observations import feature_parts, states_part
from ftl_lightning.services.errors import UserError

Part = str | Callable[[Any], ArrayLike]
"""Part of an observation: a key, or a function of the observation."""


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Record every episode of an environment as a demonstration, whoever acts in it: a person, a script or a policy.

    An episode of n steps has n + 1 states. It ends when the environment terminates or truncates it; later steps are not recorded.
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
        self._beside = Beside(domain, names, units, None, {"environment": str(env)})
        self._keep_unfinished = keep_unfinished
        self.concept = concept
        self.dropped = 0
        self._done: list[Episode] = []
        self._running: list[tuple[NDArray[Any], dict[str, NDArray[Any]]]] = []
        self._text = concept

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and begin an episode. A running episode is kept or dropped."""
        observation, info = super().reset(seed=seed, options=options)
        if (left := self._unfinished()) is not None:
            self._done.append(left)
        elif self._running:
            self.dropped += 1
        self._text, self._running = self.concept, []
        self._running.append(self._taken(observation))
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record the observation."""
        observation, reward, terminated, truncated, info = super().step(action)
        if self._running:
            self._running.append(self._taken(observation))
            if terminated or truncated:
                self._done.append(self._episode())
                self._running = []
        return observation, reward, terminated, truncated, info

    def demonstrations(self) -> Demonstrations:
        """Demonstrations recorded so far, padded to the longest with the last state.

        Raises:
            UserError: if there are none, the number of columns varies, or numbers are not finite.
        """
        left = self._unfinished()
        every = [*self._done, *([] if left is None else [left])]
        if not every:
            unfinished = self.dropped + bool(self._running)
            advice = "step the environment to its end, or give keep_unfinished=True"
            raise UserError(f"recorder: expected an episode that ended, found none, and {unfinished} that did not; {advice}")
        return Demonstrations(**contents(every, self._beside))

    def save(self, path: str | Path) -> None:
        """Write the demonstrations in any known format, see :meth:`ftl_lightning.data.demonstrations.Demonstrations.save`."""
        self.demonstrations().save(path)

    def _taken(self, observation: Any) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
        state = _numbers(_of(observation, self._state)).reshape(-1)
        features = {name: _numbers(_of(observation, part)) for name, part in self._observed.items()}
        if self._running or self._done:
            # A function may return any shape; padding would fail later without naming it.
            first, before = self._running[0] if self._running else (self._done[0].states[0], _first(self._done[0]))
            for name, now, then in [("state", state, first), *((key, features[key], before[key]) for key in features)]:
                if now.shape != then.shape:
                    raise UserError(f"{name}: expected shape {then.shape}, as in the first observation, found {now.shape}")
        return state, features

    def _episode(self) -> Episode:
        states = np.stack([state for state, _ in self._running])
        observed = {name: np.stack([features[name] for _, features in self._running]) for name in self._observed}
        return Episode(states, observed, self._text)

    def _unfinished(self) -> Episode | None:
        return self._episode() if self._keep_unfinished and len(self._running) > 1 else None


def _of(observation: Any, part: Part) -> Any:
    if callable(part):
        return part(observation)
    return observation[part] if part else observation


def _first(episode: Episode) -> dict[str, NDArray[Any]]:
    return {name: values[0] for name, values in episode.observed.items()}


def _numbers(values: Any) -> NDArray[Any]:
    """Copy values, since environments may change them: to float32, or images with their channels first."""
    array = np.array(values)
    if array.dtype != np.uint8:
        return np.atleast_1d(array.astype(np.float32))
    return np.moveaxis(array, -1, 0) if array.ndim == 3 else array
