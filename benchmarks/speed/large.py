"""Seconds and memory of pretraining on a folder of files, from 10^5 to 10^8 recorded steps of 16 columns.

    python benchmarks/speed/large.py [--decades 5 6 7 8] [--steps 300] [--folder FOLDER] [--out results/large.json]

Seconds are of the processor. Each size is pretrained in its own process, with one thread: ``fit --config conf/own.yaml`` on windows
of 64 steps of random walks, in files of 2 * 10^5 steps or of a tenth of all. The files are removed afterwards; 10^8 steps need
6.4 GB.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from ftl_lightning.services.tensor_file import write_text

COLUMNS, EACH, TEXTS, HORIZON = 16, 1_000, ("left", "right"), 64
MOST = 200
"""Demonstrations of a file, at most."""
TABLE = Path("results/large.md")


def write(folder: Path, steps: int) -> int:
    """Write files of random walks, and return their bytes."""
    each = min(MOST, max(len(TEXTS) * 2, steps // EACH // 10))
    for number in range(steps // EACH // each):
        walks = np.random.default_rng(number).standard_normal((each, EACH, COLUMNS), dtype=np.float32).cumsum(axis=1)
        np.savez(folder / f"{number:05d}.npz", states=walks, concepts=np.resize(TEXTS, each))
    return sum(path.stat().st_size for path in folder.glob("*.npz"))


def fitted(folder: str, steps: int, model: str) -> dict[str, float]:
    """Pretrain in this process: seconds until the first step and for a later step, and most memory."""
    torch.set_num_threads(1)
    from lightning.pytorch import Callback

    from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
    from ftl_lightning.training.data import OwnData
    from ftl_lightning.training.trainer import Trainer

    times: list[float] = []

    class Clock(Callback):
        def on_train_batch_end(self, *_: object) -> None:
            times.append(time.process_time())

    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    data = OwnData(folder, metrics={}, check=False, encoder="hashing", horizon=HORIZON)
    network = {"hidden_dim": 256, "depth": 4, "condition_dim": 384}
    module = PretrainingModule(denoiser_args=network, prediction="cosines", output=model)
    trainer = Trainer(
        max_steps=steps, accelerator="cpu", logger=False, callbacks=[Clock()], enable_progress_bar=False, enable_checkpointing=False
    )
    trainer.fit(module, datamodule=data)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    each = (times[-1] - times[0]) / (len(times) - 1)
    return {"first": times[0] - begin, "step": each, "before": before / 1024, "most": most / 1024}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--decades", type=int, nargs="*", default=[5, 6, 7, 8])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--folder", type=Path, help="where files are written; default: a temporary folder")
    parser.add_argument("--out", type=Path, default=Path("results/large.json"))
    parser.add_argument("--fit", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.fit:
        folder, model = chosen.fit
        print(json.dumps(fitted(folder, chosen.steps, model)))
        return
    rows = []
    for decade in chosen.decades:
        with tempfile.TemporaryDirectory(dir=chosen.folder) as place:
            data = Path(place) / "data"
            data.mkdir()
            size = write(data, 10**decade)
            command = [sys.executable, __file__, "--steps", str(chosen.steps), "--fit", str(data), f"{place}/model"]
            output = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=os.environ | {"OMP_NUM_THREADS": "1"}).stdout
            files = len([*data.glob("*.npz")])
        measured = json.loads(output.decode().splitlines()[-1])
        numbers = {name: round(value, 4 if name == "step" else 1) for name, value in measured.items()}
        rows.append({"recorded steps": 10**decade, "files": files, "megabytes": round(size / 1e6, 1), **numbers})
        print(rows[-1], flush=True)
    write_text(chosen.out, json.dumps({"training steps": chosen.steps, "rows": rows}, indent=1) + "\n")
    head = "| recorded steps | files | their size | to the first training step | a training step | memory |"
    lines = [
        f"| {row['recorded steps']:,} | {row['files']} | {row['megabytes']:,.0f} MB | {row['first']:.1f} s"
        f" | {1000 * row['step']:.1f} ms | {row['most']:,.0f} MB |"
        for row in rows
    ]
    write_text(TABLE, "\n".join([head, "|---|---|---|---|---|---|", *lines]) + "\n")


if __name__ == "__main__":
    main()
