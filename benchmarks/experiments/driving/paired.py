"""Paired comparison of all methods in driving by episode, with the same starts and separate models for each seed.

    python benchmarks/experiments/driving/paired.py --out results/driving_paired.json

Repeats the episodes of ``ablate --config conf/ablation/comparison.yaml`` with the models that it pretrains. A single task and three
seeds are too few pairs of *rates* for a test; 150 pairs of *episodes* may suffice. Takes ten minutes on one thread.
"""

import argparse
import json
from collections.abc import Mapping

import torch
from torch import Tensor

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.driving.domain import DOMAIN
from ftl_lightning.igm.composition import Composition
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.methods.in_context import InContextModel
from ftl_lightning.networks.text_encoder import load_encoder
from ftl_lightning.reporting.paired import episodes
from ftl_lightning.services.randomness import DEMONSTRATION_SEED
from ftl_lightning.services.tensor_file import write_text

OURS = "ours"
METHODS = {OURS: "steps", "BC": "bc", "CVAE": "cvae", "in-context": "in_context", "language": "steps"}
"""What the folder of a method's model is called."""
ENVIRONMENTS = {"belief": "", "step": "step veto"}
LANGUAGE_WEIGHT = 1.2
"""Of a concept that is told in words (conf/method/language.yaml)."""


def concept(few: FewShot, method: str, shown: Demonstrations, name: str, seed: int) -> Composition:
    """What a method makes of the demonstrations, or of the task's name alone."""
    model = few.model
    if isinstance(model, InContextModel):
        prompts = model.prompts(shown)
        return Composition(prompts[:, None], torch.ones(len(prompts)))
    if method == "language":
        assert isinstance(model, GenerativeModel)
        text = load_encoder("table", DOMAIN.concepts.table, "main")([name])
        return Composition(model.standardise(text)[None], torch.tensor([LANGUAGE_WEIGHT]))
    return few.learn(shown, name=name, seed=seed, form="paper")


def arrived(few: FewShot, told: Composition, task: str, count: int, seed: int) -> dict[str, Tensor]:
    """In which episodes ``(episode,)`` the concept succeeds, and crashes, with each veto."""
    starts = few.starts(task, count, seed)
    found: dict[str, Tensor] = {}
    for name, environment in ENVIRONMENTS.items():
        outcomes = DOMAIN.judge(task, few.execute(told, starts, task, replan=1, environment=environment, seed=seed).rollout)
        found |= {name: outcomes["strict success"].bool(), f"{name}, crash": outcomes["crash"].bool()}
    return found


def compared(every: Mapping[str, Mapping[str, Tensor]]) -> dict[str, dict[str, object]]:
    """Rates of each method, and by how much ours is ahead of it, with McNemar's exact p."""
    found: dict[str, dict[str, object]] = {}
    for method, own in every.items():
        found[method] = {name: round(float(values.float().mean()), 3) for name, values in own.items()}
        for name in ENVIRONMENTS if method != OURS else ():
            ours, theirs = every[OURS][name], own[name]
            won, lost = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
            found[method][f"ours is ahead by ({name})"] = episodes(won, lost, len(ours))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", default="logs/ablation", help="folder of the pretrained models")
    parser.add_argument("--task", default="roundabout")
    parser.add_argument("--episodes", type=int, default=50, help="of each seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--out", help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    parts: dict[str, list[dict[str, Tensor]]] = {method: [] for method in METHODS}
    for seed in options.seeds:
        shown = DOMAIN.source(None).draw(options.task, 5, DEMONSTRATION_SEED + seed)
        for method, folder in METHODS.items():
            few = FewShot.from_pretrained(f"{options.models}/driving-{folder}{seed}/pretrained")
            told = concept(few, method, shown, options.task, seed)
            parts[method].append(arrived(few, told, options.task, options.episodes, seed))
            rates = ", ".join(f"{name} {values.float().mean():.2f}" for name, values in parts[method][-1].items())
            print(f"seed {seed}, {method}: {rates}", flush=True)
    every = {method: {name: torch.cat([one[name] for one in own]) for name in own[0]} for method, own in parts.items()}
    content = compared(every)
    for method, told_of in content.items():
        print(f"{method:12s}", told_of, flush=True)
    if options.out:
        about = {"task": options.task, "episodes": len(options.seeds) * options.episodes, "seeds": options.seeds}
        write_text(options.out, json.dumps({**about, "methods": content}, indent=2) + "\n")


if __name__ == "__main__":
    main()
