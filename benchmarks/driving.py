"""What a simulated decision of the expert costs: a deep copy and the published step, against save, restore and the faster step.

python benchmarks/driving.py [--out results/driving_speed.json]
"""

import argparse
import copy
import json
import time
from collections.abc import Callable
from pathlib import Path

from rich.progress import track

from ftl_lightning.domains.driving.scenarios import SCENARIOS, make
from ftl_lightning.domains.driving.simulation import advance, restore, save
from ftl_lightning.tensor_file import write_text

REPEATS = 20
IDLE = 1


def milliseconds(work: Callable[[], object]) -> float:
    """Of one call, the mean of some."""
    work()
    start = time.perf_counter()
    for _ in range(REPEATS):
        work()
    return 1000 * (time.perf_counter() - start) / REPEATS


def measure(name: str) -> dict[str, float]:
    """One scenario, both ways."""
    published, fast = make(name, fast=False), make(name)
    for env in (published, fast):
        env.reset(seed=0)
    now = save(fast)

    def ours() -> None:
        restore(fast, now)
        advance(fast, IDLE)
        save(fast)

    plain, quick = milliseconds(lambda: copy.deepcopy(published).step(IDLE)), milliseconds(ours)
    return {"deep copy and published step, ms": round(plain, 2), "ours, ms": round(quick, 2), "ratio": round(plain / quick, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/driving_speed.json")
    options = parser.parse_args()
    found = {name: measure(name) for name in track(SCENARIOS, "measuring")}
    write_text(Path(options.out), json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
