"""Forms of concepts on ten sets of behaviour: the form that skill chooses, beside what a rule or classifiers say of its samples.

    python benchmarks/experiments/real.py --models logs/real --out results/real.json

The sets are those of ``real_data.py``. A model of each is pretrained with ``conf/own.yaml`` on 60 demonstrations of each kind,
unless it is in ``--models``. Then each new kind is learned from five demonstrations with default settings. The *truth* is the share
of 100 new samples that are right by the set's rule, or the mean F1 of two classifiers that are trained on 50 samples and tested on
real behaviour. The truth of warped demonstrations is measured, too. A table is written beside the results.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import mean

import torch
from real_data import FEW, FEW_SEED, FRESH_SEED, NAMES, REAL, RULE, RealSet, sets

from ftl_lightning.data.references import WARPED
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.forms.choice import SIMPLEST

SHOWN = 100
"""Samples that a rule judges."""


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


def measured(data: RealSet, model: FewShot, kind: str, draw: int) -> dict[str, object]:
    """Form, skills and truth of one new kind and draw of five."""
    five = data.demonstrations(kind, FEW, FEW_SEED + draw)
    count = SHOWN if data.judge == RULE else REAL
    observed = data.demonstrations(kind, count, FRESH_SEED + draw).initial_states.observed
    begin = time.process_time()
    learned = model.learn(five, name=kind)
    seconds = time.process_time() - begin
    truth = {}
    for name, concept in {"chosen": learned, WARPED: model.learn(five, name=kind, form=WARPED, steps=1)}.items():
        if observed:
            plans = model.sample(concept, observed=observed, seed=draw).states
        else:
            plans = model.sample(concept, count=count, seed=draw).states
        samples = data.of(list(plans.double().numpy()), {key: some.numpy() for key, some in observed.items()}, kind)
        truth[name] = round(data.right(kind, samples, seed=draw), 4)
    choice = learned.concept.choice
    assert choice is not None
    row = {"set": data.name, "kind": kind, "draw": draw, "judge": data.judge, "form": choice.form, "seconds": round(seconds, 1)}
    return {**row, "truth": truth, "skill": choice.skills}


def table(rows: list[dict[str, object]]) -> str:
    """Means by set, and the forms that were chosen."""
    lines = [
        "| set | truth, form chosen | truth, warped | skill, best learned form | skill, warped | forms chosen |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(str(row["set"]) for row in rows):
        some = [row for row in rows if row["set"] == name]
        truths, skills = [row["truth"] for row in some], [row["skill"] for row in some]
        numbers = [
            mean(truth["chosen"] for truth in truths),  # type: ignore[index]
            mean(truth[WARPED] for truth in truths),  # type: ignore[index]
            mean(max(skill[form] for form in SIMPLEST if form in skill) for skill in skills),  # type: ignore[index, operator]
            mean(skill[WARPED] for skill in skills),  # type: ignore[index]
        ]
        forms = ", ".join(sorted({str(row["form"]) for row in some}))
        lines.append(f"| {name} | {' | '.join(f'{number:.2f}' for number in numbers)} | {forms} |")
    return "\n".join(lines) + "\n"


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
