"""The composed denoiser, Eq. 2 of the paper, for learning, sampling and composing."""

from typing import NamedTuple

import torch
from torch import Tensor

from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.diffusion import Context, Denoiser


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
    a concept with an adapter is evaluated by the modified denoiser; an adapter with ``everywhere`` also modifies the unconditional
    branch and the branches of its composition without an adapter.

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
    count, components = composition.weights.shape
    if row is None:
        row = torch.arange(count, device=x.device).repeat_interleave(len(x) // count)
    noised, concepts = Noised(x, t, context), composition.embeddings.flatten(0, 1)
    index = components * row + torch.arange(components, device=row.device)[:, None]  # (K, batch): rows of the concepts
    empty, first = empty.repeat(1, composition.knots, 1), torch.zeros_like(row)[None]
    if not (composition.adapters or (torch.is_grad_enabled() and len(index))):
        every = branches(denoiser, noised, torch.cat((empty, concepts)), torch.cat((first, index + 1)))
        unconditional, conditional = every[0], every[1:]
        return unconditional + weighted_sum(composition, row, conditional - unconditional)
    unadapted, adapted, everywhere = denoiser, denoiser, torch.zeros(1, dtype=torch.bool)
    if composition.adapters:
        number, everywhere = _adapter_numbers(composition, row)
        adapted = _by_adapter(denoiser, composition, number.T.flatten())
        unadapted = _by_adapter(denoiser, composition, everywhere)
    if everywhere.any():
        unconditional = branches(unadapted, noised, empty, first)[0]
    else:
        with torch.no_grad():
            unconditional = branches(denoiser, noised, empty, first)[0]
    conditional = branches(adapted, noised, concepts, index)
    return unconditional + weighted_sum(composition, row, conditional - unconditional)


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
        concepts: ``(concept, knots, n)``.
        index: row of ``concepts`` for each branch and plan ``(branch, batch)`` int64.

    Returns:
        ``(branch, batch, horizon, state)``.
    """
    x, t, context = noised.repeated(len(index))
    return denoiser(x, t, concepts, index.flatten(), context).unflatten(0, index.shape)


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


def _adapter_numbers(composition: Composition, row: Tensor) -> tuple[Tensor, Tensor]:
    """Adapter of each plan's concepts ``(batch, K)``, and of its unconditional branch ``(batch,)``, from 1; 0 for none."""
    number = composition.adapter_number[row]
    numbered = enumerate(composition.adapters, start=1)
    default = number.new_tensor([0, *(place * adapter.everywhere for place, adapter in numbered)])[number].amax(dim=1)
    return torch.where(number == 0, default[:, None], number), default


def _by_adapter(denoiser: Denoiser, composition: Composition, number: Tensor) -> Denoiser:
    """Denoiser that applies adapter ``number (sample,)`` to each sample, from 1; 0 for none. One forward pass per adapter."""

    def estimate(x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context) -> Tensor:
        by_number = number.argsort(stable=True)
        groups = by_number.split(number.bincount(minlength=1 + len(composition.adapters)).tolist())
        noise = []
        for adapter, samples in zip((None, *composition.adapters), groups, strict=True):
            if len(samples):
                changed = denoiser if adapter is None else adapter(denoiser)
                some = Noised(x, t, context).at(samples)
                noise.append(changed(some.x, some.t, concepts, index[samples], some.context))
        return torch.cat(noise)[by_number.argsort()]

    return estimate
