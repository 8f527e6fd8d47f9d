"""The expert: optimistic planning for deterministic systems (Hren and Munos, 2008) through the simulation itself."""

import heapq
import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.domains.driving.foresight import FRAMES, VETOES, Beliefs, Worlds, meaning
from ftl_lightning.domains.driving.scenarios import arrived, make, observe
from ftl_lightning.domains.driving.simulation import Snapshot, advance, restore, save
from ftl_lightning.domains.driving.traffic import BELIEF


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
    "roundabout of three lanes": Search(75, 0.9),
    "roundabout of one lane": Search(75, 0.9),
}

IDLE = 1


@dataclass(frozen=True)
class Blind:
    """How the expert searches that knows no more than what can be seen.

    Attributes:
        beliefs: worlds that it imagines at a decision.
        expansions: decisions that it simulates in each for every action there is.
        tolerated: risk that it takes: without any it waits until the time is up, since somebody may always come.
    """

    beliefs: int = 4
    expansions: int = 8
    tolerated: float = 1 / 8


BLIND = Blind()


def plan(env: AbstractEnv, name: str) -> int:
    """The action to take now; the environment is left as it was.

    A tree of action sequences is grown where an optimist would: a leaf's value is what it has earned and, from there on, the
    best there is, 1 a step. After the budget is spent the action with the best sequence so far, by what it has earned, is taken.
    """
    search = SEARCH[name]
    with _searching(env, search):
        values = _values(env, name, search, env.get_available_actions(), search.budget)
    return max(values, key=lambda action: values[action], default=IDLE)


def plan_blind(env: AbstractEnv, name: str, beliefs: Beliefs, rng: np.random.Generator) -> int:
    """The action to take now for one who sees no more than its pupils: the same search in imagined worlds, with the same veto.

    An action's value is the mean of what the best sequence after it earns in each. The best of tolerated risk is taken, or if there
    is none, the best of least.

    Args:
        env: left as it was.
        name: of the scenario.
        beliefs: what is known; they have looked.
        rng: draws worlds from them.
    """
    search, actual = SEARCH[name], save(env)
    actions = list({meaning(env, action): action for action in env.get_available_actions()[::-1]}.values())[::-1]
    totals = dict.fromkeys(actions, 0.0)
    with _searching(env, replace(search, frequency=FRAMES * env.config["policy_frequency"])):
        for _ in range(BLIND.beliefs):
            restore(env, actual)
            beliefs.draw(rng)
            for action in actions:
                totals[action] += _values(env, name, search, [action], BLIND.expansions * len(actions))[action]
    worlds = Worlds(env, VETOES[BELIEF], beliefs, rng)
    risks: dict[int, float] = {}
    for action in sorted(actions, key=lambda action: -totals[action]):
        risks[action] = worlds.risk(action)
        if risks[action] <= BLIND.tolerated:
            return action
    return min(risks, key=lambda action: risks[action])


@contextmanager
def _searching(env: AbstractEnv, search: Search) -> Iterator[None]:
    """As coarse as a search is; the environment is left as it was."""
    actual, frequency, vehicles = save(env), env.config["simulation_frequency"], env.road.vehicles
    env.config["simulation_frequency"] = search.frequency
    if search.sight < math.inf:
        ego = env.vehicle
        env.road.vehicles = [v for v in vehicles if v is ego or np.linalg.norm(v.position - ego.position) < search.sight]
    try:
        yield
    finally:
        env.config["simulation_frequency"] = frequency
        restore(env, actual)


def _values(env: AbstractEnv, name: str, search: Search, first_actions: Sequence[int], budget: int) -> dict[int, float]:
    """What the best sequence found after each action earns; none for actions after which nothing was tried."""
    order = itertools.count()
    root = save(env)
    found: dict[int, float] = {}
    # Leaves by optimistic value: (-value, order, earned, depth, first action, state).
    leaves: list[tuple[float, int, float, int, int | None, Snapshot]] = [(0.0, next(order), 0.0, 0, None, root)]
    left = budget
    while leaves and left > 0:
        _, _, earned, depth, first, state = heapq.heappop(leaves)
        restore(env, state)
        for number, action in enumerate(first_actions if first is None else env.get_available_actions()):
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
            if total > found.get(start, -math.inf):
                found.pop(start, None)  # of equals the one that was found first stands first
                found[start] = total
            if not ended:
                heapq.heappush(leaves, (-(total + future), next(order), total, below, start, save(env)))
    restore(env, root)
    return found


def drive(name: str, seed: int, env: AbstractEnv | None = None, blind: bool = False) -> tuple[NDArray[np.float32], bool]:
    """One episode of the expert.

    Args:
        name: of the scenario.
        seed: of the episode.
        env: of this scenario, if there is one already.
        blind: whether it knows no more than what can be seen.

    Returns:
        Observations ``(time, 5, 7)``, and whether it succeeded: without a crash, and where the scenario wants it.
    """
    env = env or make(name)
    env.reset(seed=seed)
    seen, ended = [observe(env)], False
    beliefs, rng = Beliefs(env, name), np.random.default_rng([seed, 1])
    while not ended:
        if blind:
            beliefs.look()
        _, ended = advance(env, plan_blind(env, name, beliefs, rng) if blind else plan(env, name))
        seen.append(observe(env))
    return np.stack(seen), not env.vehicle.crashed and arrived(env, name)
