"""The paper's metrics of navigation: progress to the target (open loop) and reaching it first (closed loop)."""

import torch
from torch import Tensor

from ftl_lightning.data.features import InitialStates, check_starts
from ftl_lightning.domains.agent.scenes import OBSERVED, REACH, object_positions, target
from ftl_lightning.domains.execution import Rollout


def distances(positions: Tensor, world: Tensor) -> Tensor:
    """Distances in metres ``(scene, time, 2 objects)`` of agent positions to both objects.

    Args:
        positions: ``(scene, time, 3)``.
        world: ``(scene, 52)``.
    """
    return torch.linalg.vector_norm(positions[:, :, None] - object_positions(world)[:, None], dim=-1)


def _to_each(goal: str, positions: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
    """Distances ``(scene, time)`` to the target and to the distractor."""
    both = distances(positions, world)
    chosen = target(goal, world)[:, None, None].expand(-1, both.shape[1], 1)
    return both.gather(-1, chosen)[..., 0], both.gather(-1, 1 - chosen)[..., 0]


def progressed(goal: str, states: Tensor, starts: InitialStates | None) -> Tensor:
    """Whether a plan ends nearer to the target than it starts (paper, open loop).

    Args:
        goal: the task in words.
        states: plans ``(scene, horizon, 13)``.
        starts: initial states with ``world (scene, 52)``.

    Returns:
        ``(scene,)`` of bool; false where a plan is not finite.
    """
    world = check_starts(starts).observed[OBSERVED]
    to_target, _ = _to_each(goal, torch.cat((world[:, None, :3], states[:, -1:, :3]), dim=1), world)
    return to_target[:, -1] < to_target[:, 0]


def reached(goal: str, rollout: Rollout) -> dict[str, Tensor]:
    """Outcomes of episodes (paper, closed loop).

    Args:
        goal: the task in words.
        rollout: episodes with ``world (episode, time, 52)``, padded with the last.

    Returns:
        ``(episode,)`` of bool each: ``success``, the agent ends within :data:`REACH` of the target and never was within
        :data:`REACH` of the distractor; ``distractor``, it was; ``progress``, it ends nearer to the target.
    """
    world = rollout.observed[OBSERVED]
    to_target, to_distractor = _to_each(goal, world[..., :3], world[:, 0])
    touched = (to_distractor < REACH).any(dim=1)
    return {
        "success": (to_target[:, -1] < REACH) & ~touched,
        "distractor": touched,
        "progress": to_target[:, -1] < to_target[:, 0],
    }
