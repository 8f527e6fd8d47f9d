"""Low-rank adapters (LoRA, Hu et al., 2022), which modify the denoiser in the branch of a concept."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ftl_lightning.igm.diffusion import Context, Denoiser
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


def adaptable(network: nn.Module, by_sample: bool = False) -> dict[str, tuple[int, int]]:
    """Sizes ``(outputs, everything else)`` of the weights that an adapter can modify, by name: all matrices and convolutions.

    Args:
        by_sample: only the layers that the network names in ``by_sample``, whose rows are the samples of a batch, if it names any:
            adapters of these are applied together (:func:`adapted`).
    """
    layers = _by_sample(network) if by_sample else set()
    weights = {name: weight for name, weight in network.named_parameters() if weight.dim() > 1}
    return {name: (len(weight), weight[0].numel()) for name, weight in weights.items() if not layers or name in layers}


def _by_sample(network: nn.Module) -> set[str]:
    """Names of the weights of linear layers whose rows are the samples of a batch; empty if the network does not name them."""
    prefix, inner = ("net.", network.net) if isinstance(getattr(network, "net", None), nn.Module) else ("", network)
    names = {f"{prefix}{layer}" for layer in getattr(inner, "by_sample", ())}
    linear = [name for name, layer in network.named_modules() if isinstance(layer, nn.Linear)]
    return {f"{name}.weight" for name in linear if any(name == one or name.startswith(f"{one}.") for one in names)}


def adapted(denoiser: Denoiser, adapters: Sequence[Any], number: Tensor) -> Denoiser:
    """Denoiser that applies to each sample the adapter ``number (sample,)``, from 1; 0 for none.

    Adapters of layers for each sample take a single forward pass together, others a pass for each adapter.
    """
    low_rank = [adapter for adapter in adapters if isinstance(adapter, LowRank)]
    alike = len(low_rank) == len(adapters) and len({frozenset(adapter.factors) for adapter in low_rank}) == 1
    if isinstance(denoiser, nn.Module) and alike and set(low_rank[0].factors) <= _by_sample(denoiser):
        network = denoiser

        def together(x: Tensor, t: Tensor, concepts: Tensor, index: Tensor, context: Context) -> Tensor:
            with _hooked(network, low_rank, number):
                return denoiser(x, t, concepts, index, context)

        return together
    return lambda *inputs: _one_by_one(denoiser, adapters, number, *inputs)


@contextmanager
def _hooked(network: nn.Module, adapters: Sequence[LowRank], number: Tensor) -> Iterator[None]:
    """Add the low-rank updates to the outputs of the adapted layers: ``x W^T + (x down^T) up^T``."""
    order = number.argsort(stable=True)
    counts = number.bincount(minlength=1 + len(adapters)).tolist()
    used = [position for position, count in enumerate(counts) if count]
    even = len({counts[position] for position in used}) == 1
    groups = order.split([counts[position] for position in used])
    ordered = bool((number.diff() >= 0).all())
    handles = []
    for name in adapters[0].factors:
        pairs = [adapter.factors[name] for adapter in adapters]
        up, down = (torch.stack([torch.zeros_like(pairs[0][kind]), *(pair[kind] for pair in pairs)]) for kind in (0, 1))
        up, down = up[used].to(number.device), down[used].to(number.device)

        def add(module: nn.Module, inputs: tuple[Tensor], output: Tensor, up: Tensor = up, down: Tensor = down) -> Tensor:
            x = inputs[0] if ordered else inputs[0][order]
            if even:
                update = ((x.unflatten(0, (len(used), -1)) @ down.mT) @ up.mT).flatten(0, 1)
            else:
                parts = zip(x.split([len(group) for group in groups]), up, down, strict=True)
                update = torch.cat([(part @ low.mT) @ high.mT for part, high, low in parts])
            return output + (update if ordered else update[order.argsort()])

        handles.append(network.get_submodule(name.rpartition(".")[0]).register_forward_hook(add))
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _one_by_one(
    denoiser: Denoiser,
    adapters: Sequence[Any],
    number: Tensor,
    x: Tensor,
    t: Tensor,
    concepts: Tensor,
    index: Tensor,
    context: Context,
) -> Tensor:
    by_number = number.argsort(stable=True)
    groups = by_number.split(number.bincount(minlength=1 + len(adapters)).tolist())
    noise = []
    for adapter, samples in zip((None, *adapters), groups, strict=True):
        if len(samples):
            changed = denoiser if adapter is None else adapter(denoiser)
            features = tuple(part[samples] for part in context)
            noise.append(changed(x[samples], t[samples], concepts, index[samples], features))
    return torch.cat(noise)[by_number.argsort()]
