"""Low-rank adapters (LoRA, Hu et al., 2022): what a concept changes of the denoiser, in its own branch of the formula."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.concepts.composition import Denoiser
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
        """The network with changed weights; its own stay as they are, and gradients reach the factors."""
        assert isinstance(denoiser, nn.Module)
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
            if known.get(name) != (found := (len(up), down.shape[1])):
                raise UserError(f"key 'adapter/{short(name)}': expected the sizes {known.get(name, 'of no weight')}, found {found}")

    def __len__(self) -> int:
        """How many numbers it holds."""
        return sum(up.numel() + down.numel() for up, down in self.factors.values())

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
                told = " and ".join("none" if one is None else str(tuple(one.shape)) for one in (up, down))
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
