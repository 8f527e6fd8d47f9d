"""Forms of concepts on ten sets of behaviour: the form that skill chooses, beside what a rule or classifiers say of its samples.

    python benchmarks/experiments/real.py --models logs/real --out results/real.json

The sets are those of ``real_data.py``. A model of each is pretrained with ``conf/own.yaml`` on 60 demonstrations of each kind,
unless it is in ``--models``. Then each new kind is learned from five demonstrations with default settings. The *truth* is the share
of 100 new samples that are right by the set's rule, or the mean F1 of two classifiers that are trained on 50 samples and tested on
real behaviour. It is measured for the chosen form and for other forms, two of which need no learning. The *score* is the energy
score on fresh behaviour, lower is better. *Copies*: share of samples that are nearer to one of the five than 95 % of fresh
behaviour; *diversity* and *roughness* are relative to fresh behaviour. A table is written beside the results.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import torch
from real_data import FEW, FEW_SEED, FRESH_SEED, NAMES, REAL, RULE, RealSet, sets
from scipy.stats import spearmanr
from torch import Tensor

from ftl_lightning.data import references
from ftl_lightning.data.energy import PathFeatures
from ftl_lightning.data.places import first_windows
from ftl_lightning.data.references import GAUSSIAN, WARPED, Reference, Setting
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.forms.choice import SKILLED, SKILLED_STEPS
from ftl_lightning.igm.forms.quality import roughness
from ftl_lightning.igm.settings import ADAPTED, COMBINED, ONE

SHOWN, EACH = 100, 8
"""Fresh demonstrations of a rule's set, and samples for each, of which a rule judges one."""
FORMS: dict[str, dict[str, Any]] = {
    **{form: {} for form in (COMBINED, ONE, WARPED, GAUSSIAN)},
    ADAPTED: {**SKILLED, "steps": SKILLED_STEPS},
}
"""Forms whose truth is measured, too, with their settings."""


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

    def sampled(concept: LearnedConcept) -> Tensor:
        if observed:
            return model.sample(concept, observed=starts, seed=draw).states
        return model.sample(concept, count=count * EACH, seed=draw).states

    concepts = {"chosen": learned} | {name: model.learn(five, name=kind, form=name, **options) for name, options in FORMS.items()}
    plans = {name: sampled(concept) for name, concept in concepts.items()}
    setting, truth, scores = Setting.of(examples, horizon), {}, {"chosen": score(plans["chosen"])}
    for name in references.NAMES:
        draws = torch.Generator().manual_seed(draw)
        scores[name] = score(Reference.of(name, five, setting, horizon).sample(starts, count * EACH, draws))
    for name, states in plans.items():
        some = list(states[::EACH].double().numpy())
        samples = data.of(some, {key: values.numpy() for key, values in observed.items()}, kind)
        truth[name] = round(data.right(kind, samples, seed=draw), 4)
    row = {"set": data.name, "kind": kind, "draw": draw, "judge": data.judge, "form": choice.form, "seconds": round(seconds, 1)}
    shape = look(plans["chosen"].float(), first_windows(five, horizon).float(), real, features.spread)
    return {**row, "truth": truth, "score": scores, "look": shape, "skill": choice.skills}


def correlation(rows: list[dict[str, Any]]) -> tuple[float, int]:
    """Spearman's rank correlation of skill with truth, over all forms of all cells, and their number."""
    pairs = [(row["skill"][name], row["truth"][name]) for row in rows for name in FORMS if name in row["skill"]]
    return float(spearmanr(pairs).statistic), len(pairs)


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
    value, count = correlation(rows)
    return (
        "\n".join((*lines, "", *looks))
        + f"\n\nRank correlation of skill with truth: {value:.2f}, over {count} forms of {len(rows)} cells.\n"
    )


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
    for data in sets(options.sets).values():
        model = pretrained(data, options.models)
        for kind in data.new[: options.kinds]:
            for draw in range(options.draws):
                rows.append(measured(data, model, kind, draw))
                print(json.dumps(rows[-1]), flush=True)
        options.out.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
        options.out.with_suffix(".md").write_text(table(rows), "utf-8")


if __name__ == "__main__":
    main()
