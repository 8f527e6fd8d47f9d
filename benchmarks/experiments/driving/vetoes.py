"""Run time of driving episodes with each veto, following plans of a learned concept.

    python benchmarks/experiments/driving/vetoes.py [--out results/driving_vetoes.json]

A minute or two, on one thread.
"""

import argparse
import json
import time

import torch

from ftl_lightning import FewShot
from ftl_lightning.domains.driving.domain import DOMAIN
from ftl_lightning.domains.driving.foresight import VETOES
from ftl_lightning.domains.driving.traffic import BELIEF
from ftl_lightning.services.randomness import DEMONSTRATION_SEED
from ftl_lightning.services.tensor_file import write_text

TASK = "roundabout"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--out", help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    few = FewShot.from_pretrained("driving")
    concept = few.learn(DOMAIN.source(None).draw(TASK, 5, DEMONSTRATION_SEED), name=TASK, form="paper")
    starts = few.starts(TASK, options.episodes, 0)
    found = {}
    for veto in VETOES:
        begun = time.perf_counter()
        few.execute(concept, starts, replan=1, environment="" if veto == BELIEF else f"{veto} veto")
        found[veto] = round(time.perf_counter() - begun, 1)
        print(f"{options.episodes} episodes, {veto}: {found[veto]} s", flush=True)
    if options.out:
        write_text(options.out, json.dumps({"episodes": options.episodes, "seconds": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
