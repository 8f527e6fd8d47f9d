"""The expert: optimistic planning for deterministic systems (Hren and Munos, 2008) through the simulation itself."""

import heapq
import itertools
import math
from dataclasses import dataclass

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.domains.driving.scenarios import arrived, make, observe
from ftl_lightning.domains.driving.simulation import Snapshot, advance, restore, save


@dataclass(frozen=True)
class Search:
    """How far a scenario's search goes.

    Attributes:
        budget: simulated decisions for each that is made.
        gamma: discount; rewards are in [0, 1].
        frequency: Hz of the simulation while searching.
        hold: steps that each decision is kept while searching.
        sight: metres; vehicles farther away are left out while searching.
    """

    budget: int
    gamma: float
    frequency: int = 15
    hold: int = 1
    sight: float = math.inf


SEARCH = {
    "highway": Search(75, 0.7, sight=200),
    "exit": Search(200, 0.85, frequency=5, sight=120),
    "merge": Search(75, 0.7, frequency=5),
    "intersection": Search(75, 0.9, hold=2),
    "roundabout": Search(75, 0.9),
    "roundabout third exit": Search(75, 0.9),
}


def plan(env: AbstractEnv, name: str) -> int:
    """The action to take now; the environment is left as it was.

    A tree of action sequences is grown where an optimist would: a leaf's value is what it has earned and, from there on, the
    best there is, 1 a step. After the budget is spent the action with the best sequence so far, by what it has earned, is taken.
    """
    search = SEARCH[name]
    actual, frequency, vehicles = save(env), env.config["simulation_frequency"], env.road.vehicles
    env.config["simulation_frequency"] = search.frequency
    if search.sight < math.inf:
        ego = env.vehicle
        env.road.vehicles = [v for v in vehicles if v is ego or np.linalg.norm(v.position - ego.position) < search.sight]
    order = itertools.count()
    best, found = -math.inf, 1
    # Leaves by optimistic value: (-value, order, earned, depth, first action, state).
    leaves: list[tuple[float, int, float, int, int | None, Snapshot]] = [(0.0, next(order), 0.0, 0, None, save(env))]
    left = search.budget
    while leaves and left > 0:
        _, _, earned, depth, first, state = heapq.heappop(leaves)
        restore(env, state)
        for number, action in enumerate(env.get_available_actions()):
            if number:
                restore(env, state)
            left -= 1
            total, below, ended = earned, depth, False
            for _ in range(search.hold):
                reward, ended = advance(env, action)
                total += search.gamma**below * min(max(reward, 0.0), 1.0)
                below += 1
                if ended:
                    break
            future = search.gamma**below / (1 - search.gamma)
            if ended and arrived(env, name) and not env.vehicle.crashed:
                total += future  # it has arrived for good, or arriving would be worth nothing
            start = action if first is None else first
            if total > best:
                best, found = total, start
            if not ended:
                heapq.heappush(leaves, (-(total + future), next(order), total, below, start, save(env)))
    env.config["simulation_frequency"] = frequency
    restore(env, actual)
    return found


def drive(name: str, seed: int, env: AbstractEnv | None = None) -> tuple[NDArray[np.float32], bool]:
    """One episode of the expert.

    Args:
        name: of the scenario.
        seed: of the episode.
        env: of this scenario, if there is one already.

    Returns:
        Observations ``(time, 5, 7)``, and whether it succeeded: without a crash, and where the scenario wants it.
    """
    env = env or make(name)
    env.reset(seed=seed)
    seen, ended = [observe(env)], False
    while not ended:
        _, ended = advance(env, plan(env, name))
        seen.append(observe(env))
    return np.stack(seen), not env.vehicle.crashed and arrived(env, name)
