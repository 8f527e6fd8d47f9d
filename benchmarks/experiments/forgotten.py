"""What is forgotten: accuracy on training concepts before and after each new concept was learned, in open loop.

    python benchmarks/experiments/forgotten.py                                        # object rearrangement and navigation
    python benchmarks/experiments/forgotten.py --domains mocap --root FOLDER

Each of the paper's new concepts is learned from five demonstrations. Every training concept then generates with the learned
concept in the sum at weight 0: a change of the network shows, the concept itself does not. *Ours* and *adapter* leave the other
branches as they were pretrained; *LoRA fine-tuning* is the same adapter in all branches. Compositions are those of the paper.
Domains that the file has are kept.
"""

import argparse
import json
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import torch

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import concatenate
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.services.tensor_file import write_text

RANKS = {"mocap": {"adapter": 2, "adapter_learning_rate": 5e-4}}
USUAL = {"adapter": 8, "adapter_learning_rate": 1.5e-3}
"""Rank and learning rate of adapters: of human motion those of its configuration, else chosen by ``rivals.yaml``."""
METHODS: dict[str, dict[str, Any]] = {
    "ours": {"form": "paper"},
    "adapter": {"form": "adapter", "adapter_scope": "concept"},
    "LoRA fine-tuning": {"form": "adapter", "adapter_scope": "all"},
}


def accuracy(few: FewShot, concept: Any, goal: str, count: int) -> float:
    """Share of plans from new initial states that are right."""
    starts = few.starts(goal, count, EVALUATION_SEED) if few.domain.observed else None
    return few.evaluate(few.sample(concept, count, starts), goal)[few.domain.main_metric]


def measured(name: str, count: int, seed: int, root: Path | None) -> dict[str, Any]:
    """Accuracies before and after learning, by method."""
    few = FewShot.from_pretrained(name)
    suite = few.domain.concepts.suites["paper"]
    shown = concatenate([few.domain.source(root).draw(text, 5, DEMONSTRATION_SEED + seed) for text in suite.learned])
    rows: dict[str, Any] = {"before": fmean(accuracy(few, few[text], text, count) for text in few.training_concepts)}
    for method, settings in METHODS.items():
        changes = settings if settings["form"] == "paper" else {**settings, **RANKS.get(name, USUAL)}
        learned: dict[str, LearnedConcept] = few.learn_all(shown, seed=seed, **changes)
        after = [
            accuracy(few, few[text] + 0.0 * concept, text, count) for concept in learned.values() for text in few.training_concepts
        ]
        composed = [task for task in suite.tasks if task.learned and task.texts and not task.on]
        sums = [sum((few[text] for text in task.texts), learned[task.learned[0]]) for task in composed]
        rows[method] = {
            "training concepts": fmean(after),
            "standard error over pairs": stdev(after) / len(after) ** 0.5,
            "pairs": len(after),
            "new concepts": fmean(accuracy(few, concept, text, count) for text, concept in learned.items()),
            "new + training": fmean(accuracy(few, one, task.goal, count) for one, task in zip(sums, composed, strict=True))
            if composed
            else None,
        }
        print(name, method, rows[method], flush=True)
    return {"samples": count, "seed": seed, **rows}


def main() -> None:
    """Measure the domains that the file has not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", nargs="+", default=["object_rearrangement", "agent"])
    parser.add_argument("--count", type=int, default=50, help="samples of each task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--root", type=Path, help="folder of recordings")
    parser.add_argument("--out", type=Path, default=Path("results/forgotten.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = json.loads(options.out.read_text("utf-8")) if options.out.is_file() else {}
    for name in options.domains:
        found[name] = found.get(name) or measured(name, options.count, options.seed, options.root)
        write_text(options.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
