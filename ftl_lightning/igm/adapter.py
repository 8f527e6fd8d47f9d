"""Low-rank adapters (LoRA, Hu et al., 2022), which modify the denoiser in the branch of a concept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.igm.branches import Context, Denoiser, Noised, branches
from ftl_lightning.igm.composition import Adapter, Composition
from ftl_lightning.services.errors import UserError, short


@dataclass(frozen=True, eq=False)
class LowRank:
    """Adds ``up @ down`` to some weights of a network.

    Attributes:
        factors: ``up (outputs, rank)`` and ``down (rank, everything else)`` of each weight, by parameter name.
        everywhere: also modify all other branches of a composition, as fine-tuning does.
    """

    factors: Mapping[str, tuple[Tensor, Tensor]]
    everywhere: bool = False

    def __call__(self, denoiser: Denoiser) -> Denoiser:
        """Apply the adapter without changing the network's weights; gradients reach the factors.

        Raises:
            TypeError: if ``denoiser`` is not a network.
        """
        if not isinstance(denoiser, nn.Module):
            raise TypeError(f"expected a network, whose weights can be changed, found {type(denoiser).__name__}")
        changed = {name: self.changed(name, denoiser.get_parameter(name)) for name in self.factors}
        return lambda *inputs: torch.func.functional_call(denoiser, changed, inputs)

    def changed(self, name: str, weight: Tensor) -> Tensor:
        """Weight plus its low-rank update."""
        up, down = (factor.to(weight.device) for factor in self.factors[name])
        return weight + (up @ down).reshape(weight.shape)

    def check_fits(self, network: nn.Module) -> None:
        """Check that every factor fits a weight of a network.

        Raises:
            UserError: naming the first factor that does not fit.
        """
        known = adaptable(network)
        for name, (up, down) in self.factors.items():
            if known.get(name) != (sizes := (len(up), down.shape[1])):
                raise UserError(f"key 'adapter/{short(name)}': expected the sizes {known.get(name, 'of no weight')}, found {sizes}")

    def __len__(self) -> int:
        """Number of parameters."""
        return sum(up.numel() + down.numel() for up, down in self.factors.values())

    def detached(self) -> "LowRank":
        """Detach all factors from the graph."""
        return LowRank({name: (up.detach(), down.detach()) for name, (up, down) in self.factors.items()}, self.everywhere)

    def copied(self) -> "LowRank":
        """Detached copy on the CPU without zero updates."""
        copies = {name: (up.detach().cpu().clone(), down.detach().cpu().clone()) for name, (up, down) in self.factors.items()}
        return LowRank({name: (up, down) for name, (up, down) in copies.items() if up.any()}, self.everywhere)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of a file, by name."""
        return {f"{name}/{kind}": factor for name, both in self.factors.items() for kind, factor in zip(KINDS, both, strict=True)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], everywhere: bool = False) -> "LowRank":
        """Inverse of :meth:`tensors`.

        Raises:
            UserError: for a missing factor, inconsistent shapes or a wrong dtype.
        """
        names = dict.fromkeys(name.rpartition("/")[0] for name in tensors)
        for name in names:
            up, down = (tensors.get(f"{name}/{kind}") for kind in KINDS)
            if up is None or down is None or not up.dim() == down.dim() == 2 or up.shape[1] != down.shape[0]:
                shapes = " and ".join("none" if factor is None else str(tuple(factor.shape)) for factor in (up, down))
                raise UserError(f"key 'adapter/{short(name)}': expected shapes (outputs, rank) and (rank, inputs), found {shapes}")
            if not up.dtype == down.dtype == torch.float32:
                raise UserError(f"key 'adapter/{short(name)}': expected float32, found {up.dtype} and {down.dtype}")
        if unknown := set(tensors) - {f"{name}/{kind}" for name in names for kind in KINDS}:
            raise UserError(f"key 'adapter': expected factors {' and '.join(KINDS)}, found {short(min(unknown))}")
        return cls({name: (tensors[f"{name}/{KINDS[0]}"], tensors[f"{name}/{KINDS[1]}"]) for name in names}, everywhere)


KINDS = ("up", "down")


def adaptable(network: nn.Module) -> dict[str, tuple[int, int]]:
    """Sizes ``(outputs, everything else)`` of the adaptable weights, which are all matrices and convolutions, by name."""
    weights = {name: weight for name, weight in network.named_parameters() if weight.dim() > 1}
    return {name: (len(weight), weight[0].numel()) for name, weight in weights.items()}


def adapted_branches(
    denoiser: Denoiser,
    noised: Noised,
    composition: Composition,
    row: Tensor,
    empty: Tensor,
    concepts: Tensor,
    index: Tensor,
) -> tuple[Tensor, Tensor]:
    """Evaluate the branches of a composition with adapters.

    An adapter with ``everywhere`` also modifies the unconditional branch and the branches of its composition without an adapter.
    The unmodified unconditional branch is evaluated without gradient.

    Args:
        denoiser: unmodified denoiser.
        noised: noisy plans.
        composition: ``(composition, K, ...)`` with adapters.
        row: composition of each plan ``(batch,)``.
        empty: unconditional embedding ``(1, knots, n)``.
        concepts: concepts of all compositions ``(composition * K, knots, n)``.
        index: rows of ``concepts`` for each plan ``(K, batch)``.

    Returns:
        Noise of the unconditional branch ``(batch, horizon, state)`` and of the concepts' ``(K, batch, horizon, state)``.
    """
    adapters, number = composition.adapters, composition.adapter_number[row]  # (batch, K)
    everywhere = number.new_tensor([0, *(n * adapter.everywhere for n, adapter in enumerate(adapters, start=1))])
    default = everywhere[number].amax(dim=1)  # (batch,): adapter of the branches without one
    number = torch.where(number == 0, default[:, None], number)
    conditional = branches(_by_adapter(denoiser, adapters, number.T.flatten()), noised, concepts, index)
    first = torch.zeros_like(row)[None]
    if default.any():
        unconditional = branches(_by_adapter(denoiser, adapters, default), noised, empty, first)
    else:
        with torch.no_grad():
            unconditional = branches(denoiser, noised, empty, first)
    return unconditional[0], conditional


def _by_adapter(denoiser: Denoiser, adapters: Sequence[Adapter], number: Tensor) -> Denoiser:
    """Denoiser that applies adapter ``number (sample,)`` to each sample, from 1; 0 for none. One forward pass per adapter."""

    def estimate(x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context) -> Tensor:
        by_number = number.argsort(stable=True)
        groups = by_number.split(number.bincount(minlength=1 + len(adapters)).tolist())
        noise = []
        for adapter, samples in zip((None, *adapters), groups, strict=True):
            if len(samples):
                changed = denoiser if adapter is None else adapter(denoiser)
                some = Noised(x, t, context).at(samples)
                noise.append(changed(some.x, some.t, concepts, index[samples], some.context))
        return torch.cat(noise)[by_number.argsort()]

    return estimate
