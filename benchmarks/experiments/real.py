"""Forms of concepts on ten sets of behaviour: the form that skill chooses, beside what a rule or classifiers say of its samples.

    python benchmarks/experiments/real.py --models logs/real --out results/real.json

The sets are those of ``real_data.py``. A model of each is pretrained with ``conf/own.yaml`` on 60 demonstrations of each kind,
unless it is in ``--models``. Then each new kind is learned from five demonstrations with default settings. The *truth* is the share
of 100 new samples that are right by the set's rule, or the mean F1 of two classifiers that are trained on 50 samples and tested on
real behaviour. It is measured for the chosen form, for other forms, two of which need no learning, and for worse ones: the paper's
form, learning that stops early, and the best training concept alone. Its rank correlation with what the program prints of a form
(skill and share of nearer samples, from left-out demonstrations) is measured. The *score* is the energy score on fresh behaviour,
lower is better. *Copies*: share of samples that are nearer to one of the five than 95 % of fresh behaviour; *diversity* and
*roughness* are relative to fresh behaviour. A table is written beside the results.
"""

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np
import torch
from real_data import FEW, FEW_SEED, FRESH_SEED, NAMES, REAL, RULE, RealSet, sets
from scipy.stats import spearmanr
from torch import Tensor

from ftl_lightning.data import references
from ftl_lightning.data.demonstrations import concatenate
from ftl_lightning.data.distances import PathFeatures
from ftl_lightning.data.places import first_windows
from ftl_lightning.data.references import GAUSSIAN, WARPED, Reference, Setting
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import KNOWN
from ftl_lightning.igm.forms.choice import SKILLED, SKILLED_STEPS
from ftl_lightning.igm.forms.combination import Combination
from ftl_lightning.igm.forms.quality import roughness
from ftl_lightning.igm.forms.skill import LeftOut
from ftl_lightning.igm.settings import ADAPTED, COMBINED, ONE, PAPER

SHOWN, EACH = 100, 8
"""Fresh demonstrations of a rule's set, and samples for each, of which a rule judges one."""
FORMS: dict[str, dict[str, Any]] = {
    **{form: {} for form in (COMBINED, ONE, WARPED, GAUSSIAN)},
    ADAPTED: {**SKILLED, "steps": SKILLED_STEPS},
}
"""Forms whose truth is measured, too, with their settings."""
EARLY = 20
"""Steps of learning that stops early."""
WORSE: dict[str, dict[str, Any]] = {
    PAPER: {"form": PAPER},
    f"{PAPER}, {EARLY} steps": {"form": PAPER, "steps": EARLY},
    f"{ADAPTED}, {EARLY} steps": {"form": ADAPTED, **SKILLED, "steps": EARLY},
}
"""Further forms with their settings; the program measures their skill only when it chooses among others."""


PRINTED = ("skill", "nearer")
"""What the program prints of a form, see :class:`~ftl_lightning.igm.concept.Choice`."""
TRIED = ("vowels", "strokes", "end effector", "pen")
"""Sets on which quantities were tried."""


def pretrained(data: RealSet, models: Path) -> FewShot:
    """The model of a set; pretrained, if the folder has none."""
    name = data.name.replace(" ", "_")
    folder = models / name / "fit" / "pretrained"
    if not folder.is_dir():
        file = models / f"{name}.safetensors"
        models.mkdir(parents=True, exist_ok=True)
        data.pretraining(60).save(file)
        command = [sys.executable, "-m", "ftl_lightning", "fit", "--config", "conf/own.yaml", "--data.demonstrations", str(file)]
        options = ["--trainer.logger.save_dir", str(models), "--trainer.logger.name", name]
        subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
    return FewShot.from_pretrained(folder)


def look(samples: Tensor, five: Tensor, fresh: Tensor, spread: Tensor) -> dict[str, float]:
    """Copies, diversity and roughness of samples ``(sample, horizon, state)``, by the columns' ``spread``."""
    samples, five, fresh = samples / spread, five / spread, fresh / spread
    near = [torch.cdist(paths.flatten(1), five.flatten(1)).amin(dim=1) for paths in (samples, fresh)]
    wide = [float(paths.var(dim=0).mean().sqrt()) for paths in (samples, fresh)]
    rough = [float(roughness(paths)) for paths in (samples, fresh)] if samples.shape[1] > 2 else [1.0, 1.0]
    copies = float((near[0] < near[1].quantile(0.05)).float().mean())
    return {"copies": round(copies, 4), "diversity": round(wide[0] / wide[1], 4), "roughness": round(rough[0] / rough[1], 4)}


def measured(data: RealSet, model: FewShot, kind: str, draw: int) -> dict[str, object]:
    """Form, skills, scores on fresh behaviour, and truth, of one new kind and draw of five."""
    five = data.demonstrations(kind, FEW, FEW_SEED + draw)
    fresh = data.demonstrations(kind, SHOWN if data.judge == RULE else REAL, FRESH_SEED + draw)
    observed, count = fresh.initial_states.observed, len(fresh)
    begin = time.process_time()
    learned = model.learn(five, name=kind)
    seconds = time.process_time() - begin
    choice, examples = learned.concept.choice, model.model.examples
    assert choice is not None
    assert examples is not None
    horizon = model.model.horizon
    features, real = PathFeatures(first_windows(examples, horizon).float()), first_windows(fresh, horizon).float()
    starts = fresh.initial_states.take(torch.arange(count).repeat_interleave(EACH)).observed

    def score(plans: Tensor) -> float:
        return round(float(features.scores(plans.float().unflatten(0, (count, EACH)), real).mean()), 4)

    concepts: dict[str, Composition] = {name: model.learn(five, name=kind, form=name, **options) for name, options in FORMS.items()}
    skills, nearer = dict(choice.skills), dict(choice.nearer)
    worse = {name: model.learn(five, name=kind, **options) for name, options in WORSE.items()}
    assert learned.demonstrations is not None
    combination = Combination.of(model.model, learned.demonstrations, model.tuned.inversion)
    assert combination is not None
    known = model[model.training_concepts[combination.best]]
    left = LeftOut(model.model, learned.demonstrations, examples)
    like = left.drawn([known] * len(left.rows), 0)
    parts = [replace(part, concepts=(f"{fold}",) * len(part)) for fold, part in enumerate(left.parts())]
    for name, concept in worse.items():
        folds = model.learn_all(concatenate(parts), **WORSE[name]).values()
        drawn = left.drawn([fold.concept.composition for fold in folds], 0, concept.variation)
        skills[name], nearer[name] = round(left.skill(drawn.score.mean()), 4), round(left.nearer(drawn, like), 4)
    concepts |= worse | {KNOWN: known}
    # of the chosen form, whose score is measured, several samples for each start
    sampled = (
        model.sample(learned, observed=starts, seed=draw) if observed else model.sample(learned, count=count * EACH, seed=draw)
    )
    plans = {"chosen": sampled.states[::EACH]}
    for name, each in concepts.items():
        kept = model.sample(each, observed=observed, seed=draw) if observed else model.sample(each, count=count, seed=draw)
        plans[name] = kept.states
    setting, truth, scores = Setting.of(examples, horizon, model.model.places), {}, {"chosen": score(sampled.states)}
    for name in references.NAMES:
        draws = torch.Generator().manual_seed(draw)
        scores[name] = score(Reference.of(name, five, setting, horizon).sample(starts, count * EACH, draws))
    for name, states in plans.items():
        samples = data.of(list(states.double().numpy()), {key: values.numpy() for key, values in observed.items()}, kind)
        truth[name] = round(data.right(kind, samples, seed=draw), 4)
    row = {"set": data.name, "kind": kind, "draw": draw, "judge": data.judge, "form": choice.form, "seconds": round(seconds, 1)}
    shape = look(sampled.states.float(), first_windows(five, horizon).float(), real, features.spread)
    return {**row, "truth": truth, "score": scores, "look": shape, "skill": skills, "nearer": nearer}


Pairs = list[tuple[float, float]]


def _pairs(rows: list[dict[str, Any]], printed: str, without: tuple[str, ...] = ()) -> Pairs:
    """What is printed of each form and its truth, over all cells; each form of a cell once."""
    named = [({**row["truth"], row["form"]: row["truth"]["chosen"]}, row[printed]) for row in rows]
    return [(said[name], truth[name]) for truth, said in named for name in truth if name not in ("chosen", *without)]


def _rank(pairs: Pairs) -> float:
    """Spearman's rank correlation."""
    return float(spearmanr(pairs).statistic)


def correlations(rows: list[dict[str, Any]]) -> list[str]:
    """Table of rank correlations, over all cells and as the mean over sets in which the truth differs."""
    sets = {name: [row for row in rows if row["set"] == name] for name in dict.fromkeys(str(row["set"]) for row in rows)}
    parts: dict[str, tuple[list[str], tuple[str, ...]]] = {
        "all": ([*sets], ()),
        f"all, without the {KNOWN}": ([*sets], (KNOWN,)),
        ", ".join(TRIED): ([name for name in sets if name in TRIED], ()),
        "the others": ([name for name in sets if name not in TRIED], ()),
    }
    head = [f"{printed}: {of}" for printed in PRINTED for of in ("all cells", "within sets")]
    lines = [f"| sets | pairs | {' | '.join(head)} |", f"|{'---|' * (len(head) + 2)}"]
    for part, (names, without) in parts.items():
        if not names:
            continue
        some = [row for name in names for row in sets[name]]
        numbers, pairs = [], Pairs()
        for printed in PRINTED:
            pairs = _pairs(some, printed, without)
            numbers += [_rank(pairs), float(np.nanmean([_rank(_pairs(sets[name], printed, without)) for name in names]))]
        lines.append(f"| {part} | {len(pairs)} | {' | '.join(f'{number:.2f}' for number in numbers)} |")
    return lines


def ahead(rows: list[dict[str, Any]]) -> int:
    """Standard errors by which the chosen form's score is better than the best reference's, paired over cells."""
    best = min(references.NAMES, key=lambda name: mean(row["score"][name] for row in rows))
    gains = [row["score"][best] - row["score"]["chosen"] for row in rows]
    return round(mean(gains) / max(stdev(gains) / len(gains) ** 0.5, 1e-9)) if len(gains) > 1 else 0


def table(rows: list[dict[str, Any]]) -> str:
    """Means by set."""
    lines = [
        "| set | truth: chosen | warped | Gaussian | adapter | score: chosen | best reference | ahead by |",
        "|---|---|---|---|---|---|---|---|",
    ]
    looks = ["| set | copies | diversity | roughness |", "|---|---|---|---|"]
    for name in dict.fromkeys(str(row["set"]) for row in rows):
        some = [row for row in rows if row["set"] == name]
        numbers = [mean(row["truth"][form] for row in some) for form in ("chosen", WARPED, GAUSSIAN, ADAPTED)]
        scores = [mean(row["score"][form] for row in some) for form in ("chosen", *references.NAMES)]
        shown = [f"{number:.2f}" for number in numbers] + [f"{scores[0]:.3f}", f"{min(scores[1:]):.3f}", f"{ahead(some)} s.e."]
        look = [f"{mean(row['look'][key] for row in some):.2f}" for key in ("copies", "diversity", "roughness")]
        looks.append(f"| {name} | {' | '.join(look)} |")
        lines.append(f"| {name} | {' | '.join(shown)} |")
    return "\n".join((*lines, "", *looks, "", *correlations(rows), ""))


def main() -> None:
    """Measure the sets and write results and table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=list(NAMES))
    parser.add_argument("--kinds", type=int, default=2, help="new kinds of each set, the first by their order")
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--models", type=Path, default=Path("logs/real"))
    parser.add_argument("--out", type=Path, default=Path("results/real.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, object]] = []
    for draw, data in product(range(options.draws), sets(options.sets).values()):
        model = pretrained(data, options.models)
        for kind in data.new[: options.kinds]:
            rows.append(measured(data, model, kind, draw))
            print(json.dumps(rows[-1]), flush=True)
        options.out.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
        options.out.with_suffix(".md").write_text(table(rows), "utf-8")


if __name__ == "__main__":
    main()
