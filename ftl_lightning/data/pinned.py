"""Paths that have to pass known states."""

import torch
from torch import Tensor

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
