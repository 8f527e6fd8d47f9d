"""What starting costs: seconds, modules and the largest packages of each verb, alone on a quiet machine.

    python benchmarks/imports.py [--runs 5] [--out results/imports.json]

Each verb runs in a process of its own, after one that fills the caches and is not counted; the median of the runs counts. *Help* is
all that ``VERB --help`` takes. *Imports* are what Python spends in importing modules on the way to the first step of learning, or
to the end of verbs that have none, with ``-X importtime``; *start* are the seconds from the start of the process until then. Of the
packages, seconds are of their own modules, without what these import of others.
"""

import argparse
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from ftl_lightning.cli import COMMANDS, TRAINER_VERBS
from ftl_lightning.tensor_file import write_text

ROOT = Path(__file__).parent.parent
MODEL, GOAL = "object_rearrangement", "square diagonal to triangle"
SMALL = ["--config=conf/object_rearrangement.yaml", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
FIT = [
    "--model.denoiser_args={hidden_dim: 64, depth: 2, condition_dim: 32}",
    "--data.samples_per_concept=50",
    "--data.validation_per_concept=4",
]
VERBS = {
    "fit": ["fit", *SMALL, *FIT],
    "invert": ["invert", *SMALL, "--data.demonstrations=five.npz", f"--model.pretrained={MODEL}"],
    "invert MODEL FILE": ["invert", MODEL, "five.npz"],
    "generate": ["generate", MODEL, "--task", GOAL, "--count", "5", "--out", "other.npz"],
    "check": ["check", "five.npz"],
    "sample": ["sample", "--pretrained", MODEL, "--compose", "circle above square", "--count", "1"],
    "concepts": ["concepts", MODEL],
}
"""Those whose start is measured, as they are run."""
LARGEST = 8
"""Packages that are told of each verb."""
TO_FIRST_STEP = """
import sys, time
from ftl_lightning import cli
class Begun(Exception):
    pass
def begin(*arguments, **options):
    raise Begun
from ftl_lightning.learning import adam
class FirstStep:  # of whatever learns: the first that asks for an optimiser's step
    pass
{patch}
try:
    code = cli.main({arguments!r})
except Begun:
    code = 0
print(time.time(), len(sys.modules), file=sys.stderr)
sys.exit(code)
"""
