"""Test whether a push follows its concept: two objects at the same distance from the circle exchange their positions.

    python benchmarks/experiments/tabletop_targets.py --pretrained pretrained/tabletop_wide --out results/tabletop_targets.json

Pushing to the book is a concept that is learned from ten demonstrations; pretraining shows the other three. A push is right if the
circle touches what the concept names and nothing else, and followed if that is so before and after the exchange. A hand that goes
where it went before touches the wrong thing after it; one that chooses by chance is right in half of the scenes, and follows in a
quarter.
"""

import argparse
import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.domains.tabletop.interface import PUSH, PUSH_TO_BOOK, PUSH_TO_BOWL, PUSH_TO_WHITE
from ftl_lightning.domains.tabletop.scenes import (
    BOOK,
    BOWL,
    CIRCLE,
    START,
    TRIANGLE,
    WHITE,
    anywhere,
    check,
    random_yaw,
    scene_of,
)
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import write_text

PUSHES = {TRIANGLE: PUSH, BOWL: PUSH_TO_BOWL, WHITE: PUSH_TO_WHITE, BOOK: PUSH_TO_BOOK}
FAR, APART = (0.20, 0.26), (math.pi / 2, 0.7 * math.pi)
"""Metres from the circle to both things, and radians between them seen from there."""
DEMONSTRATIONS = 10
SCENE_SEED = 4_000_000


def scenes(one: str, other: str, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A scene with two things beside the circle, and the same with their places exchanged."""
    while True:
        x, y = anywhere(rng)
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(*FAR)
        angles = (angle, angle + rng.choice((-1, 1)) * rng.uniform(*APART))
        places = [(x + distance * math.cos(turn), y + distance * math.sin(turn)) for turn in angles]
        yaws = {name: random_yaw(rng, name) for name in (one, other)}
        hand = [float(rng.uniform(*limits)) for limits in START]
        found = []
        for first, second in ((one, other), (other, one)):
            placed = {CIRCLE: (x, y, 0.0)} | {
                name: (*place, yaws[name]) for name, place in zip((first, second), places, strict=True)
            }
            found.append(scene_of(placed, hand))
        try:
            return check(found[0]), check(found[1])
        except UserError:
            continue


def touched(model: FewShot, concept: Composition, drawn: Tensor, seed: int) -> list[set[str]]:
    """What the circle touched in each scene."""
    return [set(told["touches"]) for told in model.execute(concept, drawn, seed=seed).rollout.infos]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/tabletop_wide", help="folder of the model")
    parser.add_argument("--count", type=int, default=10, help="scenes of each pair of things")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--omega", type=float, default=1.0, help="weight of concepts in words")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    model = FewShot.from_pretrained(options.pretrained, settings="conf/tabletop_wide.yaml")
    source = model.domain.source(None)
    learned = model.learn(source.draw(PUSH_TO_BOOK, DEMONSTRATIONS, options.seed), name=PUSH_TO_BOOK)
    pairs: dict[str, dict[str, Any]] = {}
    with bar("targets", len(PUSHES) * (len(PUSHES) - 1)) as advance:
        for target, other in itertools.permutations(PUSHES, 2):
            rng = np.random.default_rng([SCENE_SEED + options.seed, *map(ord, min(target, other) + max(target, other))])
            first, second = sorted((target, other))
            drawn = [scenes(first, second, rng) for _ in range(options.count)]  # alike for both ways round
            concept = learned if target == BOOK else options.omega * model[PUSHES[target]]
            right = [
                [found == {target} for found in touched(model, concept, torch.from_numpy(np.stack(part)), options.seed)]
                for part in zip(*drawn, strict=True)
            ]
            every = torch.tensor(right)
            pairs.setdefault(target, {})[other] = {
                "right": round(float(every.float().mean()), 4),
                "followed": round(float(every.all(dim=0).float().mean()), 4),
            }
            advance()
    content = {"model": model.model.hash, "scenes": options.count, "seed": options.seed, "pushed to, beside": pairs}
    text = json.dumps(content, indent=2)
    print(text)
    if options.out:
        write_text(options.out, text + "\n")


if __name__ == "__main__":
    main()
