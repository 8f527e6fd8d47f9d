"""Normalisation of states to [-1, 1], stored with the model."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

RELATIVE = {torch.float32: 1e-6, torch.float64: 1e-13}
"""Minimum range of a column, as a share of its largest number; less counts as constant, the precision of the type."""


class Normalization(nn.Module):
    """Column-wise min-max to [-1, 1]. A constant column maps to 0 and back to its value.

    Args:
        low, high: ``(state,)`` float32, or float64 for such data; extremes of pretraining data. A column with ``high <= low`` is
            constant.
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    @classmethod
    def fit(cls, states: Tensor, shared: Sequence[Sequence[int]] = (), resolution: float = 0.0, plane: Sequence[int] = ()) -> Self:
        """Fit to states ``(..., state)``.

        Args:
            states: in the domain's units.
            shared: columns of each exchangeable entity, in the same order; corresponding columns share their extremes.
            resolution: minimum range of a column, in the domain's units; less is rounding, which scaling would amplify, and counts
                as constant.
            plane: columns that are rotated together, which share a scale with the middle 0.
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
        rounding = RELATIVE[flat.dtype] * torch.maximum(low.abs(), high.abs())
        return cls(low, torch.where(high - low < torch.clamp(rounding, min=resolution), low, high))

    def share(self, columns: Sequence[int], other: Self) -> None:
        """Copy the scale of another normalisation to as many columns."""
        self.low[list(columns)], self.high[list(columns)] = other.low, other.high

    @property
    def _half_width(self) -> Tensor:
        return ((self.high - self.low) / 2).clamp(min=0)

    def encode(self, states: Tensor) -> Tensor:
        """Normalise ``(..., state)`` to float32 from the domain's units; values outside the extremes go beyond [-1, 1]."""
        half = self._half_width
        varies = half > 0
        return torch.where(varies, (states - self.low) / torch.where(varies, half, 1) - 1, 0).float()

    def decode(self, normalised: Tensor) -> Tensor:
        """Invert :meth:`encode`."""
        return self.low + (normalised + 1) * self._half_width
