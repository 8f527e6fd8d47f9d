"""Effect of bfloat16 and of compilation on ``fit``: seconds of a step, seconds until the first step, and the loss.

    python benchmarks/speed/fit_options.py [--out results/fit_options.json]

Each configuration is fitted at its shipped size and batch for some steps, from the same seed, in one process with one thread; a
step's seconds are the median of those after the first :data:`WARM`. Compiling needs a C++ compiler, and happens before the first
step. Run it on cores that are idle.
"""

import argparse
import itertools
import json
import os
import platform
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from distributed import CONF, command, curve, run

from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

TIMED = {"object_rearrangement.yaml": 100, "agent.yaml": 60}
"""Steps of each configuration."""
OPTIONS = {
    "default": [],
    "bfloat16": ["--trainer.precision=bf16-mixed"],
    "compiled": ["--model.compile=true"],
    "bfloat16, compiled": ["--trainer.precision=bf16-mixed", "--model.compile=true"],
}
WARM, LAST = 10, 20
"""Steps that do not count; steps whose mean loss is told."""


def measured(config: Path, steps: int, options: list[str], folder: Path) -> dict[str, float]:
    """One fit."""
    start = time.time()
    run(command(config, folder, [f"--trainer.max_steps={steps}", f"--data.steps_per_epoch={steps}", *options]))
    points = [value for _, value in sorted(curve(folder).items())]
    times = [at for _, at in points]
    return {
        "seconds a step": round(statistics.median(later - at for at, later in itertools.pairwise(times[WARM:])), 5),
        "seconds until the first step is made": round(times[0] - start, 1),
        "loss at the end": round(statistics.mean(loss for loss, _ in points[-LAST:]), 5),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/fit_options.json")
    options = parser.parse_args()
    found: dict[str, Any] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "capability": torch.backends.cpu.get_cpu_capability(),
            "torch": torch.__version__,
            "threads": 1,
        },
        "load": round(os.getloadavg()[0], 2),
    }
    with tempfile.TemporaryDirectory() as name, bar("fits", len(TIMED) * len(OPTIONS)) as advance:
        for config, steps in TIMED.items():
            rows = {}
            for title, own in OPTIONS.items():
                rows[title] = measured(CONF / config, steps, own, Path(name) / config / title)
                rows[title]["times as fast"] = round(rows["default"]["seconds a step"] / rows[title]["seconds a step"], 2)
                print(config, title, rows[title], flush=True)
                advance()
            found[config] = rows
    write_text(Path(options.out), json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
