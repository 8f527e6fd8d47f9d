"""Normalisation of states to [-1, 1], kept with the model."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

RELATIVE = 1e-6
"""A column that varies by less than this share of its largest number counts as constant: float32 holds no more."""


class Normalization(nn.Module):
    """Column-wise min-max to [-1, 1]. A constant column maps to 0 and back to its value.

    Args:
        low, high: ``(state,)``, the extremes seen in pretraining. Columns with ``high <= low`` are constant.
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low.float().clone())
        self.register_buffer("high", high.float().clone())

    @classmethod
    def fit(cls, states: Tensor, shared: Sequence[Sequence[int]] = (), resolution: float = 0.0, plane: Sequence[int] = ()) -> Self:
        """From states ``(..., state)``.

        Args:
            states: in the domain's units.
            shared: columns of each exchangeable entity, in the same order: what is a position for one is a position for all, so
                they share their extremes.
            resolution: in the domain's units: what varies less is rounding, which scaling to [-1, 1] would blow up, and counts as
                constant.
            plane: columns that are turned together: they share one scale, whose middle is 0.
        """
        flat = states.flatten(0, -2)
        low, high = flat.amin(dim=0), flat.amax(dim=0)
        if shared:
            columns = torch.tensor([list(entity) for entity in shared])
            low[columns] = low[columns].amin(dim=0).expand(columns.shape)
            high[columns] = high[columns].amax(dim=0).expand(columns.shape)
        if plane:
            columns = torch.tensor(list(plane))
            high[columns] = torch.maximum(high[columns], -low[columns]).amax()
            low[columns] = -high[columns]
        rounding = RELATIVE * torch.maximum(low.abs(), high.abs())
        return cls(low, torch.where(high - low < torch.clamp(rounding, min=resolution), low, high))

    def share(self, columns: Sequence[int], other: Self) -> None:
        """Bring some columns on the scale of another normalisation's, of which there are as many."""
        self.low[list(columns)], self.high[list(columns)] = other.low, other.high

    @property
    def _half_width(self) -> Tensor:
        return ((self.high - self.low) / 2).clamp(min=0)

    def encode(self, states: Tensor) -> Tensor:
        """``(..., state)`` in the domain's units to normalised; values outside the extremes go beyond [-1, 1]."""
        half = self._half_width
        varies = half > 0
        return torch.where(varies, (states - self.low) / torch.where(varies, half, 1) - 1, 0)

    def decode(self, normalised: Tensor) -> Tensor:
        """The inverse of :meth:`encode`."""
        return self.low + (normalised + 1) * self._half_width
