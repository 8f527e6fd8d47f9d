"""Environment whose actions are desired next states; a look-ahead planner turns them into decisions."""

import math
from typing import Any

import gymnasium
import numpy as np
import torch
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.domains.driving import traffic
from ftl_lightning.domains.driving.foresight import VETOES, Beliefs, Worlds
from ftl_lightning.domains.driving.scenarios import SCENARIOS, advance, arrived, make, observe
from ftl_lightning.domains.driving.views import drive
from ftl_lightning.services.errors import require

DRIVE = 4  # columns of a drive
Seen = dict[str, NDArray[np.float32]]  # observed features by name


class DrivingEnvironment(gymnasium.Env[Seen, NDArray[np.float32]]):
    """Driving scenarios; scenario and seed determine the initial state.

    An observation is an initial state (37 numbers). An action is the desired state after the step (7 numbers), the desired drive
    (4,
    see :func:`~ftl_lightning.domains.driving.views.drive`) for policies that do not know the road, or the number of a decision (1).
    The planner selects the decisions of minimum risk (:mod:`ftl_lightning.domains.driving.foresight`) and takes the nearest to the
    action (Euclidean, raw units), at random among ties; it brakes if all crash. A numbered decision of higher risk is replaced by a
    random decision of minimum risk. The last step's info contains ``crashed``, ``arrived`` (at the destination without a crash),
    ``passed`` (criterion of the paper's code), ``return`` (sum of rewards) and ``length``.

    Args:
        veto: ``'belief'``, ``'simulation'`` or ``'step'`` (the paper's); another raises a ``UserError``.
    """

    simulation: AbstractEnv
    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (gymnasium's)
    render_mode = "rgb_array"
    observation_space: gymnasium.spaces.Space[Any] = gymnasium.spaces.Dict(
        {name: gymnasium.spaces.Box(-np.inf, np.inf, feature.shape, np.float32) for name, feature in traffic.FEATURES_SEEN.items()}
    )
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (traffic.STATE,), np.float32)

    def __init__(self, veto: str = traffic.BELIEF) -> None:
        require(veto in VETOES, "driving veto", f"one of {', '.join(VETOES)}", repr(veto))
        self.veto, self._name = veto, ""
        self._seed, self._return, self._length = 0, 0.0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Reset to the initial state of ``options['scene']``, 37 numbers, or of a random seed in the scenario ``options['task']``.

        Raises:
            UserError: for a scene that its scenario and seed do not reproduce.
        """
        super().reset(seed=seed)
        options = options or {}
        given = options.get("scene")
        if given is None:
            name, start = options.get("task", "roundabout"), int(self.np_random.integers(traffic.SEEDS))
        else:
            name, start = traffic.origin(np.asarray(given))
        if name != self._name:
            self.simulation, self._name = make(name), name
        super().reset(seed=start)  # for ties between decisions
        self.simulation.reset(seed=start)
        self._seed, self._return, self._length = start, 0.0, 0
        self._beliefs = Beliefs(self.simulation, name)
        observed = observe(self.simulation)
        same = given is None or np.allclose(traffic.scene(observed, name, start), given, atol=1e-3)
        expected = f"the initial state of {name!r} for seed {start}"
        require(same, "driving scene", expected, "another; an episode cannot start in the middle of a drive")
        return self.observation(), {}

    def observation(self) -> Seen:
        """Current observation."""
        number = np.array([traffic.NAMES.index(self._name)], dtype=np.float32)
        return {traffic.TRAFFIC: observe(self.simulation).reshape(traffic.OBSERVED).astype(np.float32), traffic.SCENARIO: number}

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Take a decision and simulate until the next."""
        wish = np.asarray(action, dtype=np.float64)
        numbers = wish.shape in ((traffic.STATE,), (DRIVE,), (1,)) and np.isfinite(wish).all()
        require(numbers, "driving action", f"{traffic.STATE} finite numbers, {DRIVE} or 1", wish.tolist())
        chosen = self.decide(wish)
        reward, ended = advance(self.simulation, chosen)
        self._return += reward
        self._length += 1
        info = self._outcome() if ended or self._length >= traffic.MAX_STEPS else {}
        return self.observation(), reward, ended, self._length >= traffic.MAX_STEPS, info

    def decide(self, wish: NDArray[np.float64]) -> int:
        """Return the decision of minimum risk nearest to an action, see the class; the simulation is left unchanged."""
        now = observe(self.simulation)[0].astype(np.float64)
        self._beliefs.look()
        rng = np.random.default_rng([self._seed, self._length])
        worlds = Worlds(self.simulation, VETOES[self.veto], self._beliefs, rng)
        if len(wish) == 1 and worlds.risk(int(wish[0])) == 0:
            return int(wish[0])
        states = {decision: worlds.state(decision) for decision in range(self.simulation.action_space.n)}
        there = {decision: state for decision, state in states.items() if state is not None}
        distances = self._far(now, np.stack(list(there.values())), wish) if there and len(wish) > 1 else np.zeros(len(there))
        risks: dict[int, float] = {}
        nearest = math.inf
        for decision, distance in sorted(zip(there, distances.tolist(), strict=True), key=lambda pair: pair[1]):
            if distance > nearest + 1e-6:  # a nearer decision has no risk
                break
            risks[decision] = worlds.risk(decision)
            nearest = distance if risks[decision] == 0 else nearest
        lowest = min(risks.values(), default=1)
        if lowest == 1:
            return int(self.simulation.action_type.actions_indexes["SLOWER"])
        candidates = [pair for pair in zip(there, distances, strict=True) if risks.get(pair[0]) == lowest]
        closest = min(distance for _, distance in candidates)
        if len(wish) == 1 and int(wish[0]) in dict(candidates):
            return int(wish[0])
        return int(self.np_random.choice([decision for decision, distance in candidates if distance <= closest + 1e-6]))

    @staticmethod
    def _far(now: NDArray[np.float64], states: NDArray[np.float64], wish: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances ``(decision,)`` of next states ``(decision, 7)`` after the present ``(7,)`` from the action."""
        if len(wish) == DRIVE:
            states = drive(torch.from_numpy(now).expand(len(states), -1), torch.from_numpy(states)).numpy()
        return np.asarray(np.linalg.norm(states - wish, axis=1))

    def _outcome(self) -> dict[str, float]:
        crashed, passed = bool(self.simulation.vehicle.crashed), SCENARIOS[self._name].passed
        there = arrived(self.simulation, self._name) and not crashed
        outcome = {"crashed": crashed, "arrived": there, "passed": passed(self.simulation) if passed else there}
        return outcome | {"return": self._return, "length": self._length}

    def render(self) -> NDArray[np.uint8]:
        """Top-view picture ``(height, width, 3)``."""
        return np.asarray(self.simulation.render(), dtype=np.uint8)

    def close(self) -> None:
        """Close the simulation."""
        if self._name:
            self.simulation.close()
