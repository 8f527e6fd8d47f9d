"""Closed loop: an environment whose actions are wishes for the next state; a look-ahead planner turns them into decisions."""

import math
from typing import Any

import gymnasium
import numpy as np
import torch
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.domains.driving.foresight import VETOES, Beliefs, Worlds
from ftl_lightning.domains.driving.motion import drive
from ftl_lightning.domains.driving.scenarios import SCENARIOS, arrived, make, observe
from ftl_lightning.domains.driving.simulation import advance
from ftl_lightning.domains.driving.traffic import (
    BELIEF,
    FEATURES_SEEN,
    MAX_STEPS,
    NAMES,
    OBSERVED,
    SCENARIO,
    SEEDS,
    STATE,
    TRAFFIC,
    origin,
    scene,
)
from ftl_lightning.errors import UserError

DRIVE = 4
"""Numbers of a drive."""

Seen = dict[str, NDArray[np.float32]]
"""Observed features by name."""


class DrivingEnvironment(gymnasium.Env[Seen, NDArray[np.float32]]):
    """Any scenario, from a start that its number and seed decide.

    An observation is an initial state (37 numbers). An action is the state (7 numbers) that the controlled vehicle should be in a
    step later; or the drive there (4, see :func:`~ftl_lightning.domains.driving.motion.drive`), for those who do not know where
    the road turns; or the number of one of the scenario's decisions, for policies that decide themselves. Of the decisions that
    the veto finds least risky (:mod:`ftl_lightning.domains.driving.foresight`) the one that comes nearest to the wish (Euclidean,
    in raw units) is taken, at random among equals; to brake if all crash. A decision that is riskier than others is replaced by a
    random one of these.

    The information of the last step tells what happened: ``crashed``, ``arrived`` (where the scenario wants the vehicle, and no
    crash), ``passed`` (the count of the paper's code), ``return`` (sum of rewards) and ``length``.

    Args:
        veto: ``'belief'``, ``'simulation'`` or ``'step'`` (the paper's).

    Raises:
        UserError: for another one.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (gymnasium's)
    render_mode = "rgb_array"
    observation_space: gymnasium.spaces.Space[Any] = gymnasium.spaces.Dict(
        {name: gymnasium.spaces.Box(-np.inf, np.inf, feature.shape, np.float32) for name, feature in FEATURES_SEEN.items()}
    )
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (STATE,), np.float32)

    def __init__(self, veto: str = BELIEF) -> None:
        if veto not in VETOES:
            raise UserError(f"driving veto: expected one of {', '.join(VETOES)}, found {veto!r}")
        self.veto = veto
        self._name = ""
        self._seed = 0
        self._return = 0.0
        self._length = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Go to a start.

        Args:
            seed: of the start, if no scene is given.
            options: ``scene``, 37 numbers; or ``task``, a scenario (default 'roundabout').

        Raises:
            UserError: for a scene that is not the start that its scenario and seed lead to.
        """
        super().reset(seed=seed)
        options = options or {}
        given = options.get("scene")
        if given is None:
            name, start = options.get("task", "roundabout"), int(self.np_random.integers(SEEDS))
        else:
            name, start = origin(np.asarray(given))
        if name != self._name:
            self._env, self._name = make(name), name
        super().reset(seed=start)  # of the draws among equal decisions
        self._env.reset(seed=start)
        self._seed, self._return, self._length = start, 0.0, 0
        self._beliefs = Beliefs(self._env, name)
        seen = observe(self._env)
        if given is not None and not np.allclose(scene(seen, name, start), given, atol=1e-3):
            raise UserError(
                f"driving scene: expected the start of {name!r} that seed {start} gives, found another; episodes start at "
                "starts, not in the middle of a drive"
            )
        return self.observation(), {}

    @property
    def simulation(self) -> AbstractEnv:
        """highway-env's environment of the scenario."""
        return self._env

    def observation(self) -> Seen:
        """What is observed now."""
        number = np.array([NAMES.index(self._name)], dtype=np.float32)
        return {TRAFFIC: observe(self._env).reshape(OBSERVED).astype(np.float32), SCENARIO: number}

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Decide and drive on until the next decision.

        Raises:
            UserError: for an action of another size, or with numbers that are not finite.
        """
        wish = np.asarray(action, dtype=np.float64)
        if wish.shape not in ((STATE,), (DRIVE,), (1,)) or not np.isfinite(wish).all():
            raise UserError(f"driving action: expected {STATE} finite numbers, {DRIVE} or 1, found {wish.tolist()}")
        chosen = self.decide(wish)
        reward, ended = advance(self._env, chosen)
        self._return += reward
        self._length += 1
        info = self._outcome() if ended or self._length >= MAX_STEPS else {}
        return self.observation(), reward, ended, self._length >= MAX_STEPS, info

    def decide(self, wish: NDArray[np.float64]) -> int:
        """The decision that is nearest to a wish (see the class) among those of least risk; to brake if all crash.

        The simulation stays as it is; draws among equals are used up.
        """
        now = observe(self._env)[0].astype(np.float64)
        self._beliefs.look()
        rng = np.random.default_rng([self._seed, self._length])
        worlds = Worlds(self._env, VETOES[self.veto], self._beliefs, rng)
        if len(wish) == 1 and worlds.risk(int(wish[0])) == 0:
            return int(wish[0])
        states = {decision: worlds.state(decision) for decision in range(self._env.action_space.n)}
        there = {decision: state for decision, state in states.items() if state is not None}
        far = self._far(now, np.stack(list(there.values())), wish) if there and len(wish) > 1 else np.zeros(len(there))
        risks: dict[int, float] = {}
        nearest = math.inf
        for decision, distance in sorted(zip(there, far.tolist(), strict=True), key=lambda pair: pair[1]):
            if distance > nearest + 1e-6:  # one that is nearer has no risk
                break
            risks[decision] = worlds.risk(decision)
            nearest = distance if risks[decision] == 0 else nearest
        least = min(risks.values(), default=1)
        if least == 1:
            return self._slower
        kept = [(decision, distance) for decision, distance in zip(there, far, strict=True) if risks.get(decision) == least]
        closest = min(distance for _, distance in kept)
        if len(wish) == 1 and int(wish[0]) in dict(kept):
            return int(wish[0])
        return int(self.np_random.choice([decision for decision, distance in kept if distance <= closest + 1e-6]))

    @staticmethod
    def _far(now: NDArray[np.float64], states: NDArray[np.float64], wish: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far states ``(decision, 7)`` that follow the present ``(7,)`` are from the wish ``(decision,)``."""
        if len(wish) == DRIVE:
            states = drive(torch.from_numpy(now).expand(len(states), -1), torch.from_numpy(states)).numpy()
        distances: NDArray[np.float64] = np.linalg.norm(states - wish, axis=1)
        return distances

    @property
    def _slower(self) -> int:
        return int(self._env.action_type.actions_indexes["SLOWER"])

    def _outcome(self) -> dict[str, float]:
        crashed = bool(self._env.vehicle.crashed)
        there = arrived(self._env, self._name)
        passed = SCENARIOS[self._name].passed
        return {
            "crashed": crashed,
            "arrived": there and not crashed,
            "passed": passed(self._env) if passed else there and not crashed,
            "return": self._return,
            "length": self._length,
        }

    def render(self) -> NDArray[np.uint8]:
        """A picture from above ``(height, width, 3)``."""
        picture: NDArray[np.uint8] = self._env.render()
        return picture

    def close(self) -> None:
        """Close the simulation."""
        if self._name:
            self._env.close()
