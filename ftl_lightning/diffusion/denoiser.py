"""What every denoiser takes: the domain's sizes, and features of the timestep."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import Feature


@dataclass(frozen=True)
class Sizes:
    """What a denoiser has to know of the domain, the first argument of each.

    Attributes:
        horizon: states in a plan.
        state_dim: columns of a state.
        concept_dim: columns of a concept embedding.
        observed: features that it is conditioned on, by name; empty where there are none.
        image_dim: numbers that are read of the observed images, which stand behind the observed vectors.
        plane: columns of a state that are x and y in the coordinates of points that are read of images.
    """

    horizon: int
    state_dim: int
    concept_dim: int
    observed: Mapping[str, Feature] = field(default_factory=dict)
    image_dim: int = 0
    plane: tuple[int, ...] = ()

    @property
    def measured_dim(self) -> int:
        """Columns of the observed vectors one after another."""
        return sum(feature.size for feature in self._vectors)

    @property
    def vector_dim(self) -> int:
        """The same with what is read of the images behind them: all that a network is given."""
        return self.measured_dim + self.image_dim

    @property
    def columns(self) -> dict[str, slice]:
        """Where each observed vector stands in those, by name."""
        placed = dict(zip((name for name, feature in self.observed.items() if feature.kind == "vector"), self._placed, strict=True))
        return {name: slice(start, start + feature.size) for name, (start, feature) in placed.items()}

    @property
    def entities(self) -> tuple[tuple[int, ...], ...]:
        """Columns of each exchangeable entity in those."""
        return tuple(tuple(start + column for column in own) for start, feature in self._placed for own in feature.entities)

    @property
    def attributes(self) -> tuple[int, ...]:
        """Which of an entity's columns, counted from its first, a concept asks for; all where empty."""
        return next((feature.attributes for feature in self._vectors if feature.attributes), ())

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Columns of the observed vectors that hold the state a plan starts from; none where they hold no such state."""
        return tuple(start + column for start, feature in self._placed for column in feature.state)

    @property
    def _vectors(self) -> list[Feature]:
        return [feature for feature in self.observed.values() if feature.kind == "vector"]

    @property
    def _placed(self) -> list[tuple[int, Feature]]:
        """Each vector after the column at which it begins."""
        sizes = [feature.size for feature in self._vectors]
        return list(zip(itertools.accumulate(sizes, initial=0), self._vectors, strict=False))


def sinusoidal_embedding(t: Tensor, dimension: int, period: float = 10_000.0) -> Tensor:
    """``(batch, dimension)`` features of the timestep ``t (batch,)`` (Vaswani et al., 2017); ``dimension`` is even."""
    half = dimension // 2
    frequency = torch.exp(torch.arange(half, device=t.device) * (-math.log(period) / (half - 1)))
    angle = t[:, None] * frequency
    return torch.cat((angle.sin(), angle.cos()), dim=-1)
