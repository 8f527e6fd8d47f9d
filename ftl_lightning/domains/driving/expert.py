"""Expert: optimistic planning of deterministic systems (Hren and Munos, 2008) in the simulation."""

import heapq
import itertools
import logging
import math
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from highway_env.envs.common.abstract import AbstractEnv
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving import traffic
from ftl_lightning.domains.driving.foresight import FRAMES, VETOES, Beliefs, Worlds, meaning
from ftl_lightning.domains.driving.scenarios import SCENARIOS, Snapshot, advance, arrived, imagined, make, observe, restore, save
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.tensor_file import cache_folder, content_hash, load_tensors, save_tensors

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Search:
    """Search settings of a scenario.

    Attributes:
        budget: simulated decisions per decision taken.
        gamma: discount; rewards are in [0, 1].
        frequency, hold: simulation frequency in Hz and steps per decision during search.
        sight: distance in metres; farther vehicles are ignored during search.
    """

    budget: int
    gamma: float
    frequency: int = 15
    hold: int = 1
    sight: float = math.inf


SEARCH = dict.fromkeys(traffic.NAMES, Search(75, 0.9)) | {
    "highway": Search(75, 0.7, sight=200),
    "exit": Search(200, 0.85, frequency=5, sight=120),
    "merge": Search(75, 0.7, frequency=5),
    "intersection": Search(75, 0.9, hold=2),
}

IDLE = 1


@dataclass(frozen=True)
class Blind:
    """Search settings of the blind expert, which knows only observations.

    Attributes:
        beliefs: sampled worlds per decision.
        expansions: simulated decisions per world and available action.
        tolerated: accepted risk; without any the expert waits until time is up, as a vehicle may always appear.
    """

    beliefs: int = 4
    expansions: int = 8
    tolerated: float = 1 / 8


BLIND = Blind()


def plan(env: AbstractEnv, name: str) -> int:
    """Return the next action; the environment is left unchanged.

    A tree of action sequences grows at the leaf of highest optimistic value, its discounted return plus the maximum future reward,
    until the budget is spent. The first action of the sequence with the highest return is taken.
    """
    search = SEARCH[name]
    with imagined(env, search.frequency):
        if search.sight < math.inf:
            ego = env.vehicle
            near = [v for v in env.road.vehicles if v is ego or np.linalg.norm(v.position - ego.position) < search.sight]
            env.road.vehicles = near
        values = _values(env, name, search, env.get_available_actions(), search.budget)
    return max(values, key=values.__getitem__, default=IDLE)


def plan_blind(env: AbstractEnv, name: str, beliefs: Beliefs, rng: np.random.Generator) -> int:
    """Return the next action of the blind expert, which searches sampled worlds; the environment is left unchanged.

    The value of an action is the mean return of its best sequence over the worlds. The best action of tolerated risk is taken, else
    the best action of minimum risk. Beliefs must be updated for this decision.
    """
    search = SEARCH[name]
    actions = list({meaning(env, action): action for action in env.get_available_actions()[::-1]}.values())[::-1]
    totals = dict.fromkeys(actions, 0.0)
    with imagined(env, FRAMES * env.config["policy_frequency"]) as actual:
        for _ in range(BLIND.beliefs):
            restore(env, actual)
            beliefs.draw(rng)
            for action in actions:
                totals[action] += _values(env, name, search, [action], BLIND.expansions * len(actions))[action]
    worlds = Worlds(env, VETOES[traffic.BELIEF], beliefs, rng)
    risks: dict[int, float] = {}
    for action in sorted(actions, key=lambda action: -totals[action]):
        risks[action] = worlds.risk(action)
        if risks[action] <= BLIND.tolerated:
            return action
    return min(risks, key=lambda action: risks[action])


def _values(env: AbstractEnv, name: str, search: Search, first_actions: Sequence[int], budget: int) -> dict[int, float]:
    """Return of the best sequence after each action; actions that were not expanded are missing."""
    order = itertools.count()
    root = save(env)
    returns: dict[int, float] = {}
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
                total += future  # otherwise arriving would be worth nothing
            start = action if first is None else first
            if total > returns.get(start, -math.inf):
                returns.pop(start, None)  # keep ties in order of discovery
                returns[start] = total
            if not ended:
                heapq.heappush(leaves, (-(total + future), next(order), total, below, start, save(env)))
    restore(env, root)
    return returns


def drive(name: str, seed: int, env: AbstractEnv | None = None, blind: bool = False) -> tuple[NDArray[np.float32], bool]:
    """Observations ``(time, 5, 7)`` of an episode of the expert, and success: at the destination without a crash."""
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


KIND = "driving episode"
MOST = 4  # episodes driven per kept episode


def shard(name: str, seed: int, blind: bool = False) -> Path:
    """Cache file of an episode."""
    belief = [BLIND.__dict__, VETOES[traffic.BELIEF].__dict__] if blind else []
    key = content_hash([name, SCENARIOS[name].config, SEARCH[name].__dict__, *belief])
    return cache_folder() / f"{traffic.NAME}-{key}" / f"{seed}.safetensors"


def episode(name: str, seed: int, blind: bool = False) -> tuple[np.ndarray, bool]:
    """Observations ``(time, 5, 7)`` and success of an expert episode, from the cache if present.

    An error of the simulation rejects the episode, which is not cached.

    Raises:
        UserError: if the machine fails, independently of the episode.
    """
    path = shard(name, seed, blind)
    if path.is_file():
        try:
            tensors, header = load_tensors(path, KIND)
            return tensors["observations"].numpy(), bool(header["succeeded"])
        except UserError:
            path.unlink()  # damaged: drive again
    try:
        seen, succeeded = drive(name, seed, blind=blind)
    except (MemoryError, OSError) as error:
        raise UserError(f"driving {name!r}, seed {seed}: the machine failed ({error!r}); run it again, it goes on here") from error
    except Exception as error:  # errors of the simulation: continue with further episodes
        _LOG.warning("driving %r, seed %d: %r; the episode counts as rejected and is not kept", name, seed, error)
        return np.zeros((1, traffic.VEHICLES, traffic.STATE), dtype=np.float32), False
    save_tensors(path, KIND, {"observations": torch.from_numpy(seen)}, {"succeeded": succeeded})
    return seen, succeeded


def driven_on(seen: np.ndarray, name: str, length: int) -> np.ndarray:
    """Extend observations ``(time, 5, 7)`` to ``length``, straight on: standing vehicles would teach that episodes end with a
    stop.
    """
    times = traffic.decision_seconds(name) * np.arange(1, length - len(seen) + 1)[:, None, None]
    beyond = np.repeat(seen[-1:], len(times), axis=0)
    beyond[..., 1:3] += (times * beyond[..., 3:5]).astype(np.float32)
    return np.concatenate((seen, beyond))


def _episodes(name: str, seeds: list[int], workers: int, blind: bool) -> Iterator[tuple[np.ndarray, bool]]:
    run = partial(episode, name, blind=blind)
    if workers == 1:
        yield from map(run, seeds)
        return  # below, only this process handles Ctrl-C; it then ends the workers
    with multiprocessing.get_context("spawn").Pool(workers, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        yield from pool.imap(run, seeds)


def demonstrations(
    name: str, count: int, seed: int, workers: int, progress: Callable[[], None], blind: bool = False
) -> Demonstrations:
    """The first ``count`` successful episodes of a scenario in order of their seeds; ``progress`` is called after each.

    Raises:
        UserError: if too few episodes succeed.
    """
    kept: list[tuple[int, np.ndarray]] = []
    driven = 0
    seeds = [traffic.episode_seed(seed, number) for number in range(MOST * count)]
    for driven, (states, succeeded) in enumerate(_episodes(name, seeds, workers, blind), start=1):
        if succeeded:
            kept.append((seeds[driven - 1], states))
            progress()
        if len(kept) == count:
            break
    require(len(kept) == count, f"driving {name!r}", f"{count} successful episodes of {driven}", len(kept))
    longest = max(len(states) for _, states in kept) + traffic.HORIZON
    states = np.stack([driven_on(states, name, longest) for _, states in kept])
    vehicles = torch.from_numpy(states).float().flatten(2)
    scenes = torch.from_numpy(np.stack([traffic.scene(states[0], name, start) for start, states in kept]))
    provenance = {"generator": traffic.NAME, "seed": seed, "count": count, "driven": driven, "rejected": driven - count}
    return Demonstrations(
        states=vehicles[..., : traffic.STATE].contiguous(),
        lengths=torch.tensor([len(states) for _, states in kept]),
        domain=traffic.NAME,
        state_names=traffic.STATE_NAMES,
        state_units=traffic.STATE_UNITS,
        concepts=(name,) * count,
        observed={traffic.TRAFFIC: vehicles, traffic.SCENARIO: scenes[:, None, [traffic.OBSERVED]].repeat(1, longest, 1)},
        per_step=tuple(traffic.FEATURES_SEEN),
        scenes=scenes,
        provenance=provenance | ({"expert": "blind"} if blind else {}),
    )
