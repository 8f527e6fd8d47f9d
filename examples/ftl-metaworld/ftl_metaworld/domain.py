"""Domain objects of Meta-World: ML10, ML45, and ML45 with five of its training tasks left out in turn."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Feature, InitialStates, Observed
from ftl_lightning.domains.comparison import Comparison
from ftl_lightning.domains.domain import EXECUTED, Concepts, Domain, Plans, View, deferred
from ftl_lightning.domains.execution import ClosedLoop, Policy, Rollout
from ftl_lightning.domains.pictures import Show
from ftl_metaworld.environment import COLUMNS, FIRST, GOAL, GRIPPER, HAND, MAX_STEPS, SECOND, UNITS, WORLD, MetaWorld
from ftl_metaworld.tasks import NUMBER, NUMBERS, suites, texts

if TYPE_CHECKING:
    from ftl_metaworld.source import Experts

HERE = Path(__file__).parent
HORIZON = 17
NEAR = 0.1
"""Scale in metres of compressed distances."""


def _compressed(way: Tensor) -> Tensor:
    """Displacements ``(sample, 3)`` with distances below 1: fine where they are small."""
    return way / (NEAR + way.norm(dim=1, keepdim=True))


def relative(observed: Observed) -> Observed:
    """The world, with the places of objects and goal also relative to the hand and to each other ``(sample, 52)``."""
    world = observed["world"]
    hand, gripper, goal = world[:, HAND], world[:, GRIPPER], world[:, GOAL]
    first, second = (world[:, columns] for columns in (FIRST, SECOND))
    places, present = [first[:, :3], second[:, :3]], [part.abs().sum(dim=1, keepdim=True) > 0 for part in (first, second)]
    ways = [(place - hand) * there for place, there in zip(places, present, strict=True)]
    ways += [goal - hand, (goal - places[0]) * present[0], (places[1] - places[0]) * present[1]]
    turns = [first[:, 3:], second[:, 3:]]
    seen = (hand, gripper, *places, goal, *turns, present[1].float(), *ways, *map(_compressed, ways))
    return {"world": torch.cat(seen, dim=1)}


RELATIVE = View(
    {"world": Feature((52,))}, relative, lambda states, observed: states, lambda states, observed: states, same_columns=True
)


def act(plans: Tensor, step: int, observed: Observed) -> Tensor:
    """Next action ``(episode, 4)`` of plans, whose first is the action before the present."""
    return plans[:, min(step + 1, plans.shape[1] - 1)].clamp(-1, 1)


def judge(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Success as Meta-World defines it: its criterion holds at any step; of no scene of another task."""
    same = rollout.starts.require_scenes()[:, 0] == NUMBER[goal]
    success = torch.tensor([bool(info.get("success")) for info in rollout.infos])
    return {"success": success & same & ~rollout.failed}


def expert(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy:
    """The scripted expert, without noise."""
    from ftl_metaworld.source import expert_policy

    return expert_policy(starts)


def shifted(goal: str, starts: InitialStates, demonstrations: Demonstrations | None, seed: int) -> Policy | None:
    """The demonstration whose objects lie nearest, moved with the object and, near the goal, with the goal.

    The hand follows the demonstrated path by position; the gripper does as demonstrated. Nothing is learned.
    """
    if demonstrations is None:
        return None
    shown, present = demonstrations.observed["world"], starts.observed["world"]
    places = [slice(FIRST.start, FIRST.start + 3), slice(SECOND.start, SECOND.start + 3), GOAL]
    apart = sum((present[:, None, columns] - shown[None, :, 0, columns]).norm(dim=2) for columns in places)
    row = apart.argmin(dim=1)
    path = shown[row][..., HAND]  # (episode, time, 3)
    efforts = demonstrations.states[row][..., 3]
    moves = torch.stack([present[:, columns] - shown[row, 0, columns] for columns in places], dim=1)  # (episode, place, 3)
    distances = torch.stack([(path - shown[row, :1, columns]).norm(dim=2) for columns in places], dim=2)
    there = torch.stack([present[:, columns].abs().sum(dim=1) > 0 for columns in places], dim=1)
    shares = (1 / (0.02 + distances).square() * there[:, None]).clamp(min=1e-9)
    path = path + (shares / shares.sum(dim=2, keepdim=True)) @ moves
    last = demonstrations.lengths[row] - 1

    def policy(observed: Observed, rows: list[int], step: int) -> Tensor:
        chosen = torch.tensor(rows)
        at = last[chosen].minimum(torch.tensor(step + 1))
        error = path[chosen, at] - observed["world"][:, HAND]
        return torch.cat((25 * error, efforts[chosen, at][:, None]), dim=1).clamp(-1, 1)

    return policy


def source(root: Path | None, training: tuple[str, ...], name: str) -> "Experts":
    """Scripted experts of the training tasks."""
    from ftl_metaworld.source import Experts

    return Experts(training, name)


def domain(name: str, training: tuple[str, ...], new: tuple[str, ...]) -> Domain:
    """Meta-World with some training and test tasks."""
    return Domain(
        name=name,
        plans=Plans(HORIZON, COLUMNS, UNITS, views={"relative": RELATIVE}),
        concepts=Concepts(training, suites(training, new), table=HERE / "embeddings.safetensors"),
        source=partial(source, training=training, name=name),
        observed={"world": Feature((WORLD,))},
        show=Show(deferred("ftl_metaworld.rendering:render")),
        closed_loop=ClosedLoop(
            environment=MetaWorld,
            act=act,
            steps=MAX_STEPS,
            judge=judge,
            film=deferred("ftl_metaworld.rendering:film"),
            vector_film=deferred("ftl_metaworld.rendering:vector_film"),
            policies={"expert (oracle)": expert, "shifted demonstration": shifted},
        ),
        comparison=Comparison(headline=EXECUTED, fresh=False),
    )


ML10 = domain("ml10", texts(ml10=["train"]), texts(ml10=["test"]))
ML45 = domain("ml45", texts(ml45=["train"]), texts(ml45=["test"]))
FOLDS = tuple(
    domain(f"ml45-{fold}", texts(fold=[other for other in NUMBERS if other != fold]), texts(fold=[fold])) for fold in NUMBERS
)
"""ML45's training tasks without those of a fold, which are new."""
