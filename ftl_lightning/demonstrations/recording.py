"""Demonstrations recorded where they are given: a wrapper of any Gymnasium environment."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.episodes import Beside, Episode, contents
from ftl_lightning.demonstrations.observations import feature_parts, states_part
from ftl_lightning.errors import UserError

Part = str | Callable[[Any], ArrayLike]
"""What is taken from an observation: a key of it, or what a function makes of it."""


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Record every episode of an environment as a demonstration, whoever acts in it: a person, a script or a policy.

    An episode of n steps has n + 1 states. It ends where the environment terminates or truncates it; what is stepped after that is
    not recorded. The environment behaves as it does without the wrapper.

    Args:
        env: of which observations are vectors or dictionaries; with functions, anything.
        state: which part of an observation is the state, a key or a function that returns a vector; empty for the observation
            itself, or of a dictionary its part ``'observation'`` or only vector.
        observed: parts that are observed features, known at every time: keys, or by name a key or a function. Images (uint8,
            ``(height, width, channel)``) are stored with their channels first.
        concept: text of the episodes. Set the attribute to change it for those that begin afterwards.
        keep_unfinished: whether episodes that were reset before their end, and the one that still runs, are kept where they have a
            step. By default they are dropped: who resets early mostly does it because something went wrong.
        state_names, state_units: of the state's columns; by default they are numbered and without units.
        domain: name of the domain that these are demonstrations of; empty for none.

    Attributes:
        concept: text of the episode that begins next.
        dropped: episodes that were dropped.

    Raises:
        UserError: for a part that observations do not have, or where it is not clear which one is the state.
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
        names, units = (None if told is None else tuple(told) for told in (state_names, state_units))
        self._told = Beside(domain, names, units, None, {"environment": str(env)})
        self._keep_unfinished = keep_unfinished
        self.concept = concept
        self.dropped = 0
        self._done: list[Episode] = []
        self._running: list[tuple[NDArray[Any], dict[str, NDArray[Any]]]] = []
        self._text = concept

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, which begins an episode. One that still runs is kept or dropped."""
        observation, info = super().reset(seed=seed, options=options)
        if (left := self._unfinished()) is not None:
            self._done.append(left)
        elif self._running:
            self.dropped += 1
        self._text, self._running = self.concept, []
        self._running.append(self._taken(observation))
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and record what is seen then."""
        observation, reward, terminated, truncated, info = super().step(action)
        if self._running:
            self._running.append(self._taken(observation))
            if terminated or truncated:
                self._done.append(self._episode())
                self._running = []
        return observation, reward, terminated, truncated, info

    def demonstrations(self) -> Demonstrations:
        """What was recorded so far, padded to the longest with the last state.

        Raises:
            UserError: if that is nothing, states have no fixed number of columns, or numbers are not finite.
        """
        left = self._unfinished()
        every = [*self._done, *([] if left is None else [left])]
        if not every:
            unfinished = self.dropped + bool(self._running)
            advice = "step the environment to its end, or give keep_unfinished=True"
            raise UserError(f"recorder: expected an episode that ended, found none, and {unfinished} that did not; {advice}")
        return Demonstrations(**contents(every, self._told))

    def save(self, path: str | Path) -> None:
        """Write them in any known format, see :meth:`ftl_lightning.demonstrations.container.Demonstrations.save`."""
        self.demonstrations().save(path)

    def _taken(self, observation: Any) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
        state = _numbers(_of(observation, self._state)).reshape(-1)
        features = {name: _numbers(_of(observation, part)) for name, part in self._observed.items()}
        if self._running or self._done:
            # A function may return what it likes; padding would fail later, and not say where.
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
    """A copy, since environments may change what they returned: float32, or images with their channels first."""
    found = np.array(values)
    if found.dtype != np.uint8:
        return np.atleast_1d(found.astype(np.float32))
    return np.moveaxis(found, -1, 0) if found.ndim == 3 else found
