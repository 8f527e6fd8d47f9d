"""The paper's two metrics of navigation: progress to the target (open loop) and reaching it first (closed loop)."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.domains.agent.scenes import REACH, object_positions, target


def distances(positions: Tensor, initial_states: Tensor) -> Tensor:
    """Distances in metres ``(scene, time, 2 objects)`` of an agent's positions to both objects.

    Args:
        positions: ``(scene, time, 3)``.
        initial_states: ``(scene, 52)``.
    """
    return torch.linalg.vector_norm(positions[:, :, None] - object_positions(initial_states)[:, None], dim=-1)


def _to_each(goal: str, positions: Tensor, initial_states: Tensor) -> tuple[Tensor, Tensor]:
    """Distances ``(scene, time)`` to the target and to the distractor."""
    both = distances(positions, initial_states)
    chosen = target(goal, initial_states)[:, None, None].expand(-1, both.shape[1], 1)
    return both.gather(-1, chosen)[..., 0], both.gather(-1, 1 - chosen)[..., 0]


def progressed(goal: str, states: Tensor, initial_states: Tensor | None) -> Tensor:
    """Whether a plan ends nearer to the target than the agent starts (paper, open loop).

    Args:
        goal: the task in words.
        states: plans ``(scene, horizon, 13)``.
        initial_states: ``(scene, 52)``.

    Returns:
        ``(scene,)`` of bool; false where a plan is not finite.
    """
    assert initial_states is not None
    start = initial_states[:, None, :3]
    to_target, _ = _to_each(goal, torch.cat((start, states[:, -1:, :3]), dim=1), initial_states)
    return to_target[:, -1] < to_target[:, 0]


def reached(goal: str, observations: Tensor, infos: Sequence[Mapping[str, Any]] = ()) -> dict[str, Tensor]:
    """What happened in episodes (paper, closed loop).

    Args:
        goal: the task in words.
        observations: ``(episode, time, 52)``, padded with the last one.
        infos: not used; observations tell everything.

    Returns:
        ``(episode,)`` of bool each: ``success``, the agent ends within :data:`REACH` of the target and was never that near to
        the distractor; ``distractor``, it was; ``progress``, it ends nearer to the target than it started.
    """
    to_target, to_distractor = _to_each(goal, observations[..., :3], observations[:, 0])
    touched = (to_distractor < REACH).any(dim=1)
    return {
        "success": (to_target[:, -1] < REACH) & ~touched,
        "distractor": touched,
        "progress": to_target[:, -1] < to_target[:, 0],
    }
