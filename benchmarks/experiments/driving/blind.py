"""Record drives of an expert that is limited to observable information, in all training scenarios.

    python benchmarks/experiments/driving/blind.py --out logs/blind --count 110
    python -m ftl_lightning fit --config conf/driving.yaml --data.root logs/blind --model.output logs/blind/pretrained

Each episode is saved when it ends, so an interrupted run resumes. A drive takes three seconds (highway) to fifteen
(intersection).
"""

import argparse
from pathlib import Path

from ftl_lightning.domains.driving.domain import Expert
from ftl_lightning.domains.driving.traffic import TRAINING_CONCEPTS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", required=True, help="folder; a file for each scenario")
    parser.add_argument("--count", type=int, default=110, help="drives of each that arrive; the last ten are for validation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--tasks", nargs="+", default=TRAINING_CONCEPTS)
    options = parser.parse_args()
    for task in options.tasks:
        drives = Expert(blind=True).draw(task, options.count, options.seed, options.workers)
        drives.save(Path(options.out) / f"{task}.safetensors")
        print(f"{task}: {options.count} of {drives.provenance['driven']} drives arrived")


if __name__ == "__main__":
    main()
