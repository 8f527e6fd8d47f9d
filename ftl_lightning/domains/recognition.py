"""Recognising behaviour by examples alone: whether a plan is of a concept, and as typical of it as real behaviour.

A plan is described by its place (mean over time of each column), its size (root mean square about that), its shape (what is left,
as coefficients of the discrete cosine transform over time) and its roughness (mean squared second difference over time); columns
are first brought on one scale. A single state has a size and a shape, its columns.

A concept is a Gaussian of place, size and shape (regularised discriminant analysis; Friedman, 1989). Variances are those within all
concepts, drawn towards the concept's own the more examples it has. Directions in which its own examples differ from one another,
such as the size of a part or pace, are known from these. The likeliest concept is what a plan is of.

How far from its concept real behaviour may be is measured by leaving examples out, with as many examples as the concept has: five
cover less of it than twenty. Only too much roughness counts, smooth plans are right. Where no concept has two examples, nothing is
known of how real behaviour varies: then the likeliest concept decides, and roughness.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.diffusion.spectrum import cosines
from ftl_lightning.seeding import generator

STILL = 0.05
"""Behaviour that moves by less than this share of what examples move by counts as still: it has no shape."""
VARIANCE = 4e-4
"""Least variance of a place or size, in a column's spread: a fiftieth of it is no difference."""
EVEN = 0.1
"""Share of the mean variance that every coefficient of a shape has at least."""
SHAPE_VARIANCE = 1e-4
"""Least variance of a whole shape, which is of root mean square 1."""
ROUGHNESS = 4e-4
"""Mean squared second difference, in a column's spread, that counts as smooth."""
PRIOR = 10.0
"""How many examples the variances of places and sizes within all concepts count for beside a concept's own."""
SHAPE_PRIOR = 5.0
"""The same of shapes."""
RESTING = 0.25
"""Deviation from the last state after behaviour has ended that counts as rest, in a column's spread."""
ENDS = 8
"""Lengths that behaviour may have, of plans that are longer than some examples."""
LEFT_OUT = 200
"""Examples that are left out at most."""
FEW = 1.0
"""Limits grow by this over the number of concepts that examples were left out of: few say little about how concepts differ."""
ROUGHER = 2.0
"""Root mean square roughness over the example's where no concept has two examples."""


@dataclass(frozen=True)
class _Features:
    """What behaviour is described by.

    Attributes:
        position: ``(n, columns + 1)``, places in columns' spreads and the logarithm of the size; of single states the size alone.
        shape: ``(n, coefficient)``.
        roughness: ``(n, columns)``.
        rest: ``(n,)``, root mean square deviation from the last state after the end, in columns' spreads.
    """

    position: Tensor
    shape: Tensor
    roughness: Tensor
    rest: Tensor

    def rows(self, rows: Sequence[int]) -> "_Features":
        index = torch.tensor(rows)
        return _Features(self.position[index], self.shape[index], self.roughness[index], self.rest[index])


@dataclass(frozen=True)
class _Within:
    """Sums of squared deviations from their concepts' means, of positions and shapes, and of how many examples beyond these."""

    position: Tensor
    shape: Tensor
    freedom: int

    @classmethod
    def of(cls, features: _Features) -> "_Within":
        return cls(_scatter(features.position), _scatter(features.shape), len(features.shape) - 1)

    def plus(self, other: "_Within", sign: int = 1) -> "_Within":
        return _Within(
            (self.position + sign * other.position).clamp(min=0),
            (self.shape + sign * other.shape).clamp(min=0),
            self.freedom + sign * other.freedom,
        )


@dataclass(frozen=True)
class _Concept:
    """A Gaussian of behaviour.

    Attributes:
        position, variance: mean and predictive variance of positions.
        shape: mean.
        precision: of shapes, without what ``inverse`` takes off: ``(coefficient,)``.
        loadings, inverse: ``(k, coefficient)`` and ``(k, k)``, the directions in which examples differ (Woodbury's identity).
        volume: logarithm of the determinant of both covariances, as if means were known: else concepts of many examples would be
            favoured, as coefficients of a shape vary together.
        roughness: ``(columns,)``.
    """

    position: Tensor
    variance: Tensor
    shape: Tensor
    precision: Tensor
    loadings: Tensor
    inverse: Tensor
    volume: float
    roughness: Tensor

    @classmethod
    def of(cls, known: _Features, within: _Within) -> "_Concept":
        """From some of its examples, and what varies within concepts."""
        count, coefficients = known.shape.shape
        own, wider = _Within.of(known), 1 + 1 / count  # the mean is not known better
        common = within.position / max(within.freedom, 1)
        variance = ((own.position + PRIOR * common) / (count - 1 + PRIOR)).clamp(min=VARIANCE)
        even = within.shape / max(within.freedom, 1)
        even = even + EVEN * even.mean() + SHAPE_VARIANCE / coefficients
        weight = 1 / (count - 1 + SHAPE_PRIOR)
        scale = weight * (own.shape.sum() / even.sum() + SHAPE_PRIOR)  # a concept may vary more or less than others do
        diagonal = even * scale * SHAPE_PRIOR * weight
        loadings = (known.shape - known.shape.mean(dim=0)) * math.sqrt(weight)
        scaled = loadings / diagonal
        inner = torch.eye(count, dtype=diagonal.dtype) + scaled @ loadings.T
        volume = variance.log().sum() + diagonal.log().sum() + torch.linalg.slogdet(inner).logabsdet
        mean = known.position.mean(dim=0), known.shape.mean(dim=0), known.roughness.mean(dim=0)
        inverse = torch.linalg.inv(inner) / wider
        return cls(mean[0], variance * wider, mean[1], 1 / (diagonal * wider), scaled, inverse, float(volume), mean[2])

    def distances(self, found: _Features, resting: float) -> tuple[Tensor, Tensor]:
        """How unlikely behaviour is ``(n,)``, and how far off in place, size, shape, roughness and rest: ``(n, 5)``, 1 is usual."""
        far = (found.position - self.position) ** 2 / self.variance
        apart = found.shape - self.shape
        along = apart @ self.loadings.T
        square = (apart**2 * self.precision).sum(dim=1) - torch.einsum("nk,kl,nl->n", along, self.inverse, along)
        square = square.clamp(min=0)
        rough = ((found.roughness + ROUGHNESS) / (self.roughness + ROUGHNESS)).mean(dim=1)
        measured = (
            far[:, :-1].mean(dim=1) if far.shape[1] > 1 else torch.zeros_like(square),
            far[:, -1],
            square / apart.shape[1],
            rough if self.roughness.numel() else torch.ones_like(square),
            (found.rest / resting) ** 2,
        )
        return far.sum(dim=1) + square + self.volume, torch.stack(measured, dim=1).sqrt()


class Recognition:
    """What is known of concepts by their examples.

    Args:
        examples: one or more of each concept. Where they are of different lengths, a plan may end where some do, and rests then.
        horizon: states in a plan.
        share: of real behaviour that shall be typical, in (0, 1].
    """

    def __init__(self, examples: Demonstrations, horizon: int, share: float) -> None:
        self.horizon, self.share = horizon, share
        lengths = examples.lengths.clamp(max=horizon)
        states = self._fitted(examples.states)
        kept = torch.arange(states.shape[1]) < lengths[:, None]
        self.spread = _spread(states, kept)
        self.known = self._features(states, lengths)
        self.resting = RESTING + float(self.known.rest.square().mean().sqrt())
        ends = lengths.unique()
        if len(ends) > ENDS:
            ends = torch.quantile(lengths.double(), torch.linspace(0, 1, ENDS, dtype=torch.float64)).round().long().unique()
        self.ends: list[int] = ends.tolist()
        self.presented = self._ending(states)
        self.rows: dict[str, list[int]] = {}
        for row, concept in enumerate(examples.concepts):
            self.rows.setdefault(concept, []).append(row)
        self.within = {concept: _Within.of(self.known.rows(rows)) for concept, rows in self.rows.items()}
        zero = _Within(torch.zeros(self.known.position.shape[1]), torch.zeros(self.known.shape.shape[1]), 0)
        self.total = zero
        for own in self.within.values():
            self.total = self.total.plus(own)
        if not self.total.freedom:  # nothing is known of how concepts vary: as they differ from one another
            self.total = _Within.of(self.known)
        self.concepts = {concept: _Concept.of(self.known.rows(rows), self.total) for concept, rows in self.rows.items()}
        self._limits = cache(self._left_out)

    def recognised(self, goal: str, states: Tensor) -> Tensor:
        """Whether plans are of a concept: it is the likeliest of all, and they are typical of it.

        Args:
            goal: the concept, one with examples.
            states: ``(sample, time, state)``; plans that are not finite are not recognised.

        Returns:
            ``(sample,)`` of bool.
        """
        finite = states.isfinite().flatten(1).all(dim=1)
        ending = self._ending(self._fitted(torch.where(finite[:, None, None], states, 0)))
        unlikely, far = _nearest_end(self.concepts[goal], ending, self.resting)
        others = [_nearest_end(one, ending, self.resting)[0] for name, one in self.concepts.items() if name != goal]
        likeliest = torch.stack([unlikely, *others]).argmin(dim=0) == 0
        typical = (far <= self._limits(len(self.rows[goal]))).all(dim=1)
        return finite & likeliest & typical

    def _left_out(self, count: int) -> Tensor:
        """How far real behaviour may be from a concept that is known by ``count`` examples: ``(5,)``."""
        draw = generator("cpu", count)
        pairs = [(concept, row) for concept, rows in self.rows.items() if len(rows) > 1 for row in rows]
        if not pairs:
            return torch.tensor([math.inf, math.inf, math.inf, ROUGHER, 1], dtype=torch.float64)
        found = []
        for pair in torch.randperm(len(pairs), generator=draw)[:LEFT_OUT].tolist():
            concept, row = pairs[pair]
            rest = [other for other in self.rows[concept] if other != row]
            chosen = [rest[index] for index in torch.randperm(len(rest), generator=draw)[:count].tolist()]
            within = self.total.plus(self.within[concept], -1).plus(_Within.of(self.known.rows(rest)))
            one = _Concept.of(self.known.rows(chosen), within if within.freedom else self.total)
            found.append(_nearest_end(one, [ending.rows([row]) for ending in self.presented], self.resting)[1])
        far = torch.cat(found)
        limits = far.quantile(self.share, dim=0).clamp(min=1)
        together = (far / limits).amax(dim=1).quantile(self.share)  # of all five at once
        return (limits * together * (1 + FEW / len({concept for concept, _ in pairs}))).clamp(min=1)

    def _fitted(self, states: Tensor) -> Tensor:
        """As long as plans are, ``(n, horizon, state)``; what is shorter stays where it ends."""
        times = torch.arange(self.horizon).clamp(max=states.shape[1] - 1)
        return states[:, times].double()

    def _ending(self, states: Tensor) -> list[_Features]:
        """Features of behaviour, for each end that it may have."""
        return [self._features(states, torch.full((len(states),), end)) for end in self.ends]

    def _features(self, states: Tensor, lengths: Tensor) -> _Features:
        scaled = states / self.spread
        last = scaled.gather(1, (lengths - 1)[:, None, None].expand(-1, 1, scaled.shape[2]))
        after = (torch.arange(scaled.shape[1]) >= lengths[:, None])[..., None]
        rest = ((scaled - last) ** 2 * after).sum(dim=(1, 2)) / (after.sum(dim=(1, 2)) * scaled.shape[2]).clamp(min=1)
        rest = rest.sqrt()
        if self.horizon == 1:
            size = (scaled.square().mean(dim=(1, 2)) + STILL**2).log() / 2
            return _Features(size[:, None], scaled[:, 0], scaled[:, 0, :0], rest)
        whole = _stretched(scaled, lengths)
        place = whole.mean(dim=1)
        moved = whole - place[:, None]
        size = (moved.square().mean(dim=(1, 2)) + STILL**2).sqrt()
        shape = cosines(self.horizon) @ (moved / size[:, None, None]) / math.sqrt(self.horizon)
        bends = scaled.diff(n=2, dim=1) if self.horizon > 2 else scaled[:, :0]
        roughness = bends.square().sum(dim=1) / max(bends.shape[1], 1)
        return _Features(torch.cat((place, size.log()[:, None]), dim=1), shape.flatten(1), roughness, rest)


def _scatter(values: Tensor) -> Tensor:
    return (values - values.mean(dim=0)).square().sum(dim=0)


def _spread(states: Tensor, kept: Tensor) -> Tensor:
    """Scale of each column ``(state,)``: how much it varies within behaviour, else between behaviours, else how large it is."""
    counts = kept.sum(dim=1)[:, None]
    places = (states * kept[..., None]).sum(dim=1) / counts
    moved = ((states - places[:, None]).square() * kept[..., None]).sum(dim=1) / counts
    within, between = moved.mean(dim=0).sqrt(), places.std(dim=0, correction=0)
    size = places.abs().mean(dim=0)
    spread = torch.where(within > 1e-6 * size, within, between)
    spread = torch.where(spread > 1e-6 * size, spread, size)
    return torch.where(spread > 0, spread, 1)


def _stretched(states: Tensor, lengths: Tensor) -> Tensor:
    """Behaviour ``(n, time, state)`` of some lengths ``(n,)`` at as many even times from its start to its end."""
    times = torch.linspace(0, 1, states.shape[1], dtype=states.dtype) * (lengths - 1)[:, None]
    before = times.floor().long()
    after = torch.minimum(before + 1, (lengths - 1)[:, None])
    share = (times - before)[..., None]
    index = torch.arange(len(states))[:, None]
    return states[index, before] * (1 - share) + states[index, after] * share


def _nearest_end(concept: _Concept, ending: Sequence[_Features], resting: float) -> tuple[Tensor, Tensor]:
    """How unlikely behaviour is and how far off, see :meth:`_Concept.distances`, with the end that suits the concept best."""
    found = [concept.distances(features, resting) for features in ending]
    unlikely = torch.stack([one for one, _ in found])  # (end, n)
    far = torch.stack([one for _, one in found])
    best = (unlikely + torch.where(far[..., -1] > 1, 1e30, 0)).argmin(dim=0)
    index = torch.arange(unlikely.shape[1])
    return unlikely[best, index], far[best, index]
