"""Observed features that are places: positions in the space in which a plan moves, such as its start, an object, a goal."""

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ftl_lightning.data.actions import INITIAL, action_columns
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Observed

Places = Mapping[str, tuple[int, ...]]
"""Columns of the state in the same frame as an observed vector, by the name of the feature, or of a part of it: ``goals[2:4]``. A
place that several groups of columns follow has several names: ``goal`` and ``goal at 4``, by the first column of the group.
"""

EQUAL = 1e-4
"""Maximum difference of the initial state from a feature that equals it, relative to the columns' range."""
FOLLOWED = 0.1
"""Maximum variance of the distance to a place, at the time at which a concept follows it most, relative to the place's variance."""
STRICTLY = 0.01
"""The same for single numbers of a vector, of which some are alike a column by chance."""
MOST_SPACE = 3
"""Maximum number of columns of a position."""
RIDGE, WINDOW = 0.01, 0.05
"""Ridge penalty of the shares with which paths follow places, relative to the places' mean square; half width of the window of
times that share an estimate, as a share of the horizon.
"""
UNMOVED = 0.01
"""Minimum standard deviation of a column, relative to its places', for the column to show which places it follows."""
ALIKE = 1.5
"""Maximum ratio of the standard deviations of two places of a kind; their means differ by at most a standard deviation."""
MOST_ALIKE = 4
"""Maximum number of places of a kind whose exchange is a prior."""
PRIOR = 0.01
"""Ridge penalty of the weights of known frames, relative to the mean square of what they explain."""


_PART = re.compile(r"(.+?)(?:\[(\d+):(\d+)\])?(?: at \d+)?")


def feature_of(name: str, features: Mapping[str, object]) -> str:
    """Name of the feature that is a place, or of which a place is a part."""
    part = None if name in features else _PART.fullmatch(name)
    return part[1] if part else name


def place_of(observed: Observed, name: str) -> Tensor:
    """Values of a place ``(sample, size)``."""
    part = None if name in observed else _PART.fullmatch(name)
    if part is None or part[2] is None:
        return observed[feature_of(name, observed)].flatten(1)
    return observed[part[1]].flatten(1)[:, int(part[2]) : int(part[3])]


def first_windows(demonstrations: Demonstrations, horizon: int) -> Tensor:
    """First windows of demonstrations ``(demo, horizon, state)``; the last state of a shorter demonstration is repeated."""
    rows = torch.arange(len(demonstrations))
    return demonstrations.windows(rows, torch.zeros_like(rows), horizon)[0]


def vectors_of(demonstrations: Demonstrations) -> dict[str, Tensor]:
    """Observed vectors at time 0 ``(demo, size)`` by name, without images."""
    observed = demonstrations.initial_states.observed
    return {name: values.flatten(1).float() for name, values in observed.items() if values.dtype != torch.uint8}


def _windows(size: int, units: tuple[str, ...], width: int) -> list[tuple[int, ...]]:
    """Adjacent columns, as many as the feature has numbers, of the same unit."""
    groups = [tuple(range(first, first + size)) for first in range(width - size + 1)]
    return [group for group in groups if len({units[column] for column in group} if units else {""}) == 1]


def _width(demonstrations: Demonstrations) -> int:
    """Number of columns of a state without actions, which are the last."""
    return demonstrations.states.shape[2] - len(action_columns(demonstrations.state_names))


def starts(demonstrations: Demonstrations) -> Places:
    """Features that equal columns of the initial state in every demonstration."""
    first, found = demonstrations.states[:, 0, : _width(demonstrations)], {}
    spread = first.amax(dim=0) - first.amin(dim=0)
    for name, values in vectors_of(demonstrations).items():
        for columns in _windows(values.shape[1], demonstrations.state_units, first.shape[1]):
            chosen = list(columns)
            near = (first[:, chosen] - values).abs().amax(dim=0) <= EQUAL * spread[chosen]
            if near.all() and (spread[chosen] > 0).all():
                found[name] = columns
                break
    return found


def places(demonstrations: Demonstrations, horizon: int) -> Places:
    """Features that paths of some concept follow: at some time the path varies with the feature, and hardly beside it.

    A vector may hold several places, such as goals. A place that no training concept follows is one if it is alike the followed
    places of its vector, or two others: a new concept may follow it.

    Args:
        demonstrations: demonstrations of training concepts, several of each.
        horizon: number of states that are compared.
    """
    paths, rows = first_windows(demonstrations, horizon), list(demonstrations.rows_of.values())
    found: dict[str, tuple[int, ...]] = {name: columns for name, columns in starts(demonstrations).items() if name != INITIAL}
    begin, width = set(found), _width(demonstrations)
    vectors = {name: values for name, values in vectors_of(demonstrations).items() if name != INITIAL}

    def best(values: Tensor) -> tuple[float, tuple[int, ...]]:
        """Least share of the variance beside the place that remains, and the columns."""
        windows = _windows(values.shape[1], demonstrations.state_units, width)
        return min(((_beside(paths, rows, values, columns), columns) for columns in windows), default=(float("inf"), ()))

    parts: dict[str, Tensor] = {}
    for name, values in vectors.items():
        if name in found:
            continue
        for each in _parts(name, values, width):
            most = FOLLOWED if all(value.shape[1] > 1 for value in each.values()) or name in each else STRICTLY
            some = {part: columns for part, value in each.items() for share, columns in [best(value)] if share <= most}
            if some:
                found |= some
                parts |= each
                break
        else:
            parts |= {name: values} if values.shape[1] <= width else {}
    followed = [name for name in found if name not in begin]
    for name, values in parts.items():
        whole = feature_of(name, vectors)
        kin = [other for other in followed if _alike(values, parts[other])] if name not in found else []
        if len(kin) >= 2 or any(whole == feature_of(other, vectors) for other in kin):
            found[name] = found[kin[0]]
    if INITIAL in demonstrations.observed:
        several = [
            (f"{name} at {columns[0]}", columns)
            for name, values in parts.items()
            if name in found
            for columns in _windows(values.shape[1], demonstrations.state_units, width)
            if not set(columns) & set(found[name]) and _beside(paths, rows, values, columns) <= FOLLOWED
        ]
        found |= {**dict(several), **objects(demonstrations, horizon)}
    return found


def objects(demonstrations: Demonstrations, horizon: int) -> Places:
    """Parts of the initial state that other columns follow, such as the position of an object that a hand goes to.

    With them are the initial positions of all these columns. Empty if no column follows others.

    Args:
        demonstrations: demonstrations of training concepts, several of each.
        horizon: number of states that are compared.
    """
    paths, rows = first_windows(demonstrations, horizon), list(demonstrations.rows_of.values())
    width = _width(demonstrations)
    near = _followed(paths[..., :width], rows)
    for size in range(min(width // 2, MOST_SPACE), 1, -1):
        windows = _windows(size, demonstrations.state_units, width)
        found = [
            (first, columns)
            for first in windows
            for columns in windows
            if near[list(first), list(columns)].all() and not set(first) & set(columns)
            if _beside(paths, rows, paths[:, 0, list(first)], columns) <= FOLLOWED
        ]
        if found:
            every = [*found, *((group, group) for group in dict.fromkeys(itertools.chain(*found)))]
            return {f"{INITIAL}[{first[0]}:{first[-1] + 1}] at {columns[0]}": columns for first, columns in every}
    return {}


def _followed(paths: Tensor, rows: list[list[int]]) -> Tensor:
    """Whether a column alone follows the first value of another in some concept ``(first, column)``: necessary for positions."""
    near = torch.zeros(paths.shape[2], paths.shape[2], dtype=torch.bool)
    for some in (paths[some] for some in rows if len(some) > 2):
        for column, first in enumerate(some[:, 0].unbind(dim=1)):
            near[column] |= (some - first[:, None, None]).var(dim=0).amin(dim=0) <= 1.001 * FOLLOWED * first.var()
    return near


def _beside(paths: Tensor, rows: list[list[int]], values: Tensor, columns: tuple[int, ...]) -> float:
    """Least variance of columns beside a place, relative to the place's, over concepts (``rows``) and times."""
    shares = [
        float((rest.var(dim=0) / values[some].var(dim=0)).amax(dim=1).min())
        for some in rows
        if len(some) > 2 and (values[some].var(dim=0) > 1e-12).all()
        for rest in [paths[some][..., list(columns)] - values[some][:, None]]
    ]
    return min(shares, default=float("inf"))


def _parts(name: str, values: Tensor, width: int) -> Iterator[dict[str, Tensor]]:
    """Ways to divide a vector ``(demo, size)`` into places of at most ``width`` numbers, the largest first."""
    size = values.shape[1]
    for each in range(min(size, width), 0, -1):
        if size % each == 0:
            starts = range(0, size, each)
            yield {name if each == size else f"{name}[{first}:{first + each}]": values[:, first : first + each] for first in starts}


def _alike(values: Tensor, others: Tensor) -> bool:
    """Whether two features may be places of a kind, such as two goals: as many numbers, in the same range."""
    if values.shape != others.shape:
        return False
    first, second = values.std(dim=0).clamp(min=1e-9), others.std(dim=0).clamp(min=1e-9)
    near = (values.mean(dim=0) - others.mean(dim=0)).abs() <= torch.minimum(first, second)
    return bool((near & (first <= ALIKE * second) & (second <= ALIKE * first)).all())


def _exchanged(prior: Tensor, columns: list[tuple[int, ...]]) -> Tensor:
    """Frames ``(frame, place, time)`` with those whose places of a kind are exchanged: what training concepts do with one goal, a
    new concept may do with another. The place where paths begin is no goal.
    """
    later = [number for number in range(len(columns)) if float(prior[:, number, 0].abs().mean()) < 0.5]
    kinds = [[number for number in later if columns[number] == kind] for kind in dict.fromkeys(columns[number] for number in later)]
    orders = [list(range(len(columns)))]
    for kind in kinds:
        if 1 < len(kind) <= MOST_ALIKE:
            orders = [
                [mixed.get(number, order[number]) for number in range(len(order))]
                for order in orders
                for mixed in (dict(zip(kind, (order[n] for n in several), strict=True)) for several in itertools.permutations(kind))
            ]
    return torch.cat([prior[:, order] for order in orders]) if len(orders) > 1 else prior


@dataclass(frozen=True)
class Frames:
    """Shares with which a concept's paths follow each place, by time: ``x(t) = u(t) + sum_p share_p(t) place_p``.

    What remains, u, does not depend on where things are. Task-parameterised models (Calinon, 2016) weigh frames by the inverse of
    their covariances; here the shares are a ridge regression of the differences among demonstrations.

    Attributes:
        places: columns of each place.
        shares: ``(place, time)``.
    """

    places: Places
    shares: Tensor

    @classmethod
    def fit(cls, paths: Tensor, observed: Observed, known: Places, prior: Tensor | None = None) -> Self:
        """Fit to a few paths ``(demo, horizon, state)`` of one concept and their observed features ``(demo, ...)``.

        With a ``prior``, shares ``(frame, place, time)`` of several concepts, the ridge regression starts at the weighted sum of
        the prior's shares that explains the paths best, and not at 0. A single path has their mean.
        """
        named = {name: columns for name, columns in known.items() if feature_of(name, observed) in observed}
        count, horizon, width = paths.shape
        if prior is not None and count < 2:
            return cls(named, prior.mean(dim=0))
        prior = prior if prior is None or prior.shape[1] != len(named) else _exchanged(prior, list(named.values()))
        if not named or count < 2:
            return cls({}, paths.new_zeros(0, horizon))
        spread = (paths - paths.mean(dim=0)).square().mean(dim=(0, 1)).sqrt()
        moved = paths.new_zeros(len(named), count, width)
        for number, (name, columns) in enumerate(named.items()):
            values = place_of(observed, name).to(paths)
            moved[number][:, list(columns)] = values - values.mean(dim=0)
        varies = spread > UNMOVED * moved.square().mean(dim=1).amax(dim=0).sqrt()
        scale = torch.where(varies, spread, torch.inf)
        regressors = (moved / scale).flatten(1)  # (place, demo * state)
        targets = ((paths - paths.mean(dim=0)) / scale).transpose(0, 1).flatten(1)  # (time, demo * state)
        time = torch.arange(horizon)
        near = ((time[:, None] - time).abs() <= WINDOW * horizon).to(paths)
        targets = near @ targets / near.sum(dim=1, keepdim=True)
        gram = regressors @ regressors.T
        start = paths.new_zeros(len(named), horizon)
        if prior is not None:
            explained = torch.einsum("fpt,pn->ftn", prior.to(paths), regressors).flatten(1)
            products = explained @ explained.T
            even = torch.full((len(prior),), 1 / len(prior), dtype=paths.dtype)
            ridge = PRIOR * products.diagonal().mean() * torch.eye(len(prior), dtype=paths.dtype)
            weights = even + torch.linalg.solve(products + ridge, explained @ (targets.flatten() - even @ explained))
            start = torch.einsum("f,fpt->pt", weights, prior.to(paths))
        penalty = RIDGE * gram.diagonal().mean() * torch.eye(len(gram))
        missing = regressors @ (targets - start.T @ regressors).T
        return cls(named, start + torch.linalg.solve(gram + penalty, missing))

    def shift(self, observed: Observed, width: int) -> Tensor:
        """What the places add to paths ``(sample, horizon, state)``; ``(1, horizon, state)`` of zeros without places."""
        return shift(self.shares[None], self.places, observed, width)


def shift(shares: Tensor, places: Places, observed: Observed, width: int) -> Tensor:
    """What places add to paths ``(sample, time, width)``, by shares ``(sample, place, time)`` or ``(1, place, time)``."""
    total = shares.new_zeros(1, shares.shape[2], width)
    for number, (name, columns) in enumerate(places.items()):
        values = place_of(observed, name).to(shares)
        added = shares.new_zeros(len(values), shares.shape[2], width)
        added[..., list(columns)] = shares[:, number, :, None] * values[:, None]
        total = total + added
    return total


def frames_of(demonstrations: Demonstrations, horizon: int, known: Places, prior: Tensor | None = None) -> Tensor:
    """Shares ``(concept, place, horizon)`` of :class:`Frames`, of each concept of the demonstrations, in their order."""
    paths, observed, rows = first_windows(demonstrations, horizon), vectors_of(demonstrations), demonstrations.rows_of.values()
    fits = [Frames.fit(paths[some], {key: values[some] for key, values in observed.items()}, known, prior) for some in rows]
    return torch.stack([fit.shares for fit in fits]).float()
