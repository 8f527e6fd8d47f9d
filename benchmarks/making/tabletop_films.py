"""Make a film of episodes side by side from the same scenes: ours, fine-tuning, behaviour cloning and the expert.

    python benchmarks/making/tabletop_films.py --out docs/push_on_book.gif

All learn from the same demonstrations. Each row is a scene; how an episode ended stands below its last picture alone.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import closed_loop_of
from ftl_lightning.domains.tabletop import DOMAIN
from ftl_lightning.domains.tabletop.domain import POLICIES
from ftl_lightning.domains.tabletop.interface import PUSH_ON_BOOK, TASKS
from ftl_lightning.domains.tabletop.rendering import film
from ftl_lightning.evaluation.closed_loop import roll_out
from ftl_lightning.evaluation.pictures import captioned, gif, outcome_text
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.services.randomness import DEMONSTRATION_SEED, EVALUATION_SEED
from ftl_lightning.services.tensor_file import atomic

DEMONSTRATIONS = 10
SIZE = (240, 180)
"""Pixels of a picture."""
COLOURS = 256
EXPERT = "expert (oracle)"
ADAPTER = "conf/tabletop_adapter.yaml"

Pictures = list[NDArray[np.uint8]]


def learned(name: str, settings: str, known: Demonstrations, starts: InitialStates, seed: int, scope: str = "") -> list[Pictures]:
    """Films of a method that learns from demonstrations, one for each start."""
    model = FewShot.from_pretrained(name, settings)
    told: dict[str, Any] = {"adapter_scope": scope} if scope else {}
    concept = model.learn(known, steps=model.tuned.learning_steps, seed=seed, **told)
    done = model.execute(concept, starts, known.concepts[0], seed=seed)
    judged = DOMAIN.judge(known.concepts[0], done.rollout)
    return [small(done.frames(row), outcome_text(judged, row)) for row in range(len(starts))]


def by_expert(task: str, starts: InitialStates, seed: int) -> list[Pictures]:
    """Films of the expert."""
    policy = POLICIES[EXPERT](task, starts, None, seed)
    assert policy is not None
    done = roll_out(closed_loop_of(DOMAIN), starts, policy)
    judged, plans = DOMAIN.judge(task, done), torch.full((1, DOMAIN.plans.horizon, len(DOMAIN.plans.columns)), torch.nan)
    return [small(film(done.take(row, row + 1), plans), outcome_text(judged, row)) for row in range(len(starts))]


def small(pictures: Pictures, ending: str) -> Pictures:
    """Pictures of the films' size, the last with how the episode ended below it."""
    return captioned([np.asarray(Image.fromarray(picture).resize(SIZE)) for picture in pictures], " ", ending)


def side_by_side(films: dict[str, list[Pictures]]) -> Pictures:
    """One film of several: a column for each name, a row for each start. Shorter ones stay at their last picture."""
    frames = max(len(one) for rows in films.values() for one in rows)
    columns = []
    for name, rows in films.items():
        every = [[*one, *[one[-1]] * (frames - len(one))] for one in rows]
        columns.append(captioned([np.concatenate(parts) for parts in zip(*every, strict=True)], name))
    return [np.concatenate(parts, axis=1) for parts in zip(*columns, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="tabletop", help="our model")
    parser.add_argument("--cloning", default="pretrained/baseline/bc/tabletop", help="model of behaviour cloning")
    parser.add_argument("--task", default=PUSH_ON_BOOK, choices=TASKS)
    parser.add_argument("--count", type=int, default=1, help="scenes, the first that evaluation draws")
    parser.add_argument("--seed", type=int, default=0, help="of demonstrations, learning and scenes")
    parser.add_argument("--out", type=Path, required=True, help="file, .gif")
    options = parser.parse_args()
    source, seed = DOMAIN.source(None), options.seed
    known = source.draw(options.task, DEMONSTRATIONS, DEMONSTRATION_SEED + seed)
    starts = source.starts(options.task, options.count, EVALUATION_SEED + seed)
    assert starts is not None
    films = {
        "ours, with adapter": learned(options.pretrained, ADAPTER, known, starts, seed),
        "LoRA fine-tuning": learned(options.pretrained, ADAPTER, known, starts, seed, scope="all"),
        "behaviour cloning": learned(options.cloning, "conf/bc/tabletop.yaml", known, starts, seed),
        "expert": by_expert(options.task, starts, seed),
    }
    with atomic(options.out) as temporary:
        temporary.write_bytes(gif(side_by_side(films), colours=COLOURS))


if __name__ == "__main__":
    main()
