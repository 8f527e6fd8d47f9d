"""Record corrections of a table-top model: the model acts in scenes of training tasks, then the expert takes over.

    python benchmarks/experiments/tabletop_dagger.py --pretrained pretrained/tabletop --count 200 --seed 1 \
        --out corrections.safetensors
    python -m ftl_lightning fit --config conf/tabletop.yaml --data.more corrections.safetensors

The expert's part is a demonstration (DAgger, Ross et al., 2011); the model's part is discarded. As in the training set, objects
irrelevant to the task are elsewhere in each picture.
"""

import argparse
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.tabletop.environment import TableTopEnvironment
from ftl_lightning.domains.tabletop.interface import AROUND_BOWL, PUSH, PUSHES
from ftl_lightning.domains.tabletop.scenes import draw_scene
from ftl_lightning.domains.tabletop.source import Episode, joined_episodes, perform
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import generator, task_key
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model

STEPS = (10, 120)
"""That the model drives."""
REPLAN = 8
CORRECTION_SEED = 3_000_000
"""Added to the seed of scenes."""


class Driven:
    """Lets a model drive before a demonstration begins."""

    def __init__(self, model: ConceptModel, task: str, omega: float) -> None:
        self.model, self.sampling = model, Sampling("dpm_solver", 5)
        self.composition = Composition(model.concept(task)[None, None], torch.tensor([omega]))

    def __call__(self, env: TableTopEnvironment, task: str, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
        draw = generator("cpu", int(rng.integers(2**31)))
        seen, plan = env.begun(), np.zeros((0, 4), dtype=np.float32)
        for step in range(int(rng.integers(*STEPS))):
            if step % REPLAN == 0:
                observed = {name: torch.as_tensor(values)[None] for name, values in seen.items()}
                plan = self.model.sample([self.composition], 1, self.sampling, [draw], observed)[0, 0].numpy()
            seen, _, over, _, _ = env.step(plan[step % REPLAN + 1])
            if over:
                break
        return env.begun()


def corrected(model: ConceptModel, task: str, count: int, seed: int, omega: float) -> Demonstrations:
    """``count`` demonstrations by the expert that begin where a model has come to; those that begin at their end are left out."""
    env, kept, number = TableTopEnvironment(), list[Episode](), 0
    driven = Driven(model, task, omega)
    with bar(task, count) as advance:
        while len(kept) < count:
            rng = np.random.default_rng([CORRECTION_SEED + seed, task_key(task), number])
            number += 1
            episode = perform(env, task, draw_scene(task, rng), rng, scatter=True, begin=driven)
            if episode.success and len(episode.actions) > 3:
                kept.append(episode)
                advance()
    env.close()
    return joined_episodes(task, kept, None, {"corrections of": model.hash, "seed": seed, "tried": number})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/tabletop", help="folder of the model")
    parser.add_argument("--task", action="append", choices=PUSHES, help="default: the two training pushes")
    parser.add_argument("--count", type=int, default=200, help="demonstrations of each task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--omega", type=float, default=1.2, help="weight of the concept")
    parser.add_argument("--out", required=True, help="file of demonstrations")
    options = parser.parse_args()
    model = load_model(options.pretrained)
    made = [corrected(model, task, options.count, options.seed, options.omega) for task in options.task or (PUSH, AROUND_BOWL)]
    concatenate(made).save(options.out)


if __name__ == "__main__":
    main()
