"""Recognition by examples: whether a plan belongs to a concept and is as typical as real behaviour.

Features of a plan, after columns are scaled alike: place (mean over time of each column), size (root mean square about the place),
shape (the normalised rest, as coefficients of the discrete cosine transform) and roughness (mean squared second difference). A
single state has only a size and a shape, its columns.

A concept is a Gaussian over place, size and shape (regularised discriminant analysis; Friedman, 1989). Its variances are pooled
over concepts, and shrink less towards the pooled variances the more examples the concept has; its covariance includes the
directions in which its examples vary. A plan belongs to the likeliest concept. The largest distance of real behaviour from its
concept is estimated by leave-one-out, with as many examples as the concept has. Only excess roughness counts. If no concept has two
examples, only the likeliest concept and the roughness decide.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, reduce

import torch
from torch import Tensor

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.spectrum import cosines

STILL = 0.05
"""Size, relative to the examples', below which behaviour counts as still and has no shape."""
VARIANCE = 4e-4
"""Minimum variance of a place or size, in squared spreads of a column: a standard deviation of 1/50."""
EVEN, SHAPE_VARIANCE = 0.1, 1e-4
"""Minimum variance of a shape coefficient, relative to the mean variance, and of a whole shape, whose root mean square is 1."""
ROUGHNESS = 4e-4
"""Mean squared second difference that counts as smooth, in squared spreads of a column."""
PRIOR, SHAPE_PRIOR = 10.0, 5.0
"""Weight, in examples, of the pooled variances of places and sizes, and of shapes."""
RESTING = 0.25
"""Deviation from the last state after the end that counts as rest, in spreads of a column."""
ENDS, LEFT_OUT = 8, 200
"""Maximum number of candidate lengths of a plan, and of examples for leave-one-out."""
FOLDS = 5
"""Parts of the examples of which one is judged with limits of the others."""
FEW = 1.0
"""Relative increase of limits times the number of concepts in leave-one-out: limits from few concepts are uncertain."""
ROUGHER = 2.0
"""Limit of the roughness relative to the example's (root mean square) if no concept has two examples."""


@dataclass(frozen=True)
class _Features:
    """Place ``(n, columns + 1)`` with the size's logarithm, shape, roughness, and deviation from rest after the end ``(n,)``."""

    position: Tensor
    shape: Tensor
    roughness: Tensor
    rest: Tensor

    def rows(self, rows: Sequence[int]) -> "_Features":
        index = torch.tensor(rows)
        return _Features(self.position[index], self.shape[index], self.roughness[index], self.rest[index])


@dataclass(frozen=True)
class _Within:
    """Sums of squared deviations of positions and shapes from concept means, and their degrees of freedom."""

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
    """Gaussian model of a concept.

    The precision of shapes is the diagonal ``precision`` minus a low-rank part of ``loadings`` and ``inverse`` (Woodbury's
    identity). ``volume`` is the log-determinant without the means' uncertainty, which would favour concepts with many examples.
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
        """Fit to examples of the concept, given the pooled scatter."""
        count, coefficients = known.shape.shape
        scatter, wider = _Within.of(known), 1 + 1 / count  # uncertainty of the mean
        common = within.position / max(within.freedom, 1)
        variance = ((scatter.position + PRIOR * common) / (count - 1 + PRIOR)).clamp(min=VARIANCE)
        even = within.shape / max(within.freedom, 1)
        even = even + EVEN * even.mean() + SHAPE_VARIANCE / coefficients
        weight = 1 / (count - 1 + SHAPE_PRIOR)
        scale = weight * (scatter.shape.sum() / even.sum() + SHAPE_PRIOR)  # variation relative to all concepts
        diagonal = even * scale * SHAPE_PRIOR * weight
        loadings = (known.shape - known.shape.mean(dim=0)) * math.sqrt(weight)
        scaled = loadings / diagonal
        inner = torch.eye(count, dtype=diagonal.dtype) + scaled @ loadings.T
        volume = variance.log().sum() + diagonal.log().sum() + torch.linalg.slogdet(inner).logabsdet
        mean = known.position.mean(dim=0), known.shape.mean(dim=0), known.roughness.mean(dim=0)
        inverse = torch.linalg.inv(inner) / wider
        return cls(mean[0], variance * wider, mean[1], 1 / (diagonal * wider), scaled, inverse, float(volume), mean[2])

    def distances(self, features: _Features, resting: float) -> tuple[Tensor, Tensor]:
        """Mahalanobis distances of ``n`` plans from the concept.

        Returns:
            -2 log-likelihood ``(n,)`` up to a constant, and deviations ``(n, 5)`` of place, size, shape, roughness and rest, each
            in standard deviations: about 1 for typical behaviour.
        """
        position = (features.position - self.position) ** 2 / self.variance
        difference = features.shape - self.shape
        along = difference @ self.loadings.T
        shape = (difference**2 * self.precision).sum(dim=1) - torch.einsum("nk,kl,nl->n", along, self.inverse, along)
        shape = shape.clamp(min=0)
        rough = ((features.roughness + ROUGHNESS) / (self.roughness + ROUGHNESS)).mean(dim=1)
        squares = (
            position[:, :-1].mean(dim=1) if position.shape[1] > 1 else torch.zeros_like(shape),
            position[:, -1],
            shape / difference.shape[1],
            rough if self.roughness.numel() else torch.ones_like(shape),
            (features.rest / resting) ** 2,
        )
        return position.sum(dim=1) + shape + self.volume, torch.stack(squares, dim=1).sqrt()


class Recognition:
    """Classifier of plans, fitted to examples of concepts.

    Args:
        examples: at least one per concept. If their lengths differ, a plan may end at any of these lengths and then rests.
        horizon: states in a plan.
        share: share of real behaviour to accept as typical, in (0, 1].
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
        self.total = reduce(_Within.plus, self.within.values())
        if not self.total.freedom:  # single examples: use the variation between concepts
            self.total = _Within.of(self.known)
        self.concepts = {concept: _Concept.of(self.known.rows(rows), self.total) for concept, rows in self.rows.items()}
        self._limits = cache(self._left_out)

    def recognised(self, goal: str, states: Tensor) -> Tensor:
        """Whether plans ``(sample, time, state)`` are finite, likeliest under and typical of a goal's concept: ``(sample,)``."""
        finite = states.isfinite().flatten(1).all(dim=1)
        ending = self._ending(self._fitted(torch.where(finite[:, None, None], states, 0)))
        score, deviation = _nearest_end(self.concepts[goal], ending, self.resting)
        others = [_nearest_end(concept, ending, self.resting)[0] for name, concept in self.concepts.items() if name != goal]
        likeliest = torch.stack([score, *others]).argmin(dim=0) == 0
        typical = (deviation <= self._limits(len(self.rows[goal]))).all(dim=1)
        return finite & likeliest & typical

    def acceptance(self, count: int) -> float:
        """Share of left-out examples that are recognised by ``count`` others of their concept, with the limits of other examples.

        NaN if no concept has two examples.
        """
        used, scores, deviations = self._leave_one_out(count)
        if len(used) < 2:
            return math.nan
        rows = [row for _, row in used]
        ending = [end.rows(rows) for end in self.presented]
        likeliest = torch.ones(len(used), dtype=torch.bool)
        for name, concept in self.concepts.items():
            other = torch.tensor([own != name for own, _ in used])
            likeliest &= ~other | (scores <= _nearest_end(concept, ending, self.resting)[0])
        fold, typical = torch.arange(len(used)) % min(FOLDS, len(used)), torch.zeros_like(likeliest)
        for number in fold.unique():
            here = fold == number
            typical[here] = (deviations[here] <= self._limits_of(deviations[~here])).all(dim=1)
        return float((typical & likeliest).float().mean())

    def _left_out(self, count: int) -> Tensor:
        """Limits ``(5,)`` of deviations from a concept with ``count`` examples, by leave-one-out."""
        used, _, deviations = self._leave_one_out(count)
        if not used:
            return torch.tensor([math.inf, math.inf, math.inf, ROUGHER, 1], dtype=torch.float64)
        return self._limits_of(deviations)

    def _limits_of(self, deviations: Tensor) -> Tensor:
        """Limits ``(5,)`` of deviations ``(n, 5)`` that accept a share of them."""
        limits = deviations.quantile(self.share, dim=0).clamp(min=1)
        together = (deviations / limits).amax(dim=1).quantile(self.share)  # joint limit of all five
        several = sum(len(rows) > 1 for rows in self.rows.values())
        return (limits * together * (1 + FEW / several)).clamp(min=1)

    def _leave_one_out(self, count: int) -> tuple[list[tuple[str, int]], Tensor, Tensor]:
        """Concept and row of left-out examples, and their scores ``(n,)`` and deviations ``(n, 5)`` from ``count`` others."""
        draw = generator("cpu", count)
        pairs = [(concept, row) for concept, rows in self.rows.items() if len(rows) > 1 for row in rows]
        used = [pairs[pair] for pair in torch.randperm(len(pairs), generator=draw)[:LEFT_OUT].tolist()]
        found = []
        for concept, row in used:
            rest = [candidate for candidate in self.rows[concept] if candidate != row]
            chosen = [rest[index] for index in torch.randperm(len(rest), generator=draw)[:count].tolist()]
            within = self.total.plus(self.within[concept], -1).plus(_Within.of(self.known.rows(rest)))
            fitted = _Concept.of(self.known.rows(chosen), within if within.freedom else self.total)
            found.append(_nearest_end(fitted, [ending.rows([row]) for ending in self.presented], self.resting))
        if not found:
            return [], torch.zeros(0, dtype=torch.float64), torch.zeros(0, 5, dtype=torch.float64)
        scores, deviations = zip(*found, strict=True)
        return used, torch.cat(scores), torch.cat(deviations)

    def _fitted(self, states: Tensor) -> Tensor:
        """Cut or pad with the last state to ``(n, horizon, state)``."""
        times = torch.arange(self.horizon).clamp(max=states.shape[1] - 1)
        return states[:, times].double()

    def _ending(self, states: Tensor) -> list[_Features]:
        """Features for each candidate length."""
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
    """Scale of each column ``(state,)``: its variation within behaviour, else between behaviours, else its magnitude."""
    counts = kept.sum(dim=1)[:, None]
    places = (states * kept[..., None]).sum(dim=1) / counts
    moved = ((states - places[:, None]).square() * kept[..., None]).sum(dim=1) / counts
    within, between = moved.mean(dim=0).sqrt(), places.std(dim=0, correction=0)
    size = places.abs().mean(dim=0)
    spread = torch.where(within > 1e-6 * size, within, between)
    spread = torch.where(spread > 1e-6 * size, spread, size)
    return torch.where(spread > 0, spread, 1)


def _stretched(states: Tensor, lengths: Tensor) -> Tensor:
    """Resample behaviour ``(n, time, state)`` from its lengths ``(n,)`` to ``time`` even steps."""
    times = torch.linspace(0, 1, states.shape[1], dtype=states.dtype) * (lengths - 1)[:, None]
    before = times.floor().long()
    after = torch.minimum(before + 1, (lengths - 1)[:, None])
    share = (times - before)[..., None]
    index = torch.arange(len(states))[:, None]
    return states[index, before] * (1 - share) + states[index, after] * share


def _nearest_end(concept: _Concept, ending: Sequence[_Features], resting: float) -> tuple[Tensor, Tensor]:
    """Results of :meth:`_Concept.distances` at the likeliest end."""
    distances = [concept.distances(features, resting) for features in ending]
    scores = torch.stack([score for score, _ in distances])  # (end, n)
    deviations = torch.stack([deviation for _, deviation in distances])
    best = (scores + torch.where(deviations[..., -1] > 1, 1e30, 0)).argmin(dim=0)
    index = torch.arange(scores.shape[1])
    return scores[best, index], deviations[best, index]
