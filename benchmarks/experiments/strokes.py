"""Few-shot learning of pen strokes, data without any tuning, by the command line alone: three kinds from five strokes each.

For each text encoder and seed, ``fit`` pretrains on eight kinds with ``conf/own.yaml``, ``invert`` learns three kinds with the same
configuration, and fifty strokes of every kind are sampled. A rule unknown to the method, the nearest of sixty templates of each of
eleven kinds, classifies them. Spread, novelty and roughness of the new kinds are relative to those of fresh strokes. Reference
lines are fresh strokes of the generator and unconditional samples.

    python benchmarks/experiments/strokes.py --out results/strokes.json
"""

import argparse
import json
import tempfile
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
from forms import compared

from ftl_lightning.apps.benchmark.strokes import NEW, TRAINING, recognised, strokes
from ftl_lightning.cli.main import main as ftl_lightning
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.concept import file_name
from ftl_lightning.services.tensor_file import write_text

ROOT = Path(__file__).parents[2]
SAMPLES, FEW, PRETRAINING = 50, 5, 100
"""Strokes that are judged, learned from, and pretrained on, of each kind."""
LOOKS = "new kinds, looks"
MODEL, FIVE = "logs/own/fit/pretrained", "--data.demonstrations=five.npz"


def _write(path: str, kinds: tuple[str, ...], count: int, seed: int) -> None:
    states = np.concatenate([strokes(kind, count, seed) for kind in kinds])
    np.savez(path, states=states, concepts=np.repeat(kinds, count))


def _rate(kind: str, states: np.ndarray) -> float:
    return float(np.mean([found == kind for found in recognised(states)]))


def run(seed: int, encoder: str) -> dict[str, dict[str, Any]]:
    """Rates in which each kind is recognised, by what generated it, and what new kinds look like; in the current folder."""
    _write("strokes.npz", TRAINING, PRETRAINING, seed)
    _write("five.npz", NEW, FEW, 1_000_000 + seed)
    common = [f"--seed_everything={seed}", "--trainer.accelerator=cpu"]
    for verb, *own in (("fit", "--data.demonstrations=strokes.npz", f"--data.encoder={encoder}"), ("invert", FIVE)):
        if ftl_lightning([verb, "--config", str(ROOT / "conf" / "own.yaml"), *own, *common]):
            raise SystemExit(f"{verb} failed")
    model = FewShot.from_pretrained(MODEL)
    learned = {kind: model.load(f"logs/own/invert/concepts/{file_name(kind)}.safetensors") for kind in NEW}
    drawn = {kind: model.sample(model[kind] * 1.2, SAMPLES, seed=seed).states.numpy() for kind in TRAINING}
    drawn |= {kind: model.sample(concept, SAMPLES, seed=seed).states.numpy() for kind, concept in learned.items()}
    looks = {}
    for kind in NEW:
        known, fresh = strokes(kind, FEW, 1_000_000 + seed), strokes(kind, SAMPLES, 2_000_000 + seed)
        numbers = {key: round(value, 4) for key, value in compared(drawn[kind], known, fresh, np.ones(2, dtype=np.float32)).items()}
        looks[kind] = {"form": learned[kind].concept.choice.form, **numbers}  # type: ignore[union-attr]
    empty = model.sample(model[TRAINING[0]] * 0.0, SAMPLES, seed=seed).states.numpy()
    return {
        "training kinds": {kind: _rate(kind, drawn[kind]) for kind in TRAINING},
        "new kinds": {kind: _rate(kind, drawn[kind]) for kind in NEW},
        "new kinds, empty concept": {kind: _rate(kind, empty) for kind in NEW},
        LOOKS: looks,
        "fresh strokes": {kind: _rate(kind, strokes(kind, SAMPLES, 2_000_000 + seed)) for kind in (*TRAINING, *NEW)},
    }


def main() -> None:
    """Three seeds of both encoders; prints and writes the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--encoders", nargs="+", default=["hashing", "minilm"], help="minilm needs: make minilm")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    out = options.out and options.out.absolute()
    found: dict[str, dict[str, Any]] = {}
    for encoder in options.encoders:
        seeds = {}
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder, chdir(folder):
                seeds[f"seed {seed}"] = run(seed, encoder)
        found[encoder] = {"recognised": _means(seeds), "looks": _looks(seeds), "by kind": seeds}
    text = json.dumps(found, indent=2)
    print(text)
    if out:
        write_text(out, text + "\n")


def _means(seeds: dict[str, dict[str, Any]]) -> dict[str, float]:
    names = [name for name in next(iter(seeds.values())) if name != LOOKS]
    return {name: round(float(np.mean([list(one[name].values()) for one in seeds.values()])), 4) for name in names}


def _looks(seeds: dict[str, dict[str, Any]]) -> dict[str, float]:
    every = [kind for one in seeds.values() for kind in one[LOOKS].values()]
    return {name: round(float(np.mean([kind[name] for kind in every])), 4) for name in every[0] if name != "form"}


if __name__ == "__main__":
    main()
