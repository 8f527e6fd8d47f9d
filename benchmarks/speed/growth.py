"""How seconds and memory grow with data, concepts, plans and sizes, over four decades or until a limit.

    python benchmarks/speed/growth.py [--only plans K] [--limit 120] [--out results/growth.json]

Each measurement has its own process, with one thread: processor seconds of the work alone, and the megabytes that it adds to the
most memory of the process. A series ends when the next value would take longer than ``--limit`` seconds at the growth seen so far,
or more memory than :data:`MOST_MEMORY`, or is refused; the table says why. The exponent is the slope of seconds over the last
decade in logarithms: 1 is proportional. Learning takes :data:`STEPS` steps in the paper's form. What was measured is kept, and a
run that is started again goes on from there.
"""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from ftl_lightning.services.tensor_file import write_text

STEPS, DEMONSTRATIONS, MOST_MEMORY = 50, 5, 6_000
"""Gradient steps of learning, demonstrations of a concept, and megabytes beyond which no larger value is tried."""
NOISE = 0.05
"""Seconds below which the exponent says nothing."""


def strokes(count: int) -> np.ndarray:
    """Strokes of a kind that the shipped model does not know ``(count, 128, 2)``."""
    from ftl_lightning.apps.benchmark.strokes import strokes

    return strokes("heart", count, 1)


def shipped() -> Any:
    """The shipped model of strokes."""
    from ftl_lightning.few_shot.learner import FewShot

    return FewShot.from_pretrained("strokes")


def learned(count: int, steps: int = STEPS, **options: int) -> Callable[[], object]:
    """Learn one concept from ``count`` strokes."""
    model, states = shipped(), strokes(count)
    return lambda: model.learn(list(states), steps=steps, form="paper", **options)


def together(count: int) -> Callable[[], object]:
    """Learn ``count`` concepts in one call."""
    model = shipped()
    drawn = model.demonstrations(list(strokes(DEMONSTRATIONS))).rows([*range(DEMONSTRATIONS)] * count)
    given = replace(drawn, concepts=tuple(f"concept {row // DEMONSTRATIONS}" for row in range(len(drawn.concepts))))
    return lambda: model.learn_all(given, steps=STEPS, form="paper")


def sampled(count: int) -> Callable[[], object]:
    """Sample ``count`` plans of a training concept."""
    model = shipped()
    concept = model[model.training_concepts[0]]
    return lambda: model.sample(concept, count=count)


def own(columns: int, horizon: int) -> Callable[[], object]:
    """Pretrain :data:`STEPS` steps on random walks, ten of each of two kinds."""
    from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule
    from ftl_lightning.training.data import OwnData
    from ftl_lightning.training.trainer import Trainer

    folder = Path(tempfile.mkdtemp())
    walks = np.random.default_rng(0).standard_normal((20, horizon, columns), dtype=np.float32).cumsum(axis=1)
    np.savez(folder / "walks.npz", states=walks, concepts=np.repeat(("left", "right"), 10))

    def work() -> None:
        data = OwnData(str(folder / "walks.npz"), metrics={}, check=False, encoder="hashing", batch_size=32, horizon=horizon)
        network = {"hidden_dim": 256, "depth": 4, "condition_dim": 384}
        module = PretrainingModule(denoiser_args=network, prediction="cosines", output=str(folder / "model"))
        quiet = {"logger": False, "enable_progress_bar": False, "enable_checkpointing": False}
        Trainer(max_steps=STEPS, accelerator="cpu", **quiet).fit(module, datamodule=data)

    return work


SERIES: dict[str, tuple[str, Callable[[int], Callable[[], object]], tuple[int, ...]]] = {
    "demonstrations": ("learn a concept", learned, (5, 50, 500, 5_000, 50_000)),
    "steps": ("learn a concept", lambda value: learned(DEMONSTRATIONS, steps=value), (1, 10, 100, 1_000, 10_000)),
    "K": ("learn a concept", lambda value: learned(DEMONSTRATIONS, components=value), (1, 10, 100, 1_000)),
    "restarts": ("learn a concept", lambda value: learned(DEMONSTRATIONS, restarts=value), (1, 10, 100, 1_000)),
    "concepts": ("learn concepts together", together, (1, 10, 100, 1_000, 10_000)),
    "plans": ("sample", sampled, (1, 10, 100, 1_000, 10_000, 100_000)),
    "columns": ("pretrain", lambda value: own(value, 64), (2, 20, 200, 2_000, 20_000)),
    "horizon": ("pretrain", lambda value: own(2, value), (8, 80, 800, 8_000, 80_000)),
}
"""What is varied: the work, the work for a value, and the values."""


def measured(name: str, value: int) -> dict[str, float]:
    """Do the work once in this process."""
    torch.set_num_threads(1)
    work = SERIES[name][1](value)
    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    work()
    return {
        "seconds": round(time.process_time() - begin, 3),
        "megabytes": round((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024),
    }


def in_process(name: str, value: int) -> dict[str, Any]:
    """Do the work in a process of its own; the last line of its error if it fails."""
    command = [sys.executable, __file__, "--measure", name, str(value)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False)
    if done.returncode:
        error = (done.stderr.strip().splitlines() or ["killed"])[-1]
        return {"value": value, "refused": error.rpartition("UserError: ")[2][:200]}
    return {"value": value, **json.loads(done.stdout.splitlines()[-1])}


def slope(rows: list[dict[str, Any]]) -> float | None:
    """Exponent of seconds over the last decade that was measured, ``None`` for too little time."""
    if len(rows) < 2 or rows[-1]["seconds"] < NOISE:
        return None
    last, before = rows[-1], rows[-2]
    return math.log(last["seconds"] / max(before["seconds"], 1e-3)) / math.log(last["value"] / before["value"])


def end(rows: list[dict[str, Any]], following: int, limit: float) -> str:
    """Reason to stop before the next value; empty to go on."""
    growth = following / rows[-1]["value"]
    if rows[-1]["seconds"] * growth ** max(slope(rows) or 0, 0) > limit:
        return f"next longer than {limit:g} s"
    grown = rows[-1]["megabytes"] - rows[-2]["megabytes"] if len(rows) > 1 else 0
    return f"next more than {MOST_MEMORY:,} MB" if grown * growth > MOST_MEMORY else ""


def table(series: dict[str, dict[str, Any]]) -> str:
    """Markdown of all series."""
    lines = ["| varied | work | values | seconds | MB added | exponent | end |", "|---|---|---|---|---|---|---|"]
    for name, found in series.items():
        rows = [row for row in found["rows"] if "seconds" in row]
        values, seconds, memory = (" / ".join(f"{row[key]:,g}" for row in rows) for key in ("value", "seconds", "megabytes"))
        exponent = slope(rows)
        shown = "" if exponent is None else f"{exponent:.2f}"
        lines.append(f"| {name} | {SERIES[name][0]} | {values} | {seconds} | {memory} | {shown} | {found['end']} |")
    return "\n".join(lines) + "\n"


def figure(series: dict[str, dict[str, Any]]) -> Figure:
    """Seconds and megabytes of all series over the value that varies, relative to its smallest."""
    drawn = Figure(figsize=(9.5, 4.2), layout="constrained")
    panels = drawn.subplots(1, 2)
    for panel, key in zip(panels, ("seconds", "megabytes"), strict=True):
        for name, found in series.items():
            rows = found["rows"]
            panel.loglog([row["value"] / rows[0]["value"] for row in rows], [row[key] for row in rows], "o-", label=name)
        panel.set(xlabel="value, in multiples of the smallest", ylabel="processor seconds" if key == "seconds" else "MB added")
    drawn.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper")
    return drawn


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=SERIES, default=list(SERIES))
    parser.add_argument("--limit", type=float, default=120.0)
    parser.add_argument("--out", type=Path, default=Path("results/growth.json"))
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.measure:
        name, value = chosen.measure
        print(json.dumps(measured(name, int(value))))
        return
    found = json.loads(chosen.out.read_text(encoding="utf-8")) if chosen.out.exists() else {}
    for name in chosen.only:
        rows: list[dict[str, Any]] = found.get(name, {}).get("rows", [])
        reason = ""
        for value in SERIES[name][2][len(rows) :]:
            reason = end(rows, value, chosen.limit) if rows else ""
            if reason:
                break
            row = in_process(name, value)
            print(name, row, flush=True)
            reason = row.get("refused", "")
            if reason:
                break
            rows.append(row)
            found[name] = {"rows": rows, "end": reason}
            write_text(chosen.out, json.dumps(found, indent=1) + "\n")
        found[name] = {"rows": rows, "end": reason}
    write_text(chosen.out, json.dumps(found, indent=1) + "\n")
    known = {name: found[name] for name in SERIES if name in found}
    write_text(chosen.out.with_suffix(".md"), table(known))
    figure(known).savefig(chosen.out.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
