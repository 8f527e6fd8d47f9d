"""Compositions of concepts, and the composed denoiser, Eq. 2 of the paper: learning, sampling and composing all go through it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from ftl_lightning.errors import UserError

Context = tuple[Tensor, ...]
"""What a condition encoder read from the observed features, each ``(batch, ...)``; empty where nothing is observed."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, n), index (batch,), context) -> noise like x``, where ``index`` is
each sample's row of ``concepts``."""


STRETCH = 1.5
"""Mixtures of modes lie so much farther from the modes' mean than convex combinations: these alone vary less than the modes do."""


@dataclass(frozen=True)
class Modes:
    """Several sets of embeddings of one concept: behaviours that are right in different ways.

    Attributes:
        embeddings: ``(mode, K, n)``.
        weights: ``(mode, K)``, omega.
        mixed: whether a sample is generated from a random mixture of the modes, which suits concepts of which one set of embeddings
            says enough, or from one mode, drawn at random.
    """

    embeddings: Tensor
    weights: Tensor
    mixed: bool = False

    def __len__(self) -> int:
        return len(self.weights)

    def __mul__(self, factor: float) -> "Modes":
        return replace(self, weights=factor * self.weights)

    def to(self, device: torch.device) -> "Modes":
        """The same on a device."""
        return replace(self, embeddings=self.embeddings.to(device), weights=self.weights.to(device))

    def draw(self, count: int, generator: torch.Generator) -> tuple["Composition", Tensor]:
        """What ``count`` samples are generated from: a composition ``(row, K, n)``, and each sample's row ``(count,)``.

        A mixture is ``mean + STRETCH * sum_m share_m (mode_m - mean)``, the shares even on the simplex (Dirichlet(1)).
        """
        if not self.mixed:
            chosen = torch.randint(len(self), (count,), generator=generator, device=generator.device)
            return Composition(self.embeddings, self.weights), chosen.to(self.weights.device)
        even = torch.empty(count, len(self), device=generator.device).exponential_(generator=generator)
        shares = (even / even.sum(dim=1, keepdim=True)).to(self.weights.device)
        shares = STRETCH * shares + (1 - STRETCH) / len(self)
        mixture = Composition(torch.einsum("sm,mkn->skn", shares, self.embeddings), shares @ self.weights)
        return mixture, torch.arange(count, device=self.weights.device)


@dataclass(frozen=True)
class Composition:
    """Concepts and the guidance weights with which they are composed; sums, differences and multiples are
    compositions too.

    Attributes:
        embeddings: ``(..., K, n)``.
        weights: ``(..., K)``, omega.
        modes: what samples are generated from where a learned concept stands alone; its embeddings are used where it is composed.
    """

    embeddings: Tensor
    weights: Tensor
    modes: Modes | None = field(default=None, kw_only=True)

    def __add__(self, other: "Composition") -> "Composition":
        return Composition(torch.cat((self.embeddings, other.embeddings), dim=-2), torch.cat((self.weights, other.weights), dim=-1))

    def __mul__(self, factor: float) -> "Composition":
        return Composition(self.embeddings, factor * self.weights, modes=self.modes and self.modes * factor)

    __rmul__ = __mul__

    def __neg__(self) -> "Composition":
        return -1.0 * self

    def __sub__(self, other: "Composition") -> "Composition":
        return self + -other

    def to(self, device: torch.device) -> "Composition":
        """The same on a device."""
        return Composition(self.embeddings.to(device), self.weights.to(device), modes=self.modes and self.modes.to(device))

    def draw(self, count: int, generator: torch.Generator) -> tuple["Composition", Tensor]:
        """What ``count`` samples are generated from: a composition ``(row, K, n)``, and each sample's row ``(count,)``.

        Nothing is drawn from the generator where there are no modes.
        """
        if self.modes is not None:
            return self.modes.draw(count, generator)
        return Composition(self.embeddings[None], self.weights[None]), torch.zeros(
            count, dtype=torch.int64, device=self.weights.device
        )

    def drawn(self, generator: torch.Generator) -> "Composition":
        """The composition ``(K, n)`` of a single sample, without modes."""
        if self.modes is None:
            return self
        rows, row = self.draw(1, generator)
        return Composition(rows.embeddings[row[0]], rows.weights[row[0]])


def batched(compositions: Sequence[Composition], count: int, generators: Sequence[torch.Generator]) -> tuple[Composition, Tensor]:
    """Everything that is generated together.

    Args:
        compositions: ``(K, n)`` each, of maybe different K.
        count: samples of each.
        generators: of each composition's draws of modes.

    Returns:
        One composition ``(row, most K, n)``, padded with weights of zero, and each sample's row ``(composition * count,)``.
    """
    embeddings, weights, rows, first = [], [], [], 0
    for composition, draw in zip(compositions, generators, strict=True):
        own, index = composition.draw(count, draw)
        embeddings += list(own.embeddings)
        weights += list(own.weights)
        rows.append(first + index)
        first += len(own.weights)
    pad = nn.utils.rnn.pad_sequence
    return Composition(pad(embeddings, batch_first=True), pad(weights, batch_first=True)), torch.cat(rows)


def composed_epsilon(
    denoiser: Denoiser,
    x: Tensor,
    t: Tensor,
    composition: Composition,
    empty: Tensor,
    context: Context = (),
    own: Tensor | None = None,
) -> Tensor:
    """``eps(x, empty) + sum_k w_k (eps(x, c_k) - eps(x, empty))``, all branches in one call of the network.

    While learning, the empty branch, which depends on no concept, is evaluated apart, without gradient.

    Args:
        denoiser: estimates noise for one concept a sample.
        x: noisy plans ``(batch, horizon, state)``.
        t: timesteps ``(batch,)``.
        composition: ``(composition, K, n)``; K may be 0.
        empty: the empty concept ``(n,)``.
        context: of each sample.
        own: each sample's composition ``(batch,)`` int64; ``None`` for equally many samples of each, one after another.

    Returns:
        ``(batch, horizon, state)``.
    """
    concepts, weights = composition.embeddings, composition.weights
    compositions, count = concepts.shape[:2]
    if own is None:
        own = torch.arange(compositions, device=x.device).repeat_interleave(len(x) // compositions)

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
