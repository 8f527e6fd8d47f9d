"""Samples on the page of play, learned quickly and thoroughly: share that is alike, and roughness, beside fresh demonstrations.

    python benchmarks/experiments/play_thorough.py [--out results/play_thorough.json]

Strokes of the validation kinds, two sets of five each. *Alike* is the page's judgement by the five demonstrations; roughness is
relative to theirs.
"""

import argparse
import json
import warnings
from typing import Any

import numpy as np

from ftl_lightning.apps.benchmark.strokes import VALIDATION, drawn
from ftl_lightning.apps.play.mixing import judge_of, judged
from ftl_lightning.apps.play.workspace import QUICK, QUICK_STEPS
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.forms.quality import Quality
from ftl_lightning.services.tensor_file import write_text

SEEDS, COUNT, NAME = (11, 12), 100, "new"


def measured(model: FewShot, five: Demonstrations, plans: Demonstrations) -> dict[str, float]:
    """Share of plans that is alike, and their roughness."""
    judge = judge_of(model, [five])
    films, _ = judged(model.model, judge, plans, NAME)
    right = [film["right"] for film in films]
    return {"alike": float(np.mean(right)), "roughness": Quality.of(plans.states, five.states).roughness}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="results/play_thorough.json")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    model, rows = FewShot.from_pretrained("strokes"), list[dict[str, Any]]()
    for kind in VALIDATION:
        for seed in SEEDS:
            five, fresh = (
                model.demonstrations(drawn(kind, count, number), name=NAME) for count, number in ((5, seed), (COUNT, seed + 500))
            )
            quick = model.learn(five, name=NAME, steps=QUICK_STEPS, **QUICK)
            thorough = model.learn(five, name=NAME)
            plans = {"fresh": fresh, "quick": model.sample(quick, COUNT, seed=0), "thorough": model.sample(thorough, COUNT, seed=0)}
            choice = thorough.concept.choice
            row = {"kind": kind, "seed": seed, "form": "" if choice is None else choice.form}
            rows.append(row | {name: measured(model, five, some) for name, some in plans.items()})
            print(rows[-1], flush=True)
    means = {
        name: {
            key: {"mean": round(float(np.mean(values)), 3), "least": round(min(values), 3), "most": round(max(values), 3)}
            for key in ("alike", "roughness")
            for values in [[row[name][key] for row in rows]]
        }
        for name in ("fresh", "quick", "thorough")
    }
    write_text(
        options.out,
        json.dumps({"command": "python benchmarks/experiments/play_thorough.py", "means": means, "rows": rows}, indent=2) + "\n",
    )
    print(means)


if __name__ == "__main__":
    main()
