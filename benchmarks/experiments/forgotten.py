"""What is forgotten: success of training tasks, and of compositions with them, after a new task was learned.

    python benchmarks/experiments/forgotten.py --domains object_rearrangement agent driving tabletop --out results/forgetting.json
    python benchmarks/experiments/forgotten.py --domains mocap --root FOLDER --out results/forgetting.json

Each of the paper's new concepts is learned from five demonstrations (the table-top's from ten). Then every training concept
generates with the learned concept in the sum at weight 0, so that a change of the network shows and the concept itself does not.
*paper's form* and *adapter* leave the network of the other branches as it was. *LoRA fine-tuning* is the same adapter in all
branches, with the same rank and learning rate (of motion and table-top those of ``conf/*_adapter.yaml``).
Domains with an environment are judged in closed loop, the others by their main metric. The standard error is over pairs of a
learned and a training concept.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import concatenate
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.services.tensor_file import write_text

ADAPTERS = {"mocap": (2, 5e-4), "tabletop": (8, 3e-3)}
"""Rank and learning rate of the adapter by domain."""
USUAL = (8, 3e-3)
SHOWN = {"tabletop": 10}


def success(few: FewShot, concept: Any, task: str, count: int) -> float:
    """Success rate of a concept, in closed loop where the domain has an environment."""
    starts = few.starts(task, count, EVALUATION_SEED) if few.domain.observed else None
    loop = few.domain.closed_loop
    if loop is not None and starts is not None:
        outcomes = few.execute(concept, starts, task).outcomes
        return float(outcomes["strict success" if "strict success" in outcomes else "success"])
    return float(few.evaluate(few.sample(concept, count, starts), task)[few.domain.main_metric])


def learned(few: FewShot, names: Sequence[str], method: str, seed: int, root: Path | None) -> dict[str, LearnedConcept]:
    """Concepts by name, learned by a method."""
    domain = few.domain.name
    rank, rate = ADAPTERS.get(domain, USUAL)
    source = few.domain.source(root)
    changes: dict[str, Any] = {"form": "paper"}
    if method != "paper's form":
        scope = "all" if method == "LoRA fine-tuning" else "concept"
        changes = {"form": "adapter", "adapter": rank, "adapter_scope": scope, "adapter_learning_rate": rate}
    shown = concatenate([source.draw(name, SHOWN.get(domain, 5), DEMONSTRATION_SEED + seed) for name in names])
    return few.learn_all(shown, seed=seed, **changes)


def measured(name: str, count: int, seed: int, root: Path | None) -> dict[str, Any]:
    """Success before and after, by method."""
    few = FewShot.from_pretrained(name)
    suite = few.domain.concepts.suites["paper"]
    compositions = [task for task in suite.tasks if task.learned and task.texts and not task.on]
    before = {text: success(few, few[text], text, count) for text in few.training_concepts}
    rows: dict[str, Any] = {"before": {"training": float(np.mean(list(before.values())))}}
    for method in ("paper's form", "adapter", "LoRA fine-tuning"):
        concepts = learned(few, suite.learned, method, seed, root)
        after = np.array(
            [[success(few, few[text] + 0.0 * concept, text, count) for text in before] for concept in concepts.values()]
        )
        rows[method] = {
            "training": float(after.mean()),
            "standard error": float(after.std(ddof=1) / after.size**0.5) if after.size > 1 else None,
            "pairs": after.size,
            "new": float(np.mean([success(few, concept, text, count) for text, concept in concepts.items()])),
        }
        if compositions:
            sums = [sum((few[text] for text in task.texts), concepts[task.learned[0]]) for task in compositions]
            rates = [success(few, concept, task.goal, count) for task, concept in zip(compositions, sums, strict=True)]
            rows[method]["new + training"] = float(np.mean(rates))
        print(name, method, rows[method], flush=True)
    return rows


def main() -> None:
    """Measure the domains; those in the file are kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", nargs="+", default=["object_rearrangement"])
    parser.add_argument("--count", type=int, default=50, help="initial states of each task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--root", type=Path, help="folder of recordings")
    parser.add_argument("--out", type=Path, default=Path("results/forgetting.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = json.loads(options.out.read_text("utf-8")) if options.out.is_file() else {}
    for name in options.domains:
        found[name] = {"episodes": options.count, "seed": options.seed, **measured(name, options.count, options.seed, options.root)}
        write_text(options.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
