"""Low-rank adapters (LoRA, Hu et al., 2022), which modify the denoiser in the branch of a concept."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ftl_lightning.igm.diffusion import Denoiser
from ftl_lightning.services.errors import UserError, require, short


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
        """Check that every factor fits a weight of a network; ``UserError`` naming the first factor that does not fit."""
        known = adaptable(network)
        for name, (up, down) in self.factors.items():
            sizes, place = (len(up), down.shape[1]), f"key 'adapter/{short(name)}'"
            require(known.get(name) == sizes, place, f"the sizes {known.get(name, 'of no weight')}", sizes)

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
        """Inverse of :meth:`tensors`; ``UserError`` for a missing factor, inconsistent shapes or a wrong dtype."""
        names = dict.fromkeys(name.rpartition("/")[0] for name in tensors)
        for name in names:
            up, down = (tensors.get(f"{name}/{kind}") for kind in KINDS)
            if up is None or down is None or not up.dim() == down.dim() == 2 or up.shape[1] != down.shape[0]:
                shapes = " and ".join("none" if factor is None else str(tuple(factor.shape)) for factor in (up, down))
                raise UserError(f"key 'adapter/{short(name)}': expected shapes (outputs, rank) and (rank, inputs), found {shapes}")
            single = up.dtype == down.dtype == torch.float32
            require(single, f"key 'adapter/{short(name)}'", "float32", f"{up.dtype} and {down.dtype}")
        unknown = set(tensors) - {f"{name}/{kind}" for name in names for kind in KINDS}
        require(not unknown, "key 'adapter'", f"factors {' and '.join(KINDS)}", short(min(unknown, default="")))
        return cls({name: (tensors[f"{name}/{KINDS[0]}"], tensors[f"{name}/{KINDS[1]}"]) for name in names}, everywhere)


KINDS = ("up", "down")


def adaptable(network: nn.Module) -> dict[str, tuple[int, int]]:
    """Sizes ``(outputs, everything else)`` of the adaptable weights, which are all matrices and convolutions, by name."""
    weights = {name: weight for name, weight in network.named_parameters() if weight.dim() > 1}
    return {name: (len(weight), weight[0].numel()) for name, weight in weights.items()}
