"""Compositions of concepts, and the composed denoiser, Eq. 2 of the paper: learning, sampling and composing all go through it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.errors import UserError

Context = tuple[Tensor, ...]
"""What a condition encoder read from the observed features, each ``(batch, ...)``; empty where nothing is observed."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, n), index (batch,), context) -> noise like x``, where ``index`` is
each sample's row of ``concepts``."""


@dataclass(frozen=True)
class Composition:
    """Concepts and the guidance weights with which they are composed; sums, differences and multiples are
    compositions too.

    Attributes:
        embeddings: ``(..., K, n)``.
        weights: ``(..., K)``, omega.
    """

    embeddings: Tensor
    weights: Tensor

    def __add__(self, other: "Composition") -> "Composition":
        return Composition(torch.cat((self.embeddings, other.embeddings), dim=-2), torch.cat((self.weights, other.weights), dim=-1))

    def __mul__(self, factor: float) -> "Composition":
        return Composition(self.embeddings, factor * self.weights)

    __rmul__ = __mul__

    def __neg__(self) -> "Composition":
        return -1.0 * self

    def __sub__(self, other: "Composition") -> "Composition":
        return self + -other

    def to(self, device: torch.device) -> "Composition":
        """The same on a device."""
        return Composition(self.embeddings.to(device), self.weights.to(device))


def batched(compositions: Sequence[Composition]) -> Composition:
    """Compositions ``(K, n)`` of maybe different K as one ``(composition, most K, n)``, padded with weights of zero."""
    return Composition(
        nn.utils.rnn.pad_sequence([one.embeddings for one in compositions], batch_first=True),
        nn.utils.rnn.pad_sequence([one.weights for one in compositions], batch_first=True),
    )


def composed_epsilon(
    denoiser: Denoiser, x: Tensor, t: Tensor, composition: Composition, empty: Tensor, context: Context = ()
) -> Tensor:
    """``eps(x, empty) + sum_k w_k (eps(x, c_k) - eps(x, empty))``, all branches in one call of the network.

    While learning, the empty branch, which depends on no concept, is evaluated apart, without gradient.

    Args:
        denoiser: estimates noise for one concept a sample.
        x: noisy plans ``(batch, horizon, state)``: equally many, one after another, for each composition.
        t: timesteps ``(batch,)``.
        composition: ``(composition, K, n)``; K may be 0.
        empty: the empty concept ``(n,)``.
        context: of each sample.

    Returns:
        ``(batch, horizon, state)``.
    """
    concepts, weights = composition.embeddings, composition.weights
    compositions, count = concepts.shape[:2]
    own = torch.arange(compositions, device=x.device).repeat_interleave(len(x) // compositions)  # each sample's composition

    def evaluate(concepts: Tensor, index: Tensor) -> Tensor:
        """Noise ``(branch, batch, horizon, state)`` for ``index (branch, batch)`` into ``concepts``."""
        k = len(index)
        every = tuple(part.repeat(k, *(1,) * (part.dim() - 1)) for part in context)
        return denoiser(x.repeat(k, 1, 1), t.repeat(k), concepts, index.flatten(), every).unflatten(0, (k, len(x)))

    nothing = torch.zeros_like(own)[None]
    rows = own * count + torch.arange(count, device=x.device)[:, None]  # (K, batch), into the flattened concepts
    if torch.is_grad_enabled() and count:
        with torch.no_grad():
            unconditional = evaluate(empty[None], nothing)[0]
        conditional = evaluate(concepts.flatten(0, 1), rows)
    else:
        branches = evaluate(torch.cat((empty[None], concepts.flatten(0, 1))), torch.cat((nothing, rows + 1)))
        unconditional, conditional = branches[0], branches[1:]
    return unconditional + torch.einsum("bk,kbhs->bhs", weights[own], conditional - unconditional)


def parse_composition(text: str) -> list[tuple[str, float]]:
    """Concepts and weights from ``'circle right of square:1.2 + triangle above circle'``; a missing weight is 1.

    Raises:
        UserError: for a weight that is no finite number, or an empty concept.
    """
    parts = []
    for part in text.split(" + ") if text.strip() else ():
        concept, colon, weight = part.partition(":")
        try:
            omega = float(weight) if colon else 1.0
        except ValueError:
            omega = math.nan
        if not concept.strip() or not math.isfinite(omega):
            raise UserError(f"compose: expected 'concept:weight + concept:weight' with finite numbers as weights, found {part!r}")
        parts.append((concept.strip(), omega))
    return parts
