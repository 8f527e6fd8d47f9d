"""Low-rank adapters (LoRA, Hu et al., 2022): what a concept changes of the denoiser, in its own branch of the formula."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.concepts.branches import Context, Denoiser, Noised, branches
from ftl_lightning.concepts.composition import Adapter, Composition
from ftl_lightning.errors import UserError, short


@dataclass(frozen=True, eq=False)
class LowRank:
    """Adds ``up @ down`` to some weights of a network.

    Attributes:
        factors: ``up (outputs, rank)`` and ``down (rank, everything else)`` of each weight, by the parameter's name.
        everywhere: whether all other branches of a composition are changed too, as by fine-tuning the network.
    """

    factors: Mapping[str, tuple[Tensor, Tensor]]
    everywhere: bool = False

    def __call__(self, denoiser: Denoiser) -> Denoiser:
        """The network with changed weights; its own stay as they are, and gradients reach the factors.

        Raises:
            TypeError: for a denoiser that is no network.
        """
        if not isinstance(denoiser, nn.Module):
            raise TypeError(f"expected a network, whose weights can be changed, found {type(denoiser).__name__}")
        changed = {name: self.changed(name, denoiser.get_parameter(name)) for name in self.factors}
        return lambda *inputs: torch.func.functional_call(denoiser, changed, inputs)

    def changed(self, name: str, weight: Tensor) -> Tensor:
        """A weight with what is added to it."""
        up, down = (factor.to(weight.device) for factor in self.factors[name])
        return weight + (up @ down).reshape(weight.shape)

    def expect_fits(self, network: nn.Module) -> None:
        """Refuse factors of weights that a network does not have.

        Raises:
            UserError: naming the first.
        """
        known = adaptable(network)
        for name, (up, down) in self.factors.items():
            if known.get(name) != (sizes := (len(up), down.shape[1])):
                raise UserError(f"key 'adapter/{short(name)}': expected the sizes {known.get(name, 'of no weight')}, found {sizes}")

    def __len__(self) -> int:
        """How many numbers it holds."""
        return sum(up.numel() + down.numel() for up, down in self.factors.values())

    def detached(self) -> "LowRank":
        """The same without gradients."""
        return LowRank({name: (up.detach(), down.detach()) for name, (up, down) in self.factors.items()}, self.everywhere)

    def copied(self) -> "LowRank":
        """The same on the processor, apart from what is being learned, without factors that add nothing."""
        apart = {name: (up.detach().cpu().clone(), down.detach().cpu().clone()) for name, (up, down) in self.factors.items()}
        return LowRank({name: (up, down) for name, (up, down) in apart.items() if up.any()}, self.everywhere)

    def tensors(self) -> dict[str, Tensor]:
        """For a file, by name."""
        return {f"{name}/{kind}": factor for name, both in self.factors.items() for kind, factor in zip(KINDS, both, strict=True)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], everywhere: bool = False) -> "LowRank":
        """The inverse of :meth:`tensors`.

        Raises:
            UserError: for a factor without its other, or two whose shapes do not go together.
        """
        names = dict.fromkeys(name.rpartition("/")[0] for name in tensors)
        for name in names:
            up, down = (tensors.get(f"{name}/{kind}") for kind in KINDS)
            if up is None or down is None or not up.dim() == down.dim() == 2 or up.shape[1] != down.shape[0]:
                told = " and ".join("none" if factor is None else str(tuple(factor.shape)) for factor in (up, down))
                raise UserError(f"key 'adapter/{short(name)}': expected shapes (outputs, rank) and (rank, inputs), found {told}")
            if not up.dtype == down.dtype == torch.float32:
                raise UserError(f"key 'adapter/{short(name)}': expected float32, found {up.dtype} and {down.dtype}")
        if unknown := set(tensors) - {f"{name}/{kind}" for name in names for kind in KINDS}:
            raise UserError(f"key 'adapter': expected factors {' and '.join(KINDS)}, found {short(min(unknown))}")
        return cls({name: (tensors[f"{name}/{KINDS[0]}"], tensors[f"{name}/{KINDS[1]}"]) for name in names}, everywhere)


KINDS = ("up", "down")


def adaptable(network: nn.Module) -> dict[str, tuple[int, int]]:
    """The weights that an adapter changes, all matrices and convolutions, with the sizes ``(outputs, everything else)`` of each."""
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
    """The branches of a composition with adapters, each evaluated by the denoiser or by what its concept's adapter makes of it.

    An adapter that acts everywhere also takes the branches of its composition that have no adapter, the empty one among them. An
    empty branch that no adapter changes is evaluated without gradient.

    Args:
        denoiser: that adapters change.
        noised: plans.
        composition: ``(composition, K, ...)`` with adapters.
        row: each plan's composition ``(batch,)``.
        empty: the empty concept ``(1, knots, n)``.
        concepts: of all compositions ``(composition * K, knots, n)``.
        index: where those of each plan are among them ``(K, batch)``.

    Returns:
        Noise of the empty branch ``(batch, horizon, state)`` and of the concepts' ``(K, batch, horizon, state)``.
    """
    adapters, number = composition.adapters, composition.adapter_number[row]  # (batch, K)
    everywhere = number.new_tensor([0, *(n * adapter.everywhere for n, adapter in enumerate(adapters, start=1))])
    others = everywhere[number].amax(dim=1)  # (batch,), of the branches that have none
    number = torch.where(number == 0, others[:, None], number)
    conditional = branches(_by_adapter(denoiser, adapters, number.T.flatten()), noised, concepts, index)
    first = torch.zeros_like(row)[None]
    if others.any():
        unconditional = branches(_by_adapter(denoiser, adapters, others), noised, empty, first)
    else:
        with torch.no_grad():
            unconditional = branches(denoiser, noised, empty, first)
    return unconditional[0], conditional


def _by_adapter(denoiser: Denoiser, adapters: Sequence[Adapter], number: Tensor) -> Denoiser:
    """A denoiser that estimates each sample by the adapter of its ``number (sample,)`` from 1, or by the one that is given for 0;
    one call of the network for each that occurs.
    """

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
