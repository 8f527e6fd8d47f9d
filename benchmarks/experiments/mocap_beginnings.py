"""Fit the Gaussian of recorded poses that initialises learning of human motion.

    python benchmarks/experiments/mocap_beginnings.py --root FOLDER --out ftl_lightning/domains/mocap/beginnings.safetensors

Poses are those of people who stand or walk with their arms down, from each trial of a training concept that is not held out. Trials
have equal weights.
"""

import argparse
import json
from pathlib import Path

import torch

from ftl_lightning.domains.mocap.skeleton import fit_poses
from ftl_lightning.domains.mocap.source import Recorded

EACH = 40
"""Poses of a trial at most, at equal distances."""
DIRECTIONS = 20
"""Principal directions; they hold 98 % of the variance."""


def main() -> None:
    """Fit and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder that prepare wrote")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    trials = Recorded(options.root).training_poses()
    poses = torch.cat([poses[:: max(1, len(poses) // EACH)] for poses in trials])
    fit_poses(poses, DIRECTIONS, options.out)
    spread = torch.linalg.svdvals(poses - poses.mean(dim=0)).square()
    held = float(spread[:DIRECTIONS].sum() / spread.sum())
    print(json.dumps({"trials": len(trials), "poses": len(poses), "variance held": round(held, 4)}))


if __name__ == "__main__":
    main()
