"""Closed-loop success in the validation scenario of driving by settings of the inversion.

    python benchmarks/experiments/driving/arrivals.py --learn '{"guidance_scale": 1.0, "tolerance": 0.03}'

Uses the three pretrained models of ``ablate --config conf/ablation/driving.yaml``, two sets of demonstrations for each model, and
six new starts for each set that no evaluation uses. Takes four minutes on one thread.
"""

import argparse
import json

import torch

from ftl_lightning import FewShot
from ftl_lightning.domains.driving.domain import DOMAIN

TASK = "roundabout third exit"
STARTS = 700
"""Seed of the starts of the first set of demonstrations."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", default="logs/ablation", help="folder of the pretrained models")
    parser.add_argument("--episodes", type=int, default=50, help="of each model and set of demonstrations")
    parser.add_argument("--learn", type=json.loads, default={}, help="changed settings of the inversion, JSON")
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = []
    for model in range(3):
        few = FewShot.from_pretrained(f"{options.models}/driving-steps{model}/pretrained")
        for seed in (model, model + 3):
            shown = DOMAIN.source(None).draw(TASK, 5, seed)
            concept = few.learn(shown, name=TASK, seed=seed, form="paper", **options.learn)
            episodes = few.execute(concept, few.starts(TASK, options.episodes, STARTS + seed), TASK, seed=seed)
            found.append(episodes.outcomes)
            told = ", ".join(f"{name} {found[-1][name]:.2f}" for name in ("strict success", "crash"))
            print(f"model {model}, demonstrations {seed}: {told}", flush=True)
    means = {name: sum(one[name] for one in found) / len(found) for name in ("strict success", "crash")}
    print(", ".join(f"{name} {value:.3f}" for name, value in means.items()))


if __name__ == "__main__":
    main()
