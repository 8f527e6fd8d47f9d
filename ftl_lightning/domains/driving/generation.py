"""Episodes of the expert, cached individually, so that an interrupted run resumes."""

import logging
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving import expert
from ftl_lightning.domains.driving.expert import SEARCH
from ftl_lightning.domains.driving.foresight import VETOES
from ftl_lightning.domains.driving.scenarios import SCENARIOS
from ftl_lightning.domains.driving.traffic import (
    BELIEF,
    FEATURES_SEEN,
    HORIZON,
    NAME,
    OBSERVED,
    SCENARIO,
    STATE,
    STATE_NAMES,
    STATE_UNITS,
    TRAFFIC,
    VEHICLES,
    decision_seconds,
    episode_seed,
    scene,
)
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import cache_folder, content_hash, load_tensors, save_tensors

_LOG = logging.getLogger(__name__)

KIND = "driving episode"
MOST = 4
"""Maximum number of episodes driven per kept episode."""


def shard(name: str, seed: int, blind: bool = False) -> Path:
    """Cache file of an episode."""
    belief = [expert.BLIND.__dict__, VETOES[BELIEF].__dict__] if blind else []
    key = content_hash([name, SCENARIOS[name].config, SEARCH[name].__dict__, *belief])
    return cache_folder() / f"{NAME}-{key}" / f"{seed}.safetensors"


def episode(name: str, seed: int, blind: bool = False) -> tuple[np.ndarray, bool]:
    """Observations ``(time, 5, 7)`` and success of an expert episode, from the cache if present.

    Outcomes by the scenario's rules are cached. If the simulation fails, the episode counts as rejected and is not cached.

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
        seen, succeeded = expert.drive(name, seed, blind=blind)
    except (MemoryError, OSError) as error:
        raise UserError(f"driving {name!r}, seed {seed}: the machine failed ({error!r}); run it again, it goes on here") from error
    except Exception as error:  # errors of the simulation: continue with further episodes
        _LOG.warning("driving %r, seed %d: %r; the episode counts as rejected and is not kept", name, seed, error)
        return np.zeros((1, VEHICLES, STATE), dtype=np.float32), False
    save_tensors(path, KIND, {"observations": torch.from_numpy(seen)}, {"succeeded": succeeded})
    return seen, succeeded


def driven_on(seen: np.ndarray, name: str, length: int) -> np.ndarray:
    """Extend observations ``(time, 5, 7)`` to ``length``: vehicles drive straight on after the end.

    Plans extend beyond the end of an episode, which ends when time is up or nothing is left to decide. Padding with standing
    vehicles would teach that episodes end with a stop.
    """
    times = decision_seconds(name) * np.arange(1, length - len(seen) + 1)[:, None, None]
    beyond = np.repeat(seen[-1:], len(times), axis=0)
    beyond[..., 1:3] += (times * beyond[..., 3:5]).astype(np.float32)
    return np.concatenate((seen, beyond))


def _made(job: tuple[str, int, bool]) -> tuple[np.ndarray, bool]:
    return episode(*job)


def _episodes(name: str, seeds: list[int], workers: int, blind: bool) -> Iterator[tuple[np.ndarray, bool]]:
    jobs = [(name, seed, blind) for seed in seeds]
    if workers == 1:
        yield from map(_made, jobs)
        return
    # Only this process handles Ctrl-C; it then ends the workers.
    with multiprocessing.get_context("spawn").Pool(workers, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        yield from pool.imap(_made, jobs)


def demonstrations(
    name: str, count: int, seed: int, workers: int, progress: Callable[[], None], blind: bool = False
) -> Demonstrations:
    """The first ``count`` successful episodes of a scenario in order of their seeds, for any number of workers.

    Args:
        name: name of the scenario.
        count: number of demonstrations.
        seed: seed of the episodes' seeds.
        workers: number of processes.
        progress: called after each successful episode.
        blind: whether the expert knows only observations.

    Raises:
        UserError: if too few episodes succeed.
    """
    kept: list[tuple[int, np.ndarray]] = []
    driven = 0
    seeds = [episode_seed(seed, number) for number in range(MOST * count)]
    for number, (seen, succeeded) in enumerate(_episodes(name, seeds, workers, blind)):
        driven = number + 1
        if succeeded:
            kept.append((seeds[number], seen))
            progress()
        if len(kept) == count:
            break
    else:
        raise UserError(f"driving {name!r}: expected {count} successful episodes of {driven}, found {len(kept)}")
    longest = max(len(seen) for _, seen in kept) + HORIZON
    seen = np.stack([driven_on(seen, name, longest) for _, seen in kept])
    traffic = torch.from_numpy(seen).float().flatten(2)
    scenes = torch.from_numpy(np.stack([scene(seen[0], name, start) for start, seen in kept]))
    return Demonstrations(
        states=traffic[..., :STATE].contiguous(),
        lengths=torch.tensor([len(seen) for _, seen in kept]),
        domain=NAME,
        state_names=STATE_NAMES,
        state_units=STATE_UNITS,
        concepts=(name,) * count,
        observed={TRAFFIC: traffic, SCENARIO: scenes[:, None, OBSERVED : OBSERVED + 1].repeat(1, longest, 1)},
        per_step=tuple(FEATURES_SEEN),
        scenes=scenes,
        provenance={
            "generator": NAME,
            "seed": seed,
            "count": count,
            "driven": driven,
            "rejected": driven - count,
            **({"expert": "blind"} if blind else {}),
        },
    )
