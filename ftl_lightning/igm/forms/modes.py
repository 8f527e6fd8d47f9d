"""Modes of a concept: several sets of embeddings for multimodal behaviour."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ftl_lightning.services.text import Shown, counted

STRETCH = 1.5
"""Default factor by which mixtures are moved away from the modes' mean: convex combinations vary less than the modes."""


def even_stretch(modes: int) -> float:
    """Stretch with which mixtures have the variance of the behaviour that the modes were drawn from.

    Mixtures with uniform shares on the simplex have 1 / (modes + 1) of the modes' variance, which is (modes - 1) / modes of the
    behaviour's.
    """
    return ((modes + 1) * modes / (modes - 1)) ** 0.5 if modes > 1 else 1.0


def explained(empty: Tensor, single: Tensor, modes: Tensor) -> Tensor:
    """Loss reduction by a single set of embeddings, as a share of the loss reduction by modes.

    Args:
        empty: loss of the empty concept, from which both reductions are measured ``(...)``.
        single: loss of a single set of embeddings for all demonstrations, in the same shape.
        modes: mean loss of the modes, in the same shape.
    """
    return (empty - single) / (empty - modes)


@dataclass(frozen=True, repr=False)
class Modes(Shown):
    """Several sets of embeddings of a concept with multimodal behaviour.

    Attributes:
        embeddings: ``(mode, K, knots, n)``.
        weights: ``(mode, K)``, omega.
        mixed: whether a sample uses a random mixture of the modes, for concepts that a single set of embeddings describes well,
            or a single random mode.
        stretch: factor by which mixtures are moved away from the modes' mean, relative to convex combinations.
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
        """Move all tensors to a device."""
        return replace(self, embeddings=self.embeddings.to(device), weights=self.weights.to(device))

    def with_each(self, other: "Modes") -> "Modes":
        """Combine the modes of two concepts pairwise, the other's changing first; mixed if either is mixed."""

        def paired(first: Tensor, second: Tensor) -> Tensor:
            outer = first.repeat_interleave(len(second), dim=0)
            inner = second.repeat(len(first), *(1,) * (second.dim() - 1))
            return torch.cat((outer, inner), dim=1)

        embeddings, weights = paired(self.embeddings, other.embeddings), paired(self.weights, other.weights)
        return Modes(embeddings, weights, mixed=self.mixed or other.mixed, stretch=max(self.stretch, other.stretch))

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Draw modes or mixtures of ``count`` samples with ``generator``.

        Returns embeddings ``(row, K, knots, n)``, weights ``(row, K)``, and the row of each sample ``(count,)``.

        A mixture is ``mean + stretch * sum_m share_m (mode_m - mean)`` with shares uniform on the simplex (Dirichlet(1)).
        """
        if not self.mixed:
            chosen = torch.randint(len(self), (count,), generator=generator, device=generator.device)
            return self.embeddings, self.weights, chosen.to(self.weights.device)
        even = torch.empty(count, len(self), device=generator.device).exponential_(generator=generator)
        shares = (even / even.sum(dim=1, keepdim=True)).to(self.weights.device)
        shares = self.stretch * shares + (1 - self.stretch) / len(self)
        embeddings = torch.einsum("sm,m...->s...", shares, self.embeddings)
        return embeddings, shares @ self.weights, torch.arange(count, device=self.weights.device)
