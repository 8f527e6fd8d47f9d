"""What every denoiser takes: the domain's sizes, and features of the timestep."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Sizes:
    """What a denoiser has to know of the domain, the first argument of each.

    Attributes:
        horizon: states in a plan.
        state_dim: columns of a state.
        concept_dim: columns of a concept embedding.
        initial_state_dim: columns of the initial state; 0 where the domain has none.
        entities: columns of the initial state for each exchangeable entity, in the same order for each.
        looks: which of an entity's columns, counted from its first, a concept asks for; all where empty.
    """

    horizon: int
    state_dim: int
    concept_dim: int
    initial_state_dim: int = 0
    entities: tuple[tuple[int, ...], ...] = ()
    looks: tuple[int, ...] = ()


def sinusoidal_embedding(t: Tensor, dimension: int, period: float = 10_000.0) -> Tensor:
    """``(batch, dimension)`` features of the timestep ``t (batch,)`` (Vaswani et al., 2017); ``dimension`` is even."""
    half = dimension // 2
    frequency = torch.exp(torch.arange(half, device=t.device) * (-math.log(period) / (half - 1)))
    angle = t[:, None] * frequency
    return torch.cat((angle.sin(), angle.cos()), dim=-1)
