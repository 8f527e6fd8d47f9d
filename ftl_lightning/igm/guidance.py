"""The composed denoiser (Eq. 2 of the paper), used to learn, sample and compose concepts."""

import torch
from torch import Tensor

from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.diffusion import Context, Denoiser
from ftl_lightning.igm.forms.adapter import adapted


def composed_epsilon(
    denoiser: Denoiser,
    x: Tensor,
    t: Tensor,
    composition: Composition,
    empty: Tensor,
    context: Context = (),
    row: Tensor | None = None,
) -> Tensor:
    """Composed noise estimate ``eps(x, empty) + sum_k w_k (eps(x, c_k) - eps(x, empty))`` (Eq. 2).

    A *branch* is the noise estimate of every sample under one embedding: the unconditional branch ``eps(x, empty)``, and K
    conditional branches ``eps(x, c_k)``. All K + 1 branches are a single forward pass. With gradients enabled, the unconditional
    branch is a separate pass without gradient, since it depends on no learned parameter.

    An adapter modifies the denoiser in the branch of its concept. An adapter with ``everywhere`` also modifies the unconditional
    branch, and those branches of its composition that have no adapter. Several adapters may need a forward pass each.

    Args:
        denoiser: noise estimate with a single concept per sample.
        x: noisy plans ``(batch, horizon, state)``.
        t: timesteps ``(batch,)`` int64.
        composition: batch of compositions, weights ``(composition, K)``; K may be 0.
        empty: unconditional embedding ``(n,)``.
        context: encoded observed features of each sample, such as the initial state ``s_0``.
        row: index of each sample's composition ``(batch,)`` int64; ``None`` for groups of equal size, in order.

    Returns:
        ``(batch, horizon, state)``.
    """
    count, components = composition.weights.shape
    if row is None:
        row = torch.arange(count, device=x.device).repeat_interleave(len(x) // count)
    concepts = composition.embeddings.flatten(0, 1)
    index = components * row + torch.arange(components, device=row.device)[:, None]  # (K, batch): each branch's row of concepts
    empty, first = empty.repeat(1, composition.knots, 1), torch.zeros_like(row)[None]
    if composition.adapters:
        number, default = _adapter_numbers(composition, row)
        if default.any():
            unconditional = branches(adapted(denoiser, composition.adapters, default), x, t, empty, first, context)[0]
        else:
            with torch.no_grad():
                unconditional = branches(denoiser, x, t, empty, first, context)[0]
        conditional = branches(adapted(denoiser, composition.adapters, number.T.flatten()), x, t, concepts, index, context)
    elif torch.is_grad_enabled() and components:
        with torch.no_grad():
            unconditional = branches(denoiser, x, t, empty, first, context)[0]
        conditional = branches(denoiser, x, t, concepts, index, context)
    else:
        estimates = branches(denoiser, x, t, torch.cat((empty, concepts)), torch.cat((first, index + 1)), context)
        unconditional, conditional = estimates[0], estimates[1:]
    return unconditional + weighted_sum(composition, row, conditional - unconditional)


def branches(denoiser: Denoiser, x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context) -> Tensor:
    """Estimate the noise of every plan in every branch, in a single forward pass over ``branch * batch`` samples.

    Args:
        denoiser: noise estimate with a single concept per sample.
        x, t, context: noisy plans, timesteps and encoded observed features ``(batch, ...)``.
        concepts: embeddings ``(concept, knots, n)``.
        index: row of ``concepts`` for each branch and plan ``(branch, batch)`` int64.

    Returns:
        ``(branch, batch, horizon, state)``.
    """
    x, t = x.repeat(len(index), 1, 1), t.repeat(len(index))
    context = tuple(part.repeat(len(index), *(1,) * (part.dim() - 1)) for part in context)
    return denoiser(x, t, concepts, index.flatten(), context).unflatten(0, index.shape)


def weighted_sum(composition: Composition, row: Tensor, differences: Tensor) -> Tensor:
    """Weighted sum ``sum_k w_k differences_k``; a weight may differ between the columns (dimensions) of a state.

    Args:
        composition: batch of compositions, weights ``(composition, K)``.
        row: index of each sample's composition ``(batch,)`` int64.
        differences: ``eps(x, c_k) - eps(x, empty)``, ``(K, batch, horizon, state)``.

    Returns:
        ``(batch, horizon, state)``.
    """
    if composition.columns is None:
        return torch.einsum("bk,kbhs->bhs", composition.weights[row], differences)
    by_column = composition.weights[..., None] * composition.columns
    return torch.einsum("bks,kbhs->bhs", by_column[row], differences)


def _adapter_numbers(composition: Composition, row: Tensor) -> tuple[Tensor, Tensor]:
    """Adapter of each sample's conditional branches ``(batch, K)`` and unconditional branch ``(batch,)``, from 1; 0 for none."""
    number = composition.adapter_number[row]
    everywhere = [position * adapter.everywhere for position, adapter in enumerate(composition.adapters, start=1)]
    default = number.new_tensor([0, *everywhere])[number].amax(dim=1)
    return torch.where(number == 0, default[:, None], number), default
