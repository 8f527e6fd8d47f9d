"""Compositions of concepts, and the composed denoiser, Eq. 2 of the paper: learning, sampling and composing all go through it."""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from ftl_lightning.errors import UserError, short, shown
from ftl_lightning.ranges import LARGEST_FACTOR, expect_range
from ftl_lightning.representation import Shown, counted, numbers

Context = tuple[Tensor, ...]
"""What a condition encoder read from the observed features, each ``(batch, ...)``; empty where nothing is observed."""
Denoiser = Callable[[Tensor, Tensor, Tensor, Tensor, Context], Tensor]
"""``(x (batch, horizon, state), t (batch,), concepts (concept, knots * n), index (batch,), context) -> noise like x``, where
``index`` is each sample's row of ``concepts``."""


class Adapter(Protocol):
    """Changes a denoiser for the branches of its own concept, see :mod:`ftl_lightning.concepts.adapter`."""

    @property
    def everywhere(self) -> bool:
        """Whether it changes all other branches of a composition too, of concepts without an adapter and of the empty one."""

    def __call__(self, denoiser: Denoiser, /) -> Denoiser:
        """The changed denoiser."""


STRETCH = 1.5
"""Mixtures of modes lie so much farther from the modes' mean than convex combinations: these alone vary less than the modes do."""


@dataclass(frozen=True, repr=False)
class Modes(Shown):
    """Several sets of embeddings of one concept: behaviours that are right in different ways.

    Attributes:
        embeddings: ``(mode, K, knots * n)``.
        weights: ``(mode, K)``, omega.
        mixed: whether a sample is generated from a random mixture of the modes, which suits concepts of which one set of embeddings
            says enough, or from one mode, drawn at random.
    """

    embeddings: Tensor
    weights: Tensor
    mixed: bool = False

    def __len__(self) -> int:
        return len(self.weights)

    def _words(self) -> Iterator[str]:
        yield counted(len(self), "mode")
        yield f"K = {self.weights.shape[-1]}"
        if self.mixed:
            yield "mixed"

    def __mul__(self, factor: float) -> "Modes":
        return replace(self, weights=factor * self.weights)

    def to(self, device: torch.device) -> "Modes":
        """The same on a device."""
        return replace(self, embeddings=self.embeddings.to(device), weights=self.weights.to(device))

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """What ``count`` samples are generated from: embeddings ``(row, K, knots * n)``, weights ``(row, K)``, and each sample's
        row ``(count,)``.

        A mixture is ``mean + STRETCH * sum_m share_m (mode_m - mean)``, the shares even on the simplex (Dirichlet(1)).
        """
        if not self.mixed:
            chosen = torch.randint(len(self), (count,), generator=generator, device=generator.device)
            return self.embeddings, self.weights, chosen.to(self.weights.device)
        even = torch.empty(count, len(self), device=generator.device).exponential_(generator=generator)
        shares = (even / even.sum(dim=1, keepdim=True)).to(self.weights.device)
        shares = STRETCH * shares + (1 - STRETCH) / len(self)
        embeddings = torch.einsum("sm,mkn->skn", shares, self.embeddings)
        return embeddings, shares @ self.weights, torch.arange(count, device=self.weights.device)


def space_of(domain: str, model_hash: str) -> str:
    """The concept space of a model, in words."""
    return f"{domain} (hash {model_hash})"


@dataclass(frozen=True, repr=False)
class Composition(Shown):
    """Concepts and the guidance weights with which they are composed; sums, differences and multiples are
    compositions too.

    Attributes:
        embeddings: ``(..., K, knots * n)``: of every concept one embedding or, one after another, several at even times of the
            plan, between which the denoiser interpolates.
        weights: ``(..., K)``, omega.
        modes: what samples are generated from. Where a concept is composed they are left out and its embeddings are used, unless it
            varies over the plan: what demonstrations show at different times has no mean. Two concepts' modes are combined each
            with each.
        knots: embeddings of each concept.
        columns: share of its weight that a concept has on each column of a state ``(..., K, state)``, usually 0 or 1; ``None`` for
            all of it on every column.
        adapters: changes of the denoiser, each for the concepts that ``adapter`` says.
        adapter: ``(..., K)`` int64, the number from 1 of each concept's adapter, 0 for the denoiser as it is; ``None`` for zeros.
        space: of which model's concepts it is made, see :func:`space_of`; empty where nobody said.
    """

    embeddings: Tensor
    weights: Tensor
    modes: Modes | None = field(default=None, kw_only=True)
    knots: int = field(default=1, kw_only=True)
    columns: Tensor | None = field(default=None, kw_only=True)
    adapters: tuple[Adapter, ...] = field(default=(), kw_only=True)
    adapter: Tensor | None = field(default=None, kw_only=True)
    space: str = field(default="", kw_only=True)

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
        yield f"of {self.space or 'any model'}"

    def __add__(self, other: "Composition") -> "Composition":
        """Both; concepts that do not vary over the plan are said at every knot of those that do.

        Raises:
            UserError: for concepts of different numbers of knots, neither of which is 1; for two adapters that change all; for
                concepts of two models, or what is no concept.
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
            raise UserError("compose: expected at most one concept whose adapter changes the whole network, found two")
        knots, state = _common([self.knots, other.knots]), _columns_of((self, other))
        parts = [part._filled(knots, state, len(self.adapters) * first) for first, part in enumerate((self, other))]
        return Composition(
            torch.cat([part.embeddings for part in parts], dim=-2),
            torch.cat([part.weights for part in parts], dim=-1),
            modes=_together(*parts),
            knots=knots,
            columns=None if state is None else torch.cat([_given(part.columns) for part in parts], dim=-2),
            adapters=(*self.adapters, *other.adapters),
            adapter=torch.cat([_given(part.adapter) for part in parts], dim=-1) if self.adapters or other.adapters else None,
            space=self.space or other.space,
        )

    def __mul__(self, factor: float) -> "Composition":
        """The same with its guidance weights multiplied.

        Raises:
            UserError: for what is no finite number.
        """
        if not isinstance(factor, Real | Tensor) or isinstance(factor, bool):
            raise UserError(f"compose: expected a number to multiply a concept with, found {shown(factor)}")
        expect_range("compose: weight", float(factor))
        return self._with(weights=factor * self.weights, modes=self.modes and self.modes * factor)

    __rmul__ = __mul__

    def __neg__(self) -> "Composition":
        return -1.0 * self

    def __sub__(self, other: "Composition") -> "Composition":
        return self + (-other if isinstance(other, Composition) else other)

    def on(self, columns: Sequence[int], state: int) -> "Composition":
        """The same with weight on some columns of a state alone, of ``state`` columns."""
        chosen = torch.zeros(state, device=self.weights.device)
        chosen[list(columns)] = 1
        before = _given(self._filled(self.knots, state).columns)
        return self._with(columns=before * chosen)

    def _with(self, **changes: Any) -> "Composition":
        """A composition, of whatever class this one is, with some fields changed."""
        return Composition(**({field.name: getattr(self, field.name) for field in fields(Composition)} | changes))

    def _filled(self, knots: int, state: int | None, first: int = 0) -> "Composition":
        """The same with so many knots, with columns of a state of that size, and with adapters' numbers after ``first`` others."""
        shape = self.weights.shape
        embeddings = self.embeddings if self.knots == knots else self.embeddings.repeat(*(1,) * len(shape), knots)
        columns = self.columns if self.columns is not None or state is None else self.weights.new_ones((*shape, state))
        number = self.weights.new_zeros(shape, dtype=torch.int64) if self.adapter is None else self.adapter
        return self._with(
            embeddings=embeddings,
            knots=knots,
            columns=columns,
            adapter=torch.where(number > 0, number + first, number),
            modes=self.modes if self.knots > 1 else None,
        )

    def to(self, device: torch.device) -> "Composition":
        """The same on a device; adapters follow the denoiser that they change."""
        return self._with(
            embeddings=self.embeddings.to(device),
            weights=self.weights.to(device),
            modes=self.modes and self.modes.to(device),
            columns=None if self.columns is None else self.columns.to(device),
            adapter=None if self.adapter is None else self.adapter.to(device),
        )

    def draw(self, count: int, generator: torch.Generator) -> tuple["Composition", Tensor]:
        """What ``count`` samples are generated from: a composition ``(row, K, ...)``, and each sample's row ``(count,)``.

        Nothing is drawn from the generator where there are no modes.
        """
        if self.modes is None:
            embeddings, weights = self.embeddings[None], self.weights[None]
            own = torch.zeros(count, dtype=torch.int64, device=self.weights.device)
        else:
            embeddings, weights, own = self.modes.draw(count, generator)
        rows = len(weights)
        columns = None if self.columns is None else self.columns.expand(rows, *self.columns.shape)
        adapter = None if self.adapter is None else self.adapter.expand(rows, *self.adapter.shape)
        return self._with(embeddings=embeddings, weights=weights, modes=None, columns=columns, adapter=adapter), own

    def row(self, number: int) -> "Composition":
        """One ``(K, ...)`` of several compositions ``(row, K, ...)`` without modes."""
        return self._with(
            embeddings=self.embeddings[number],
            weights=self.weights[number],
            columns=None if self.columns is None else self.columns[number],
            adapter=None if self.adapter is None else self.adapter[number],
        )

    def drawn(self, generator: torch.Generator) -> "Composition":
        """The composition ``(K, ...)`` of a single sample, without modes."""
        if self.modes is None:
            return self
        rows, row = self.draw(1, generator)
        return rows.row(int(row[0]))


def _together(one: Composition, other: Composition) -> Modes | None:
    """Each of one's modes with each of the other's; ``None`` where neither has any."""
    if one.modes is None and other.modes is None:
        return None
    first, second = (part.modes or Modes(part.embeddings[None], part.weights[None]) for part in (one, other))
    counts = (len(first), len(second))

    def pairs(left: Tensor, right: Tensor) -> Tensor:
        return torch.cat((left.repeat_interleave(counts[1], dim=0), right.repeat(counts[0], *(1,) * (right.dim() - 1))), dim=1)

    return Modes(
        pairs(first.embeddings, second.embeddings), pairs(first.weights, second.weights), mixed=first.mixed or second.mixed
    )


def _given(values: Tensor | None) -> Tensor:
    assert values is not None
    return values


def _common(knots: Sequence[int]) -> int:
    """The number of knots of concepts that are composed.

    Raises:
        UserError: where two of them differ and neither is 1.
    """
    if len(several := sorted(set(knots) - {1})) > 1:
        raise UserError(f"compose: expected concepts of one number of knots (or of one knot), found {several[0]} and {several[1]}")
    return max(knots, default=1)


def _columns_of(compositions: Sequence[Composition]) -> int | None:
    """Columns of a state, where any composition says so."""
    return next((one.columns.shape[-1] for one in compositions if one.columns is not None), None)


def batched(compositions: Sequence[Composition], count: int, generators: Sequence[torch.Generator]) -> tuple[Composition, Tensor]:
    """Everything that is generated together.

    Args:
        compositions: ``(K, ...)`` each, of maybe different K.
        count: samples of each.
        generators: of each composition's draws of modes.

    Returns:
        One composition ``(row, most K, ...)``, padded with weights of zero, and each sample's row ``(composition * count,)``.

    Raises:
        UserError: for concepts of different numbers of knots, neither of which is 1.
    """
    knots, state = _common([one.knots for one in compositions]), _columns_of(compositions)
    # Episodes that are run side by side ask for one composition many times: it has its adapters once.
    adapters = tuple(dict.fromkeys(adapter for one in compositions for adapter in one.adapters))
    drawn, rows, first = [], [], 0
    for composition, draw in zip(compositions, generators, strict=True):
        own, index = composition.draw(count, draw)
        own = own._filled(knots, state)
        numbers = torch.tensor([0, *(1 + adapters.index(adapter) for adapter in composition.adapters)], device=own.weights.device)
        drawn.append(replace(own, adapter=numbers[_given(own.adapter)]))
        rows.append(first + index)
        first += len(own.weights)

    def padded(each: Iterable[Tensor]) -> Tensor:
        return nn.utils.rnn.pad_sequence([row for part in each for row in part], batch_first=True)

    together = Composition(
        padded(one.embeddings for one in drawn),
        padded(one.weights for one in drawn),
        knots=knots,
        columns=None if state is None else padded(_given(one.columns) for one in drawn),
        adapters=adapters,
        adapter=padded(_given(one.adapter) for one in drawn) if adapters else None,
    )
    return together, torch.cat(rows)


def composed_epsilon(
    denoiser: Denoiser,
    x: Tensor,
    t: Tensor,
    composition: Composition,
    empty: Tensor,
    context: Context = (),
    own: Tensor | None = None,
) -> Tensor:
    """``eps(x, empty) + sum_k w_k (eps_k(x, c_k) - eps(x, empty))``, all branches in one call of the network.

    ``eps_k`` is the denoiser or, where a concept has an adapter, what the adapter makes of it, which is called for those branches
    alone unless it changes everything. A weight may differ between the columns of a state. While learning, the empty branch, which
    depends on no concept, is evaluated apart, without gradient.

    Args:
        denoiser: estimates noise for one concept a sample.
        x: noisy plans ``(batch, horizon, state)``.
        t: timesteps ``(batch,)``.
        composition: ``(composition, K, ...)``; K may be 0.
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

    def evaluate(denoiser: Denoiser, concepts: Tensor, index: Tensor, samples: Tensor | None = None) -> Tensor:
        """Noise of all samples for ``index (branch, batch)`` into ``concepts``, or of some ``samples`` for ``index`` like them."""
        if samples is not None:
            return denoiser(x[samples], t[samples], concepts, index, tuple(part[samples] for part in context))
        k = len(index)
        every = tuple(part.repeat(k, *(1,) * (part.dim() - 1)) for part in context)
        return denoiser(x.repeat(k, 1, 1), t.repeat(k), concepts, index.flatten(), every).unflatten(0, (k, len(x)))

    nothing = torch.zeros_like(own)[None]
    rows = own * count + torch.arange(count, device=x.device)[:, None]  # (K, batch), into the flattened concepts
    silent = empty.repeat(composition.knots)[None]
    if composition.adapters or (torch.is_grad_enabled() and count):
        with torch.no_grad():
            unconditional = evaluate(denoiser, silent, nothing)[0]
        if composition.adapters:
            number = _given(composition.adapter)  # (composition, K)
            whole = number.new_tensor([0, *(n * adapter.everywhere for n, adapter in enumerate(composition.adapters, start=1))])
            every = whole[number].amax(dim=1, keepdim=True)[own]  # (batch, 1)
            made = functools.partial(_adapted, denoiser, composition.adapters, evaluate, unconditional)
            conditional = made(concepts.flatten(0, 1), rows, torch.where(number[own] == 0, every, number[own]).T)
            if every.any():
                (unconditional,) = made(silent, nothing, every.T)
        else:
            conditional = evaluate(denoiser, concepts.flatten(0, 1), rows)
    else:
        branches = evaluate(denoiser, torch.cat((silent, concepts.flatten(0, 1))), torch.cat((nothing, rows + 1)))
        unconditional, conditional = branches[0], branches[1:]
    if composition.columns is None:
        return unconditional + torch.einsum("bk,kbhs->bhs", weights[own], conditional - unconditional)
    by_column = weights[..., None] * composition.columns
    return unconditional + torch.einsum("bks,kbhs->bhs", by_column[own], conditional - unconditional)


def _adapted(
    denoiser: Denoiser,
    adapters: Sequence[Adapter],
    evaluate: Callable[[Denoiser, Tensor, Tensor, Tensor], Tensor],
    like: Tensor,
    concepts: Tensor,
    rows: Tensor,
    number: Tensor,
) -> Tensor:
    """Noise ``(branch, batch, horizon, state)`` for ``rows (branch, batch)`` of concepts, each by the adapter of that number."""
    noise = like.expand(len(rows), *like.shape)
    for this, adapter in enumerate((None, *adapters)):
        branch, sample = (number == this).nonzero(as_tuple=True)
        if len(branch):
            changed = denoiser if adapter is None else adapter(denoiser)
            noise = noise.index_put((branch, sample), evaluate(changed, concepts, rows[branch, sample], sample))
    return noise


class Part(NamedTuple):
    """A part of a composition, as it is told in words.

    Attributes:
        concept: its text or file.
        weight: omega.
        groups: names of the groups of columns that its weight is on; all columns where empty.
    """

    concept: str
    weight: float = 1.0
    groups: tuple[str, ...] = ()


def parse_composition(text: str) -> list[Part]:
    """Concepts, weights and groups of columns from ``'circle right of square:1.2 + walk@legs,trunk:0.8'``; a missing weight is 1.

    Raises:
        UserError: for a weight that is no number up to :data:`~ftl_lightning.ranges.LARGEST_FACTOR`, or an empty concept or group.
    """
    parts = []
    for part in text.split(" + ") if text.strip() else ():
        told, colon, weight = part.partition(":")
        concept, at, groups = told.partition("@")
        try:
            omega = float(weight) if colon else 1.0
        except ValueError:
            omega = math.nan
        found = Part(concept.strip(), omega, tuple(group.strip() for group in groups.split(",")) if at else ())
        if not (found.concept and abs(omega) <= LARGEST_FACTOR and all(found.groups)):
            raise UserError(
                "compose: expected 'concept:weight + concept@group:weight', "
                f"weights up to {LARGEST_FACTOR:g}, found {short(part)!r}"
            )
        parts.append(found)
    return parts
