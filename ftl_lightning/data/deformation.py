"""Deformations of paths: variation within a concept by place, affine shape, pace and a rest; corrections at pinned states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

FULL = 3
"""Maximum number of columns of a full affine map, with slants and rotations; of more columns each is scaled alone."""
RIDGE = 1e-3
"""Ridge penalty of scales and paces, relative to the mean square of what they explain."""
ROUNDS = 20
"""Rounds in which shift, affine map and pace are fitted in turn (backfitting)."""
_LEAST = 1e-12


COMMON = 0.1
"""Minimum mean square of the motion of a common path, relative to that of deviations from it. Scribbles have .03, kinds of strokes,
pens, beats and other recorded behaviour .3 to 20."""


def share_a_path(paths: Tensor) -> bool:
    """Whether paths ``(example, horizon, state)`` of a concept vary about a common path, apart from their place.

    The mean of scribbles is nearly a point: its deformations would be many times as large as any path. Single states count as
    sharing a path.
    """
    mean = paths.mean(dim=0)
    apart = paths - mean
    moves, deviates = mean - mean.mean(dim=0), apart - apart.mean(dim=1, keepdim=True)
    return bool(moves.square().mean() >= COMMON * deviates.square().mean())


@dataclass(frozen=True, eq=False)
class Deformations:
    """Deviations of examples from the mean of their concept, as deformations of this mean.

    A deviation from the mean path m is ``shift + A (m(t) - mean of m) + sum_j pace_j g_j(t) m'(t) + rest(t)``, where
    ``g_1 = t (1 - t)`` and ``g_2 = t (1 - t) (2 t - 1)`` keep both ends. Applied to another path, a square gets larger, slanted or
    slower as circles do, and stays a square.

    Attributes:
        shift: ``(example, 1, state)``.
        affine: ``(example, state, state)``, of centred columns.
        pace: ``(example, 2)``.
        rest: ``(example, horizon, state)``.
    """

    shift: Tensor
    affine: Tensor
    pace: Tensor
    rest: Tensor

    @classmethod
    def fit(cls, concepts: Sequence[Tensor], deform: bool = True) -> Self:
        """Fit to examples ``(example, horizon, state)`` of each concept, two or more; scaled to the variance within concepts.

        Without ``deform`` all of a deviation is rest: where paths follow places, a deformed one would leave them.
        """
        means = torch.cat([paths.mean(dim=0, keepdim=True).expand_as(paths) for paths in concepts])
        scales = [torch.full((len(paths), 1, 1), (len(paths) / (len(paths) - 1)) ** 0.5) for paths in concepts]
        apart = (torch.cat(list(concepts)) - means) * torch.cat(scales).to(means)
        if not deform:
            count, _, state = apart.shape
            return cls(apart.new_zeros(count, 1, state), apart.new_zeros(count, state, state), apart.new_zeros(count, 2), apart)
        centred, moves = means - means.mean(dim=1, keepdim=True), _moves(means)
        slower = torch.zeros_like(apart)
        for _ in range(ROUNDS):
            shift = (apart - slower).mean(dim=1, keepdim=True)
            gram, products = centred.mT @ centred, centred.mT @ (apart - slower)
            if means.shape[2] > FULL:
                gram, products = (torch.diag_embed(each.diagonal(dim1=1, dim2=2)) for each in (gram, products))
            affine = _ridge(gram, products)
            rest, flat = apart - shift - centred @ affine, moves.flatten(2)  # (example, 2, horizon * state)
            pace = _ridge(flat @ flat.mT, flat @ rest.flatten(1)[..., None])[..., 0]
            slower = torch.einsum("ej,ejts->ets", pace, moves)
        return cls(shift, affine, pace, rest - slower)

    def __len__(self) -> int:
        return len(self.rest)

    def of(self, paths: Tensor, chosen: Tensor) -> Tensor:
        """Deviations ``(path, horizon, state)`` of paths by the deformations of examples ``chosen (path,)``."""
        centred = paths - paths.mean(dim=1, keepdim=True)
        slower = torch.einsum("pj,pjts->pts", self.pace[chosen], _moves(paths))
        return self.shift[chosen] + centred @ self.affine[chosen] + slower + self.rest[chosen]


def _moves(paths: Tensor) -> Tensor:
    """Derivatives of paths ``(path, horizon, state)`` by each pace ``(path, 2, horizon, state)``; 0 for fewer than three states."""
    horizon = paths.shape[1]
    if horizon < 3:
        return paths.new_zeros(len(paths), 2, *paths.shape[1:])
    time = torch.linspace(0, 1, horizon, device=paths.device, dtype=paths.dtype)
    bends = torch.stack((time * (1 - time), time * (1 - time) * (2 * time - 1)))
    speed = torch.gradient(paths, dim=1)[0] * (horizon - 1)
    return bends[:, :, None] * speed[:, None]


def _ridge(gram: Tensor, products: Tensor) -> Tensor:
    """Ridge regressions ``(example, n, k)`` by matrices ``(example, n, n)`` and products ``(example, n, k)``."""
    size = gram.diagonal(dim1=1, dim2=2).mean(dim=1).clamp(min=_LEAST)
    eye = torch.eye(gram.shape[1], device=gram.device, dtype=gram.dtype)
    return torch.linalg.solve(gram + RIDGE * size[:, None, None] * eye, products)


REACH = 0.1
"""Standard deviation of the correction around a pinned state, as a share of the horizon."""


class Pinned:
    """Known states of plans, such as the initial state: every estimate of the clean plans is conditioned on them.

    Diffuser (Janner et al., 2022) replaces the known states alone, which leaves a step beside each. Here the correction is the
    conditional mean of a Gaussian process of time: it is exact at the known times and fades over a share :data:`REACH` of the plan.

    Args:
        mask: known numbers ``(batch, horizon, state)`` of bool; the times of a column are the same in all plans.
        values: their values in the same shape, normalised; ignored elsewhere.
    """

    def __init__(self, mask: Tensor, values: Tensor) -> None:
        self.mask, self.values = mask, values
        time = torch.arange(mask.shape[1], dtype=torch.float64, device=mask.device)
        kernel = torch.exp(-0.5 * ((time[:, None] - time) / max(REACH * len(time), 1e-6)).square())
        weights = torch.zeros(mask.shape[2], len(time), len(time), dtype=torch.float64, device=mask.device)
        for column, known in enumerate(mask[0].T):
            if known.any():
                among = kernel[known][:, known] + 1e-9 * torch.eye(int(known.sum()), dtype=torch.float64, device=mask.device)
                weights[column][:, known] = torch.linalg.solve(among, kernel[known]).T
        self.weights = weights.to(values.dtype)

    def __call__(self, clean: Tensor) -> Tensor:
        """Condition estimates ``(batch, horizon, state)``."""
        missing = torch.where(self.mask, self.values - clean, 0)
        moved = clean + torch.einsum("cts,bsc->btc", self.weights, missing)
        return torch.where(self.mask, self.values, moved)
