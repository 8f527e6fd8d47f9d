"""Pretrain the shipped model of strokes on ``ftl_lightning.apps.benchmark.strokes``, and judge it on new kinds.

``--pretrain FOLDER`` draws the strokes, runs ``fit`` with ``conf/own.yaml`` and puts the model there. Without it a model is
measured: each new kind is learned from five strokes, in each of :data:`WAYS` to learn, and fifty samples are judged by the nearest
of a hundred templates of each kind, which the method does not know. Spread, novelty and roughness are shares of those of fresh
strokes by the same hand; distance is that to the nearest template of the kind. Seconds are processor time of one thread.

    python benchmarks/making/strokes_model.py --pretrain pretrained/strokes
    python benchmarks/making/strokes_model.py --test --out results/strokes_model.json
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ftl_lightning.apps.benchmark.strokes import BACKWARDS, KNOWN, MIRRORED, RANDOM, TEST, VALIDATION, Judge, drawn
from ftl_lightning.cli.main import main as ftl_lightning
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.tensor_file import write_text

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
from forms import compared

ROOT = Path(__file__).parents[2]
EACH, VARIED, RANDOMS, STEPS = 200, 60, 1000, 4000
"""Strokes of each kind, those of it mirrored and of it backwards, those of no kind, and steps of pretraining."""
DENOISER = "{hidden_dim: 256, depth: 3, condition_dim: 256}"
"""Smaller than that of ``conf/own.yaml``: a step of learning takes less."""
FEW, SAMPLES = 5, 50
"""Strokes that are learned from, and judged."""
HANDS = {"many hands": 0.0, "one hand": 0.6}
"""How much alike the five strokes of a kind are, see :func:`ftl_lightning.apps.benchmark.strokes.drawn`."""
WAYS: dict[str, dict[str, Any]] = {
    "first look": {"form": "paper", "steps": 100, "samples": 16, "learning_rate": 0.3},
    "finished": {"form": "paper"},
    "modes": {"form": "modes"},
    "adapter": {"form": "adapter"},
    "chosen": {},
}
"""By name what is given to ``FewShot.learn``; where steps and samples are not named, those of ``conf/own.yaml``."""


def pretrain(folder: Path, seed: int) -> None:
    """Put a model into a folder that may hold its card."""
    folder.mkdir(parents=True, exist_ok=True)
    counts = dict.fromkeys(KNOWN, EACH) | {before + kind: VARIED for kind in KNOWN for before in (MIRRORED, BACKWARDS)}
    parts = {kind: drawn(kind, count, seed) for kind, count in (counts | {RANDOM: RANDOMS}).items()}
    options = ["--data.demonstrations=strokes.npz", "--data.encoder=hashing", f"--trainer.max_steps={STEPS}"]
    options += [f"--model.denoiser_args={DENOISER}", f"--seed_everything={seed}"]
    options += ["--data.metrics={nearest_shape: 1, recognised: 0.98}", "--trainer.limit_val_batches=0", "--trainer.accelerator=cpu"]
    with tempfile.TemporaryDirectory() as place:
        with chdir(place):
            np.savez(
                "strokes.npz",
                states=np.concatenate(list(parts.values())),
                concepts=np.repeat(list(parts), [len(part) for part in parts.values()]),
                state_names=["x", "y"],
                state_units=["cm", "cm"],
            )
            if ftl_lightning(["fit", "--config", str(ROOT / "conf" / "own.yaml"), "--model.output=pretrained", *options]):
                raise SystemExit("fit failed")
        for file in sorted((Path(place) / "pretrained").iterdir()):
            shutil.copyfile(file, folder / file.name)


def learned(model: FewShot, judge: Judge, kind: str, seed: int, alike: float, way: Mapping[str, Any]) -> dict[str, float]:
    """What samples of a kind are like that is learned from five strokes."""
    strokes = drawn(kind, FEW + SAMPLES, 1_000_000 + seed, alike)
    five, fresh = strokes[:FEW], strokes[FEW:]
    start = time.process_time()
    concept = model.learn(five, name=kind, seed=seed, **way)
    seconds = time.process_time() - start
    samples = model.sample(concept, SAMPLES, seed=seed).states.numpy()
    numbers = {"recognised": judge.rate(samples, kind), **compared(samples, five, fresh, np.ones(2, dtype=np.float32))}
    return numbers | {"distance": judge.distance(samples, kind) / judge.distance(fresh, kind), "seconds": seconds}


def summary(kinds: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Means over kinds and seeds, and the least rate and longest time."""
    rows = list(kinds.values())
    found = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    found |= {"least recognised": min(row["recognised"] for row in rows), "most seconds": max(row["seconds"] for row in rows)}
    return {name: round(value, 4) for name, value in found.items()}


def measured(model: FewShot, judge: Judge, kinds: Sequence[str], seeds: Sequence[int], ways: Sequence[str]) -> dict[str, Any]:
    """By way to learn and hand what samples of new kinds are like."""
    found: dict[str, Any] = {}
    for way in ways:
        for hand, alike in HANDS.items():
            each = {f"{kind}, {seed}": learned(model, judge, kind, seed, alike, WAYS[way]) for kind in kinds for seed in seeds}
            rates = {name: round(one["recognised"], 4) for name, one in each.items()}
            found.setdefault(way, {})[hand] = {**summary(each), "by kind": rates}
            print(f"{way}, {hand}: {summary(each)}", flush=True)
    return found


def evaluate(folder: str, seeds: Sequence[int], ways: Sequence[str], test: bool) -> dict[str, Any]:
    """All that is told of a model."""
    model, judge = FewShot.from_pretrained(folder), Judge.of()
    model.learn(drawn("square", FEW, 0), name="square", form="paper", steps=2)  # what is done once is no part of the seconds
    kinds = {kind: model.sample(model[kind] * 1.2, SAMPLES, seed=0).states.numpy() for kind in KNOWN}
    fresh = {kind: drawn(kind, SAMPLES, 2_000_000) for kind in judge.kinds}
    found = {
        "model": model.model.hash,
        "seeds": list(seeds),
        "ways": {way: WAYS[way] for way in ways},
        "fresh strokes": round(float(np.mean([judge.rate(strokes, kind) for kind, strokes in fresh.items()])), 4),
        "training kinds": round(float(np.mean([judge.rate(strokes, kind) for kind, strokes in kinds.items()])), 4),
        "validation": measured(model, judge, VALIDATION, seeds, ways),
    }
    return found | ({"test": measured(model, judge, TEST, seeds, ways)} if test else {})


def main() -> None:
    """Pretrain a model, or measure one; prints and writes the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrain", type=Path, help="folder to put a model into")
    parser.add_argument("--seed", type=int, default=0, help="of pretraining and its strokes")
    parser.add_argument("--model", default="strokes")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--test", action="store_true", help="measure the test kinds, too, on which nothing is chosen")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.pretrain:
        pretrain(options.pretrain, options.seed)
        return
    torch.set_num_threads(1)
    text = json.dumps(evaluate(options.model, options.seeds, options.ways, options.test), indent=2)
    print(text)
    if options.out:
        write_text(options.out, text + "\n")


if __name__ == "__main__":
    main()
