"""Run time of the driving expert with deep copies of the published simulation, and with exact save and restore.

python benchmarks/experiments/driving/simulation.py [--out results/driving_speed.json]

Both drive the same episode with the same search. A scenario takes a minute or two, mostly for the deep copies.
"""

import argparse
import copy
import json
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from rich.progress import track

from ftl_lightning.domains.driving import expert
from ftl_lightning.domains.driving.scenarios import SCENARIOS, advance, make, restore, save
from ftl_lightning.services.tensor_file import write_text

REPEATS = 20
IDLE = 1
SEED = 0


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """Of one call, the mean of some."""
    start = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - start) / repeats


def become(env: AbstractEnv, other: AbstractEnv) -> None:
    """What restoring is to a search that keeps whole environments."""
    env.__dict__ = copy.deepcopy(other).__dict__


def measure(name: str) -> dict[str, float | bool]:
    """One scenario, both ways."""
    published, fast = make(name, fast=False), make(name)
    for env in (published, fast):
        env.reset(seed=SEED)
    now = save(fast)

    def ours() -> None:
        restore(fast, now)
        advance(fast, IDLE)
        save(fast)

    def theirs() -> None:
        copy.deepcopy(published).step(IDLE)

    for work in (ours, theirs):
        work()
    decision = seconds(theirs, REPEATS), seconds(ours, REPEATS)
    driven = []
    quick = seconds(lambda: driven.append(expert.drive(name, SEED, fast)))
    with mock.patch.multiple(expert, save=copy.deepcopy, restore=become):
        plain = seconds(lambda: driven.append(expert.drive(name, SEED, published)))
    (one, _), (other, _) = driven
    return {
        "decision, deep copy and published step, ms": round(1000 * decision[0], 2),
        "decision, ours, ms": round(1000 * decision[1], 2),
        "episodes a minute, deep copies": round(60 / plain, 2),
        "episodes a minute, ours": round(60 / quick, 2),
        "ratio": round(plain / quick, 1),
        "the same episode": one.shape == other.shape and bool(np.allclose(one, other, atol=1e-6)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/driving_speed.json")
    options = parser.parse_args()
    found = {name: measure(name) for name in track(SCENARIOS, "measuring")}
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
