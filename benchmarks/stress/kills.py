"""Test that checkpoints survive kills and a full disk, and that training resumes from them.

    python benchmarks/stress/kills.py --folder FOLDER --count 20

Training that writes a checkpoint each step runs in FOLDER, better on another file system than the folder for temporary files, and
is stopped ``count`` times: in turn by SIGKILL at a random moment, and by a limit on the size of files that cuts one off as a full
disk does. After each, every checkpoint under a final name is read, its checksums included, and training goes on from ``last``.
"""

import argparse
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import visible
from ftl_lightning.training.checkpoint import read_checkpoint

FIT = [
    "fit",
    "--config",
    str(Path(__file__).parents[2] / "conf" / "object_rearrangement.yaml"),
    "--model.denoiser_args={hidden_dim: 256, depth: 2, condition_dim: 16}",
    "--data.samples_per_concept=50",
    "--data.batch_size=8",
    "--trainer.max_steps=100000",
    "--trainer.limit_val_batches=0",
    "--trainer.accelerator=cpu",
    "--trainer.callbacks.init_args.every_n_train_steps=1",
]
CHECKPOINTS = Path("logs", "object_rearrangement", "fit", "checkpoints")
WAIT = 120.0
"""Seconds for the first checkpoint."""


def stopped(folder: Path, again: bool, full: bool, draw: random.Random) -> tuple[str, int]:
    """Train until a kill or a file that is cut off; what the program said last, and its exit code."""
    last = folder / CHECKPOINTS / "last.ckpt"
    before = last.stat().st_mtime_ns if last.is_file() else 0
    command = [sys.executable, "-m", "ftl_lightning", *FIT, *(["--ckpt_path=last"] if again else [])]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, cwd=folder, env=environment, stderr=said, stdout=said)
        deadline = time.monotonic() + WAIT
        while process.poll() is None and time.monotonic() < deadline:
            if last.is_file() and last.stat().st_mtime_ns != before:
                break
            time.sleep(0.05)
        if full and process.poll() is None and last.is_file():
            cut = draw.randrange(1, last.stat().st_size)
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (cut, cut))
        else:
            time.sleep(draw.uniform(0, 1))
            process.send_signal(signal.SIGKILL)
        code = process.wait(WAIT)
        said.seek(0)
        return said.read().strip().rpartition("\n")[2], code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", required=True, help="where checkpoints are written; new")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    folder, draw, bad, reached = Path(options.folder), random.Random(options.seed), 0, 0
    folder.mkdir(parents=True)
    with bar("stopped", options.count) as advance:
        for number in range(options.count):
            full = number % 2 == 1
            line, code = stopped(folder, number > 0, full, draw)
            # Raises for one that is not whole.
            steps = {path.name: read_checkpoint(path)["global_step"] for path in visible(folder / CHECKPOINTS, "*.ckpt")}
            asked = code == 2 and "File too large" in line if full else code == -signal.SIGKILL
            before, reached = reached, steps.get("last.ckpt", 0)
            bad += not asked or reached <= before  # else it had gone on from the last one
            print(f"{number}: {f'cut off, {line!r}' if full else 'killed'}, exit code {code}, steps {steps}", flush=True)
            advance()
    print(f"{options.count - bad} of {options.count} left whole checkpoints and ended as expected")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
