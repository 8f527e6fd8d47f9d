"""Modes of a concept: several sets of embeddings, for behaviours that are right in different ways."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ftl_lightning.representation import Shown, counted

STRETCH = 1.5
"""Mixtures of modes lie so much farther from the modes' mean than convex combinations: these alone vary less than the modes do."""


def even_stretch(modes: int) -> float:
    """The stretch with which mixtures of so many modes vary as much as the behaviour that the modes were drawn from.

    Shares even on the simplex have 1 / (modes + 1) of the variance of single modes, which have (modes - 1) / modes of that of what
    they are a sample of.
    """
    return ((modes + 1) * modes / (modes - 1)) ** 0.5 if modes > 1 else 1.0


@dataclass(frozen=True, repr=False)
class Modes(Shown):
    """Several sets of embeddings of one concept: behaviours that are right in different ways.

    Attributes:
        embeddings: ``(mode, K, knots, n)``.
        weights: ``(mode, K)``, omega.
        mixed: whether a sample is generated from a random mixture of the modes, which suits concepts of which one set of embeddings
            says enough, or from one mode, drawn at random.
        stretch: of mixtures: how much farther from the modes' mean they lie than convex combinations.
    """

    embeddings: Tensor
    weights: Tensor
    mixed: bool = False
    stretch: float = STRETCH

    def __len__(self) -> int:
        return len(self.weights)

    def _words(self) -> Iterator[str]:
        yield counted(len(self), "mode")
        yield f"K = {self.weights.shape[-1]}"
        if self.mixed:
            yield "mixed"

    def __mul__(self, factor: float) -> "Modes":
        return replace(self, weights=factor * self.weights)

    def to(self, device: torch.device) -> "Modes":
        """The same on a device."""
        return replace(self, embeddings=self.embeddings.to(device), weights=self.weights.to(device))

    def with_each(self, other: "Modes") -> "Modes":
        """The sum of two concepts: each of these modes with each of the other's, the other's changing first; mixed where either
        is.
        """

        def paired(first: Tensor, second: Tensor) -> Tensor:
            outer = first.repeat_interleave(len(second), dim=0)
            inner = second.repeat(len(first), *(1,) * (second.dim() - 1))
            return torch.cat((outer, inner), dim=1)

        embeddings, weights = paired(self.embeddings, other.embeddings), paired(self.weights, other.weights)
        return Modes(embeddings, weights, mixed=self.mixed or other.mixed, stretch=max(self.stretch, other.stretch))

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """What ``count`` samples are generated from: embeddings ``(row, K, knots, n)``, weights ``(row, K)``, and each sample's
        row ``(count,)``.

        A mixture is ``mean + stretch * sum_m share_m (mode_m - mean)``, the shares even on the simplex (Dirichlet(1)).

        Args:
            count: of samples.
            generator: decides their modes, or shares.
        """
        if not self.mixed:
            chosen = torch.randint(len(self), (count,), generator=generator, device=generator.device)
            return self.embeddings, self.weights, chosen.to(self.weights.device)
        even = torch.empty(count, len(self), device=generator.device).exponential_(generator=generator)
        shares = (even / even.sum(dim=1, keepdim=True)).to(self.weights.device)
        shares = self.stretch * shares + (1 - self.stretch) / len(self)
        embeddings = torch.einsum("sm,m...->s...", shares, self.embeddings)
        return embeddings, shares @ self.weights, torch.arange(count, device=self.weights.device)
