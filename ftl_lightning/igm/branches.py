"""Denoiser interface, and noise estimates for several concepts (branches of the guidance formula) in a single forward pass."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

Context = tuple[Tensor, ...]
"""Output of a condition encoder's ``observe``, each ``(batch, ...)``; empty without observed features."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, knots, n), index (batch,), context) -> noise like x``, where
``index`` is each sample's row of ``concepts``."""


class Noised(NamedTuple):
    """Noisy plans.

    Attributes:
        x: noisy plans ``(batch, horizon, state)``.
        t: timesteps ``(batch,)``.
        context: encoded observed features of each plan.
    """

    x: Tensor
    t: Tensor
    context: Context

    def repeated(self, count: int) -> "Noised":
        """Tile the batch ``count`` times."""
        context = tuple(part.repeat(count, *(1,) * (part.dim() - 1)) for part in self.context)
        return Noised(self.x.repeat(count, 1, 1), self.t.repeat(count), context)

    def at(self, samples: Tensor) -> "Noised":
        """Select plans by index ``(sample,)``."""
        return Noised(self.x[samples], self.t[samples], tuple(part[samples] for part in self.context))


def branches(denoiser: Denoiser, noised: Noised, concepts: Tensor, index: Tensor) -> Tensor:
    """Estimate the noise of every plan in every branch, in a single forward pass.

    Args:
        denoiser: noise estimate with a single concept per sample.
        noised: noisy plans.
        concepts: ``(concept, knots, n)``.
        index: row of ``concepts`` for each branch and plan ``(branch, batch)`` int64.

    Returns:
        ``(branch, batch, horizon, state)``.
    """
    x, t, context = noised.repeated(len(index))
    return denoiser(x, t, concepts, index.flatten(), context).unflatten(0, index.shape)
