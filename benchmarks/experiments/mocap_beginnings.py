"""The distribution of poses that learning of human motion starts from: a Gaussian of recorded poses.

    python benchmarks/experiments/mocap_beginnings.py --root FOLDER --out ftl_lightning/domains/mocap/beginnings.safetensors

Of each trial of a training concept that is not held out, poses of people who stand or walk with their arms down; each trial counts
as much as the others.
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
