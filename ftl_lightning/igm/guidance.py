"""The composed denoiser, Eq. 2 of the paper, for learning, sampling and composing."""

import torch
from torch import Tensor

from ftl_lightning.igm.adapter import adapted_branches
from ftl_lightning.igm.branches import Context, Denoiser, Noised, branches
from ftl_lightning.igm.composition import Composition


def composed_epsilon(
    denoiser: Denoiser,
    x: Tensor,
    t: Tensor,
    composition: Composition,
    empty: Tensor,
    context: Context = (),
    row: Tensor | None = None,
) -> Tensor:
    """``eps(x, empty) + sum_k w_k (eps(x, c_k) - eps(x, empty))``, with all branches in a single forward pass.

    With gradients enabled, the unconditional branch ``eps(x, empty)`` is evaluated separately and without gradient. The branch of
    a concept with an adapter is evaluated by the modified denoiser.

    Args:
        denoiser: noise estimate with a single concept per sample.
        x: noisy plans ``(batch, horizon, state)``.
        t: timesteps ``(batch,)``.
        composition: ``(composition, K, ...)``; K may be 0.
        empty: unconditional embedding ``(n,)``.
        context: context of each sample.
        row: composition of each sample ``(batch,)`` int64; ``None`` for equally sized consecutive groups.

    Returns:
        ``(batch, horizon, state)``.
    """
    row = _in_turn(composition, x) if row is None else row
    noised, concepts, index = Noised(x, t, context), *_flat(composition, row)
    empty, first = empty.repeat(1, composition.knots, 1), torch.zeros_like(row)[None]
    if composition.adapters:
        unconditional, conditional = adapted_branches(denoiser, noised, composition, row, empty, concepts, index)
    elif torch.is_grad_enabled() and len(index):
        with torch.no_grad():
            unconditional = branches(denoiser, noised, empty, first)[0]
        conditional = branches(denoiser, noised, concepts, index)
    else:
        every = branches(denoiser, noised, torch.cat((empty, concepts)), torch.cat((first, index + 1)))
        unconditional, conditional = every[0], every[1:]
    return unconditional + weighted_sum(composition, row, conditional - unconditional)


def weighted_sum(composition: Composition, row: Tensor, differences: Tensor) -> Tensor:
    """``sum_k w_k differences_k`` with weights that may differ between the columns of a state.

    Args:
        composition: ``(composition, K, ...)``.
        row: composition of each sample ``(batch,)``.
        differences: ``(K, batch, horizon, state)``.

    Returns:
        ``(batch, horizon, state)``.
    """
    if composition.columns is None:
        return torch.einsum("bk,kbhs->bhs", composition.weights[row], differences)
    by_column = composition.weights[..., None] * composition.columns
    return torch.einsum("bks,kbhs->bhs", by_column[row], differences)


def _in_turn(composition: Composition, x: Tensor) -> Tensor:
    """Rows ``(batch,)`` for equally sized consecutive groups of samples."""
    count = len(composition.weights)
    return torch.arange(count, device=x.device).repeat_interleave(len(x) // count)


def _flat(composition: Composition, row: Tensor) -> tuple[Tensor, Tensor]:
    """Concepts of all compositions ``(composition * K, knots, n)``, and their rows for each sample ``(K, batch)``."""
    components = composition.weights.shape[1]
    index = components * row + torch.arange(components, device=row.device)[:, None]
    return composition.embeddings.flatten(0, 1), index
