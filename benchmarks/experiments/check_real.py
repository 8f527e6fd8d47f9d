"""The outlier and "these suffice" of ``check`` on ten sets of behaviour; no model is trained.

    python benchmarks/experiments/check_real.py --out results/check_real.json

The sets are those of ``real_data.py``. Six demonstrations of each training kind are known, as many as a model that was pretrained
on 60 of each holds out. Of five demonstrations of a new kind the last is exchanged for one of another, training or new kind.
Then the verdict on five is compared with the truth of warped demonstrations: the share of 100 that are right by the set's rule, or
the mean F1 of two classifiers that are trained on 50 of them. A table is written beside the results.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from real_data import FEW, FEW_SEED, FRESH_SEED, NAMES, REAL, RULE, RealSet, sets

from ftl_lightning.data.check import check
from ftl_lightning.data.demonstrations import concatenate
from ftl_lightning.data.enough import Enough, Outliers
from ftl_lightning.data.references import WARPED, Reference, Setting
from ftl_lightning.services.randomness import generator

KNOWN, OTHER, SHOWN = 6, 5000, 100
"""Known demonstrations of each training kind, seed offset of exchanged ones, and samples that a rule judges."""


def outlier(data: RealSet, score: Outliers, number: int) -> dict[str, bool]:
    """Whether the exchanged demonstration is named, another one is, and any of five good ones is."""
    draw, kind = np.random.default_rng(number), data.new[number % len(data.new)]
    others = [name for name in (data.new if number // len(data.new) % 2 else data.training) if name != kind]
    good = data.demonstrations(kind, FEW, FEW_SEED + number)
    other = data.demonstrations(str(draw.choice(others)), 1, FEW_SEED + OTHER + number)
    exchanged = concatenate([good.rows(range(FEW - 1)), replace(other, concepts=(kind,))])
    named = []
    for five in (exchanged, good):
        warned = {row for finding in check(five) if finding.severity != "note" for row in finding.rows}
        named.append(warned | {row for row in (score.outlier(five),) if row is not None})
    return {"named": FEW - 1 in named[0], "another": bool(named[0] - {FEW - 1}), "good": bool(named[1])}


def enough(data: RealSet, kind: str, draw: int) -> dict[str, object]:
    """The verdict on five, and the truth of warped demonstrations."""
    training, five = data.pretraining(KNOWN), data.demonstrations(kind, FEW, FEW_SEED + draw)
    horizon, count = int(training.lengths.max()), SHOWN if data.judge == RULE else REAL
    verdict = Enough.of(five, horizon, training)
    fresh = data.demonstrations(kind, count, FRESH_SEED + draw)
    warped = Reference.of(WARPED, five, Setting.of(training, horizon), horizon)
    paths = warped.sample(fresh.initial_states.observed, count, generator("cpu", draw))
    samples = data.of(list(paths.double().numpy()), {name: some.numpy() for name, some in fresh.observed.items()}, kind)
    assert verdict is not None
    truth = round(data.right(kind, samples, seed=draw), 4)
    return {"kind": kind, "suffices": verdict.suffices, "more": verdict.more, "skill": round(verdict.last, 4), "truth": truth}


def main() -> None:
    """Measure the sets and write results and table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=list(NAMES))
    parser.add_argument("--number", type=int, default=24, help="sets of five of each set")
    parser.add_argument("--out", type=Path, default=Path("results/check_real.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    found, lines = (
        {},
        ["| set | exchanged one named | another one named | good set | suffices | truth |", "|---|---|---|---|---|---|"],
    )
    for name, data in sets(options.sets).items():
        training = data.pretraining(KNOWN)
        score = Outliers(training, int(training.lengths.max()))
        trials = [outlier(data, score, number) for number in range(options.number)]
        shares = {key: round(float(np.mean([trial[key] for trial in trials])), 4) for key in trials[0]}
        verdicts = [enough(data, kind, draw) for kind in data.new[:2] for draw in range(2)]
        found[name] = {"outlier": shares, "enough": verdicts}
        share, truth = (float(np.mean([row[key] for row in verdicts])) for key in ("suffices", "truth"))
        lines.append(f"| {name} | {' | '.join(f'{value:.2f}' for value in (*shares.values(), share, truth))} |")
        print(lines[-1], flush=True)
    options.out.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    options.out.with_suffix(".md").write_text("\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    main()
