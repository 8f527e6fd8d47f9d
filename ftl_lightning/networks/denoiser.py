"""Common inputs of denoisers: the domain's sizes and the timestep embedding."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ftl_lightning.data.features import Feature


@dataclass(frozen=True)
class Sizes:
    """Sizes of a domain, the first argument of every denoiser.

    Attributes:
        horizon: number of states in a plan.
        state_dim: columns of a state.
        concept_dim: columns of a concept embedding.
        observed: features that condition the denoiser, by name; may be empty.
        image_dim: number of features of the observed images, which follow the observed vectors.
        plane: columns of a state with x and y in the coordinates of image points.
    """

    horizon: int
    state_dim: int
    concept_dim: int
    observed: Mapping[str, Feature] = field(default_factory=dict)
    image_dim: int = 0
    plane: tuple[int, ...] = ()

    @property
    def measured_dim(self) -> int:
        """Number of columns of the concatenated observed vectors."""
        return sum(feature.size for feature in self._vectors)

    @property
    def vector_dim(self) -> int:
        """Number of input columns: observed vectors and image features."""
        return self.measured_dim + self.image_dim

    @property
    def columns(self) -> dict[str, slice]:
        """Input columns of each observed vector, by name."""
        placed = dict(zip((name for name, feature in self.observed.items() if feature.kind == "vector"), self._placed, strict=True))
        return {name: slice(start, start + feature.size) for name, (start, feature) in placed.items()}

    @property
    def entities(self) -> tuple[tuple[int, ...], ...]:
        """Input columns of each exchangeable entity."""
        return tuple(tuple(start + column for column in entity) for start, feature in self._placed for entity in feature.entities)

    @property
    def attributes(self) -> tuple[int, ...]:
        """Attribute columns of an entity, relative to its first, to which concepts refer; empty for all."""
        return next((feature.attributes for feature in self._vectors if feature.attributes), ())

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Columns of the observed vectors with the plan's initial state; may be empty."""
        return tuple(start + column for start, feature in self._placed for column in feature.state)

    @property
    def _vectors(self) -> list[Feature]:
        return [feature for feature in self.observed.values() if feature.kind == "vector"]

    @property
    def _placed(self) -> list[tuple[int, Feature]]:
        """First column and feature of each vector."""
        sizes = [feature.size for feature in self._vectors]
        return list(zip(itertools.accumulate(sizes, initial=0), self._vectors, strict=False))


def sinusoidal_embedding(t: Tensor, dimension: int, period: float = 10_000.0) -> Tensor:
    """Sinusoidal features ``(batch, dimension)`` of timestep ``t (batch,)`` (Vaswani et al., 2017); ``dimension`` is even."""
    half = dimension // 2
    frequency = torch.exp(torch.arange(half, device=t.device) * (-math.log(period) / (half - 1)))
    angle = t[:, None] * frequency
    return torch.cat((angle.sin(), angle.cos()), dim=-1)
