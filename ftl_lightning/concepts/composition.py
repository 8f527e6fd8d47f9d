"""The composed denoiser, Eq. 2 of the paper: learning, sampling and composing all go through it."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ftl_lightning.errors import UserError

Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor | None], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, n), index (batch,), s0 (batch, m) or None) -> noise like x``,
where ``index`` is each sample's row of ``concepts``."""


def composed_epsilon(
    denoiser: Denoiser,
    x: Tensor,
    t: Tensor,
    concepts: Tensor,
    weights: Tensor,
    empty: Tensor,
    initial_state: Tensor | None = None,
) -> Tensor:
    """``eps(x, empty) + sum_k w_k (eps(x, c_k) - eps(x, empty))``, all branches in one call of the network.

    While learning, the empty branch, which depends on no concept, is evaluated apart, without gradient.

    Args:
        denoiser: estimates noise for one concept a sample.
        x: noisy plans ``(batch, horizon, state)``: equally many, one after another, for each composition.
        t: timesteps ``(batch,)``.
        concepts: ``(composition, K, n)``; K may be 0.
        weights: ``(composition, K)``, the guidance weights omega.
        empty: the empty concept ``(n,)``.
        initial_state: ``(batch, m)`` or ``None``.

    Returns:
        ``(batch, horizon, state)``.
    """
    compositions, count = concepts.shape[:2]
    own = torch.arange(compositions, device=x.device).repeat_interleave(len(x) // compositions)  # each sample's composition

    def evaluate(concepts: Tensor, index: Tensor) -> Tensor:
        """Noise ``(branch, batch, horizon, state)`` for ``index (branch, batch)`` into ``concepts``."""
        k = len(index)
        s0 = None if initial_state is None else initial_state.repeat(k, 1)
        return denoiser(x.repeat(k, 1, 1), t.repeat(k), concepts, index.flatten(), s0).unflatten(0, (k, len(x)))

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
