"""Causes of failed pushing episodes: the model alone, with either half by the expert, and the expert with the model's perception.

    python benchmarks/experiments/tabletop_failures.py --pretrained pretrained/tabletop --out results/tabletop_failures.json
    python benchmarks/experiments/tabletop_failures.py --concept concept.safetensors \
        --task "push green circle to orange triangle on book"

`model` follows the model's plans to the end. `model pushes` lets the expert bring the hand behind the circle, `expert pushes` takes
over from the model there. `expert through eyes` is the expert, whose places of circle, triangle and bowl come from the features of
the model's image encoder by linear regression (of other scenes). Failures are told by where things are in the end:

    fell          the circle or the triangle left the surface that it stood on
    wrong object  the circle lies at another object than the triangle
    rim           the circle is so far out that no hand comes behind it
    beside        the hand is low and at the circle, but not behind it
    timeout       anything else
"""

import argparse
import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ftl_lightning.data.features import Observed
from ftl_lightning.domains.domain import closed_loop_of
from ftl_lightning.domains.tabletop import DOMAIN
from ftl_lightning.domains.tabletop.environment import TOUCH, Seen, TableTopEnvironment
from ftl_lightning.domains.tabletop.experts import FARTHEST, LOW, PUSH_HEIGHT, SLOWER, SPEED, WIDEST, Manner, around, pushed
from ftl_lightning.domains.tabletop.interface import AROUND_BOWL, POSE, PUSH, PUSH_ON_BOOK, PUSHES, TASKS
from ftl_lightning.domains.tabletop.scenes import BOOK, BOWL, CIRCLE, COLUMNS, TRIANGLE, WHITE, gap, outline, outlines, support
from ftl_lightning.domains.tabletop.source import initial_states
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, roll_out, sampled_plans
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model

MODEL, PUSHED, APPROACHED, EYES = "model", "model pushes", "expert pushes", "expert through eyes"
OUT = ((0.30, 0.73), (-0.31, 0.31))
"""x and y between which a hand comes behind the circle on every side."""
PROBED = 100
"""Scenes of each task from which places are read by linear regression."""
PROBE_SEED = 991
PENALTY = 1e-3


def failure(task: str, scene: NDArray[np.float32], told: dict[str, Any], hand: NDArray[np.float32]) -> str:
    """How an episode that is no success ended, see above; ``hand`` is the last measured pose ``(8,)``."""
    circle, triangle, below = told["circle"], told["triangle"], support(scene, CIRCLE)
    if any(place[2] < below for place in (circle, triangle)):
        return "fell"
    others = {name: shape for name, shape in outlines(scene).items() if name in (WHITE, BOWL) or (name == BOOK and not below)}
    shape = outline(CIRCLE, float(circle[0]), float(circle[1]), 0.0)
    if any(gap(shape, other) <= 2 * TOUCH for other in others.values()):
        return "wrong object"
    if any(not low < value < high for value, (low, high) in zip(circle[:2], OUT, strict=True)):
        return "rim"
    low = hand[2] <= below + PUSH_HEIGHT + 3 * LOW
    if low and np.linalg.norm(circle[:2] - hand[:2]) <= FARTHEST and abs(off(hand, circle, triangle)) > WIDEST:
        return "beside"
    return "timeout"


def off(hand: NDArray[Any], circle: NDArray[Any], goal: NDArray[Any]) -> float:
    """Radians of the hand off the line behind the circle."""
    to = complex(*(circle[:2] - hand[:2])) / complex(*(goal[:2] - circle[:2]))
    return math.atan2(to.imag, to.real)


def expert_action(task: str, hand: NDArray[Any], places: dict[str, NDArray[Any]], below: float) -> NDArray[np.float32]:
    """What the expert does next ``(4,)`` with a hand at ``(3,)`` and things at places ``(2,)``."""
    circle, goal = places[CIRCLE][:2], places[TRIANGLE][:2]
    if task == AROUND_BOWL:
        goal = around(circle, goal, places[BOWL][:2])
    manner = Manner(below + PUSH_HEIGHT, SPEED / (SLOWER if task == PUSH_ON_BOOK else 1.0))
    return np.array([*pushed(hand.astype(np.float64), circle, goal, manner), 0.0], dtype=np.float32)


class Halved(TableTopEnvironment):
    """In which the expert acts in place of who asks, until the hand is behind the circle or from then on."""

    task: str
    expert_first: bool

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        self._behind = False
        return super().reset(seed=seed, options=options)

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        places, below = self.places(), support(self.scene, CIRCLE)
        goal, hand = places[TRIANGLE][:2], self.command[:3]
        if self.task == AROUND_BOWL:
            goal = around(places[CIRCLE][:2], goal, places[BOWL][:2])
        near = hand[2] <= below + PUSH_HEIGHT + 3 * LOW and np.linalg.norm(places[CIRCLE][:2] - hand[:2]) <= FARTHEST
        self._behind = self._behind or bool(near)
        if self._behind != self.expert_first:
            action = expert_action(self.task, hand, places, below)
        return super().step(action)


def halved(task: str, expert_first: bool) -> Callable[[], TableTopEnvironment]:
    """Makes such environments."""
    kind = type("HalvedByExpert", (Halved,), {"task": task, "expert_first": expert_first})
    return kind


def probes(model: ConceptModel) -> dict[str, Tensor]:
    """Of each object weights ``(1 + features, 2)`` that tell its place from what the model reads of an image."""
    drawn = [initial_states(DOMAIN.source(None).starts(task, PROBED, PROBE_SEED).require_scenes()) for task in TASKS]  # type: ignore[union-attr]
    features = torch.cat([read(model, one.observed) for one in drawn])
    scenes = torch.cat([one.require_scenes() for one in drawn])
    found = {}
    for name in (CIRCLE, TRIANGLE, BOWL):
        there = scenes[:, COLUMNS[name].start] > 0.5
        inputs, places = features[there], scenes[there, COLUMNS[name].start + 1 : COLUMNS[name].start + 3].double()
        penalty = PENALTY * len(inputs) * torch.eye(inputs.shape[1], dtype=torch.double) * inputs.var(dim=0).mean()
        found[name] = torch.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ places)
    return found


def read(model: ConceptModel, observed: Observed) -> Tensor:
    """What a model reads of images, and 1: ``(image, 1 + features)``."""
    with torch.no_grad():
        features = model.of_images(observed)
    if features is None:
        raise UserError("--pretrained: expected a model that reads images, found one that does not")
    return torch.cat((torch.ones(len(features), 1), features), dim=1).double()


class ThroughEyes:
    """The expert as a policy that knows where things are from the model's features alone."""

    def __init__(self, model: ConceptModel, task: str, known: dict[str, Tensor], scenes: Tensor) -> None:
        self._model, self._task, self._known, self._scenes = model, task, known, scenes.numpy()
        self._commands: dict[int, NDArray[np.float32]] = {}

    def __call__(self, observed: Observed, rows: list[int], step: int) -> Tensor:
        features = read(self._model, observed)
        places = {name: (features @ weights).numpy() for name, weights in self._known.items()}
        actions = []
        for number, row in enumerate(rows):
            hand = self._commands.get(row, observed[POSE][number, :3].numpy())
            below = support(self._scenes[row], CIRCLE)
            action = expert_action(self._task, hand[:3], {name: found[number] for name, found in places.items()}, below)
            self._commands[row] = action
            actions.append(torch.from_numpy(action))
        return torch.stack(actions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pretrained", default="pretrained/tabletop", help="folder of the model")
    parser.add_argument("--concept", help="file of a learned concept, which is executed in place of the task's words")
    parser.add_argument("--task", action="append", choices=PUSHES, help="default: the two training pushes")
    parser.add_argument("--omega", type=float, default=1.2, help="weight of a concept in words")
    parser.add_argument("--count", type=int, default=100, help="scenes for each seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--ways", nargs="+", default=[MODEL, PUSHED, APPROACHED, EYES], help="which of the four")
    parser.add_argument("--out", help="JSON file")
    options = parser.parse_args()
    model, loop = load_model(options.pretrained), closed_loop_of(DOMAIN)
    known = probes(model) if EYES in options.ways else {}
    sampling = Sampling("dpm_solver", 5)
    tasks: dict[str, dict[str, Any]] = {}
    for task in options.task or [PUSH, AROUND_BOWL]:
        if options.concept:
            composition = Concept.load(options.concept).composition
        else:
            composition = Composition(model.concept(task)[None, None], torch.tensor([options.omega]))
        ends: dict[str, list[str]] = {way: [] for way in options.ways}
        rates: dict[str, list[float]] = {way: [] for way in options.ways}
        for seed in options.seeds:
            starts = DOMAIN.source(None).starts(task, options.count, 10_000 + seed)
            assert starts is not None
            scenes = starts.require_scenes()
            for way in options.ways:
                inside = replace(loop, environment=halved(task, way == PUSHED)) if way in (PUSHED, APPROACHED) else loop
                if way == EYES:
                    rollout = roll_out(inside, starts, ThroughEyes(model, task, known, scenes))
                else:
                    draws = [generator("cpu", seed, 1, episode) for episode in range(len(starts))]
                    make = sampled_plans(model, [composition] * len(starts), sampling, draws)
                    rollout = roll_out(inside, starts, PlanFollower(make, planner(model, loop), 8))
                right = DOMAIN.judge(task, rollout)["success"].tolist()
                rates[way].append(sum(right) / len(right))
                for good, scene, told, hand in zip(
                    right, scenes.numpy(), rollout.infos, rollout.observed[POSE][:, -1].numpy(), strict=True
                ):
                    ends[way].append("success" if good else failure(task, scene, told, hand))
                print(f"{task}, seed {seed}, {way}: {rates[way][-1]:.2f} {dict(Counter(ends[way]))}", flush=True)
        tasks[task] = {way: {"success": rates[way], "ends": dict(Counter(ends[way]))} for way in options.ways}
    if options.out:
        content = {
            "model": model.hash,
            "concept": Path(options.concept).name if options.concept else None,
            "count": options.count,
            "tasks": tasks,
        }
        write_text(options.out, json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
