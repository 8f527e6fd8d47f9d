"""Compositions of concepts: addition, scaling by weights, and batching."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from ftl_lightning.igm.diffusion import Denoiser
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.text import Shown, counted, numbers
from ftl_lightning.services.validation import LARGEST_FACTOR, check_range


class Adapter(Protocol):
    """Modifies the denoiser in the branches of a concept, see :mod:`ftl_lightning.igm.forms.adapter`."""

    @property
    def everywhere(self) -> bool:
        """Whether it also modifies the unconditional branch and the branches of concepts without an adapter."""

    def __call__(self, denoiser: Denoiser, /) -> Denoiser:
        """The modified denoiser."""


class Maker(Protocol):
    """Makes behaviour without the model, see :class:`ftl_lightning.data.references.Reference`."""

    @property
    def name(self) -> str:
        """Name of the form."""

    def sample(self, observed: Mapping[str, Tensor], count: int, draw: torch.Generator, /) -> Tensor:
        """Samples ``(count, horizon, state)`` in the domain's units for ``observed`` features ``(count, ...)``, by ``draw``."""


def space_of(domain: str, model_hash: str) -> str:
    """Description of a concept space: the model's ``domain`` and ``model_hash``."""
    return f"{domain} (hash {model_hash})"


@dataclass(frozen=True, repr=False)
class Composition(Shown):
    """Concepts with their guidance weights. Sums, differences and multiples are compositions too.

    Attributes:
        embeddings: ``(..., K, knots, n)``: for each concept a single embedding, or several at evenly spaced times of the plan
            (knots), between which the denoiser interpolates.
        weights: ``(..., K)``, omega.
        modes: several sets of embeddings for sampling. Composing uses ``embeddings`` instead, unless the concept varies over the
            plan: the mean of behaviour at different times is no behaviour. The modes of two such concepts are combined pairwise.
        columns: share of each concept's weight on each column of a state ``(..., K, state)``, usually 0 or 1; ``None`` for the full
            weight on every column.
        frames: shares of observed places in each concept's plans ``(..., K, place, time)``, see
            :class:`~ftl_lightning.data.places.Frames`; ``None`` for a model without places.
        adapters: modifications of the denoiser, assigned to concepts by ``adapter``.
        adapter: ``(..., K)`` int64, number of each concept's adapter, from 1; 0 for the unmodified denoiser; ``None`` for zeros.
        alone: composition for sampling the concept alone; ``None`` for this composition.
        made: maker of samples without the model; ``None`` for samples of the composed denoiser. Compositions of several concepts
            ignore it.
        share: share of the samples that are made by ``made``, 0 to 1.
        variation: share of the variance within training concepts that is added to samples, 0 to 1: a sample is deformed by the
            root of the share times as much as a random example deviates from the mean of its training concept, see
            :class:`~ftl_lightning.data.deformation.Deformations`. Sums have the largest.
        space: concept space, see :func:`space_of`; empty if unknown.

    Raises:
        UserError: at construction, for inconsistent shapes of embeddings and weights.
    """

    embeddings: Tensor
    weights: Tensor
    modes: Modes | None = field(default=None, kw_only=True)
    columns: Tensor | None = field(default=None, kw_only=True)
    frames: Tensor | None = field(default=None, kw_only=True)
    adapters: tuple[Adapter, ...] = field(default=(), kw_only=True)
    adapter: Tensor | None = field(default=None, kw_only=True)
    alone: "Composition | None" = field(default=None, kw_only=True)
    made: Maker | None = field(default=None, kw_only=True)
    share: float = field(default=1.0, kw_only=True)
    variation: float = field(default=0.0, kw_only=True)
    space: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        shape = tuple(self.weights.shape)
        if not shape or self.embeddings.dim() != len(shape) + 2 or self.embeddings.shape[:-2] != shape:
            raise UserError(
                "compose: expected embeddings (..., K, knots, n) and weights (..., K), "
                f"found {tuple(self.embeddings.shape)} and {shape}"
            )

    @property
    def knots(self) -> int:
        """Number of embeddings per concept."""
        return self.embeddings.shape[-2]

    def _words(self) -> Iterator[str]:
        yield f"K = {self.weights.shape[-1]}"
        if self.knots > 1:
            yield counted(self.knots, "knot")
        if self.modes is not None:
            yield counted(len(self.modes), "mode")
        if self.weights.dim() == 1:
            yield f"weights {numbers(self.weights.tolist())}"
        if self.columns is not None:
            yield "on some columns"
        if self.adapters:
            yield counted(len(self.adapters), "adapter")
        if self.made is not None:
            yield f"{self.share:.0%} {self.made.name}"
        if self.variation:
            yield f"{self.variation:.0%} of the variance of training concepts"
        if self.alone is not None:
            yield "another form where it stands alone"
        yield f"of {self.space or 'any model'}"

    def __add__(self, other: "Composition") -> "Composition":
        """Compose two compositions; concepts with a single knot are repeated at every knot of the others.

        Raises:
            UserError: for two different numbers of knots, neither of which is 1; for two adapters that modify all branches; for
                concepts of two models; for an operand that is not a composition.
        """
        if not isinstance(other, Composition):
            raise UserError(f"compose: expected a concept on each side of '+' and '-', found {shown(other)}; model[text] is one")
        if self.space and other.space and self.space != other.space:
            raise UserError(
                f"compose: expected concepts of one model, found one of {self.space} and one of {other.space}; "
                "learn them with the same model"
            )
        other = other if other.weights.device == self.weights.device else other.to(self.weights.device)
        if all(any(adapter.everywhere for adapter in part.adapters) for part in (self, other)):
            raise UserError("compose: expected at most 1 concept whose adapter changes the whole network, found 2")
        parts, adapters = (self, other), (*self.adapters, *other.adapters)
        knots, state = _common([part.knots for part in parts]), _columns_of(parts)
        after = torch.where(other.adapter_number > 0, other.adapter_number + len(self.adapters), 0)
        return Composition(
            torch.cat([part._at_knots(knots) for part in parts], dim=-3),
            torch.cat([part.weights for part in parts], dim=-1),
            modes=_summed_modes(self, other),
            columns=None if state is None else torch.cat([part.shares(state) for part in parts], dim=-2),
            frames=None if self.frames is None or other.frames is None else torch.cat((self.frames, other.frames), dim=-3),
            adapters=adapters,
            adapter=torch.cat((self.adapter_number, after), dim=-1) if adapters else None,
            variation=max(self.variation, other.variation),
            space=self.space or other.space,
        )

    def __mul__(self, factor: float) -> "Composition":
        """Multiply the guidance weights; ``UserError`` if ``factor`` is not a finite number."""
        if not isinstance(factor, Real | Tensor) or isinstance(factor, bool):
            raise UserError(f"compose: expected a number to multiply a concept with, found {shown(factor)}")
        check_range("compose: weight", float(factor))
        alone = self.alone and self.alone * factor
        return self._with(weights=factor * self.weights, modes=self.modes and self.modes * factor, alone=alone)

    __rmul__ = __mul__

    def __neg__(self) -> "Composition":
        return -1.0 * self

    def __sub__(self, other: "Composition") -> "Composition":
        return self + (-other if isinstance(other, Composition) else other)

    def on(self, columns: Sequence[int], state: int) -> "Composition":
        """Restrict the weights to some columns of a state with ``state`` columns."""
        chosen = torch.zeros(state, device=self.weights.device)
        chosen[list(columns)] = 1
        return self._with(columns=self.shares(state) * chosen, alone=self.alone and self.alone.on(columns, state))

    def shares(self, state: int) -> Tensor:
        """Share of each concept's weight on each of the ``state`` columns of a state ``(..., K, state)``."""
        return self.weights.new_ones((*self.weights.shape, state)) if self.columns is None else self.columns

    @property
    def frame(self) -> Tensor | None:
        """Shares of observed places in composed plans ``(..., place, time)``: the concepts' mean, by their positive weights."""
        if self.frames is None:
            return None
        weights = self.weights.detach().clamp(min=0)
        weights = torch.where(weights.sum(dim=-1, keepdim=True) > 0, weights, 1.0)
        return torch.einsum("...k,...kpt->...pt", weights / weights.sum(dim=-1, keepdim=True), self.frames)

    @property
    def adapter_number(self) -> Tensor:
        """Number of each concept's adapter ``(..., K)`` int64, from 1; 0 for none."""
        return self.weights.new_zeros(self.weights.shape, dtype=torch.int64) if self.adapter is None else self.adapter

    def _with(self, **changes: Any) -> "Composition":
        """Replace some fields; the result is a plain :class:`Composition`."""
        return Composition(**({field.name: getattr(self, field.name) for field in fields(Composition)} | changes))

    def with_adapters(self, adapters: tuple[Adapter, ...]) -> "Composition":
        """The composition with as many other adapters."""
        return self._with(adapters=adapters)

    def _at_knots(self, knots: int) -> Tensor:
        """Embeddings ``(..., K, knots, n)``; a single knot is repeated."""
        return self.embeddings.expand(*self.weights.shape, knots, -1)

    def to(self, device: torch.device) -> "Composition":
        """Move all tensors to a device; adapters follow their denoiser."""
        return self._with(
            embeddings=self.embeddings.to(device),
            weights=self.weights.to(device),
            modes=self.modes and self.modes.to(device),
            columns=None if self.columns is None else self.columns.to(device),
            frames=None if self.frames is None else self.frames.to(device),
            adapter=None if self.adapter is None else self.adapter.to(device),
            alone=self.alone and self.alone.to(device),
        )

    @property
    def uncomposed(self) -> "Composition":
        """Composition for sampling the concept alone."""
        return self if self.alone is None else self.alone

    def draw(self, count: int, generator: torch.Generator) -> tuple["Composition", Tensor]:
        """Draw the modes of ``count`` samples: a composition ``(row, K, ...)`` and the row of each sample ``(count,)``.

        Without modes the generator is not advanced. Call on :attr:`uncomposed`.
        """
        if self.modes is None:
            embeddings, weights = self.embeddings[None], self.weights[None]
            row = torch.zeros(count, dtype=torch.int64, device=self.weights.device)
        else:
            embeddings, weights, row = self.modes.draw(count, generator)
        columns = None if self.columns is None else self.columns.expand(len(weights), *self.columns.shape)
        adapter = None if self.adapter is None else self.adapter.expand(len(weights), *self.adapter.shape)
        frames = None if self.frames is None else self.frames.expand(len(weights), *self.frames.shape)
        return self._with(embeddings=embeddings, weights=weights, modes=None, columns=columns, adapter=adapter, frames=frames), row

    def row(self, number: int | slice) -> "Composition":
        """Row ``(K, ...)``, or rows, of compositions ``(row, K, ...)`` without modes; ``number`` counts from 0."""
        return self._with(
            embeddings=self.embeddings[number],
            weights=self.weights[number],
            columns=None if self.columns is None else self.columns[number],
            frames=None if self.frames is None else self.frames[number],
            adapter=None if self.adapter is None else self.adapter[number],
        )

    def drawn(self, generator: torch.Generator) -> "Composition":
        """Composition ``(K, ...)`` of a single sample, without modes; the generator draws the mode."""
        if self.uncomposed.modes is None:
            return self.uncomposed
        rows, row = self.uncomposed.draw(1, generator)
        return rows.row(int(row[0]))


def _summed_modes(first: Composition, second: Composition) -> Modes | None:
    """Modes of a sum: pairwise combinations of the modes that vary over the plan; ``None`` if neither part has such modes."""
    if not any(part.modes is not None and part.knots > 1 for part in (first, second)):
        return None
    knots = max(first.knots, second.knots)
    sets = [
        part.modes if part.modes is not None and part.knots > 1 else Modes(part._at_knots(knots)[None], part.weights[None])
        for part in (first, second)
    ]
    return sets[0].with_each(sets[1])


def _common(knots: Sequence[int]) -> int:
    """Common number of knots of composed concepts."""
    if len(several := sorted(set(knots) - {1})) > 1:
        raise UserError(f"compose: expected concepts with equal numbers of knots (or 1 knot), found {several[0]} and {several[1]}")
    return max(knots, default=1)


def _columns_of(compositions: Sequence[Composition]) -> int | None:
    """Number of state columns; ``None`` if no composition has ``columns``."""
    return next((part.columns.shape[-1] for part in compositions if part.columns is not None), None)


def batched(compositions: Sequence[Composition], count: int, generators: Sequence[torch.Generator]) -> tuple[Composition, Tensor]:
    """Collate compositions into a batch; ``UserError`` for two different numbers of knots, neither of which is 1.

    Args:
        compositions: ``(K, ...)`` each; K may differ.
        count: samples per composition.
        generators: generator of each composition's mode draws.

    Returns:
        Composition ``(row, max K, ...)``, padded with zero weights, and the row of each sample ``(composition * count,)``.
    """
    compositions = [composition.uncomposed for composition in compositions]
    knots, state = _common([composition.knots for composition in compositions]), _columns_of(compositions)
    # Parallel episodes repeat a composition: keep each adapter once.
    adapters = tuple(dict.fromkeys(adapter for composition in compositions for adapter in composition.adapters))
    drawn, numbers, rows, first = [], [], [], 0
    for composition, draw in zip(compositions, generators, strict=True):
        part, row = composition.draw(count, draw)
        renumbered = torch.tensor([0, *(1 + adapters.index(adapter) for adapter in part.adapters)], device=part.weights.device)
        drawn.append(part)
        numbers.append(renumbered[part.adapter_number])
        rows.append(first + row)
        first += len(part.weights)

    def padded(each: Iterable[Tensor]) -> Tensor:
        return nn.utils.rnn.pad_sequence([row for part in each for row in part], batch_first=True)

    batch = Composition(
        padded(part._at_knots(knots) for part in drawn),
        padded(part.weights for part in drawn),
        columns=None if state is None else padded(part.shares(state) for part in drawn),
        adapters=adapters,
        adapter=padded(numbers) if adapters else None,
    )
    return batch, torch.cat(rows)


class Part(NamedTuple):
    """A part of a composition in text.

    Attributes:
        concept: text or file of the concept.
        weight: guidance weight omega.
        groups: groups of columns that the weight applies to; empty for all columns.
    """

    concept: str
    weight: float = 1.0
    groups: tuple[str, ...] = ()


def parse_composition(text: str) -> list[Part]:
    """Parse a ``text`` such as ``'circle right of square:1.2 + walk@legs,trunk:0.8'``; the default weight is 1.

    Raises:
        UserError: for a weight that exceeds :data:`~ftl_lightning.services.validation.LARGEST_FACTOR`, or an empty concept or
            group.
    """
    parts = []
    for term in text.split(" + ") if text.strip() else ():
        place, colon, weight = term.partition(":")
        concept, at, groups = place.partition("@")
        try:
            omega = float(weight) if colon else 1.0
        except ValueError:
            omega = math.nan
        part = Part(concept.strip(), omega, tuple(group.strip() for group in groups.split(",")) if at else ())
        if not (part.concept and abs(part.weight) <= LARGEST_FACTOR and all(part.groups)):
            raise UserError(
                "compose: expected 'concept:weight + concept@group:weight', "
                f"weights up to {LARGEST_FACTOR:g}, found {short(term)!r}"
            )
        parts.append(part)
    return parts
