"""What a denoiser is, and how it estimates the noise of plans for several concepts, the branches of the formula, in one call."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

Context = tuple[Tensor, ...]
"""What a condition encoder read from the observed features, each ``(batch, ...)``; empty where nothing is observed."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, knots, n), index (batch,), context) -> noise like x``, where
``index`` is each sample's row of ``concepts``."""


class Noised(NamedTuple):
    """Plans whose noise is estimated.

    Attributes:
        x: noisy plans ``(batch, horizon, state)``.
        t: timesteps ``(batch,)``.
        context: what was read from the observed features of each.
    """

    x: Tensor
    t: Tensor
    context: Context

    def repeated(self, count: int) -> "Noised":
        """All plans so many times, one time after the other."""
        context = tuple(part.repeat(count, *(1,) * (part.dim() - 1)) for part in self.context)
        return Noised(self.x.repeat(count, 1, 1), self.t.repeat(count), context)

    def at(self, samples: Tensor) -> "Noised":
        """Some plans, by their numbers ``(sample,)``."""
        return Noised(self.x[samples], self.t[samples], tuple(part[samples] for part in self.context))


def branches(denoiser: Denoiser, noised: Noised, concepts: Tensor, index: Tensor) -> Tensor:
    """Noise of every plan in every branch, in one call of the network.

    Args:
        denoiser: estimates noise for one concept a sample.
        noised: the plans.
        concepts: ``(concept, knots, n)``.
        index: each plan's row of ``concepts`` in each branch ``(branch, batch)`` int64.

    Returns:
        ``(branch, batch, horizon, state)``.
    """
    x, t, context = noised.repeated(len(index))
    return denoiser(x, t, concepts, index.flatten(), context).unflatten(0, index.shape)
