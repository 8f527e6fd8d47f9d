"""Early stopping of an inversion: each run stops once its loss on held-out noise no longer falls."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

ROUND = 10
"""Steps between two evaluations of the held-out loss."""
IDLE = 2
"""Patience: rounds with too small a gain before a run stops."""


class Stopping(nn.Module):
    """Mean embeddings and weights of every run over its round of :data:`ROUND` steps with the lowest held-out loss.

    The mean over a round replaces a decaying learning rate, which would need the number of steps. The state is in buffers, so
    that checkpoints resume exactly.

    Args:
        embeddings: initial embeddings ``(run, K, knots, n)``.
        weights: initial weights ``(run, K)``.
        tolerance: a run stops when :data:`IDLE` consecutive rounds gain less than this share of its total gain.

    Attributes:
        going: mask of active runs ``(run,)``.
        embeddings, weights: best of every run so far.
        least: their held-out losses ``(run,)``.
        rounds: number of completed rounds.
    """

    going: Tensor
    embeddings: Tensor
    weights: Tensor
    least: Tensor
    rounds: Tensor
    _first: Tensor
    _idle: Tensor
    _sums: Tensor
    _weight_sums: Tensor

    def __init__(self, embeddings: Tensor, weights: Tensor, tolerance: float) -> None:
        super().__init__()
        self.tolerance = tolerance
        self.register_buffer("going", torch.ones(len(weights), dtype=torch.bool, device=weights.device))
        self.register_buffer("embeddings", embeddings.detach().clone())
        self.register_buffer("weights", weights.detach().clone())
        self.register_buffer("least", torch.full_like(self.weights[:, 0], torch.inf))
        self.register_buffer("_first", self.least.clone())
        self.register_buffer("rounds", torch.zeros((), dtype=torch.int64, device=weights.device))
        self.register_buffer("_idle", torch.zeros(len(weights), dtype=torch.int64, device=weights.device))
        self.register_buffer("_sums", torch.zeros_like(self.embeddings))
        self.register_buffer("_weight_sums", torch.zeros_like(self.weights))

    def begin(self, losses: Tensor) -> None:
        """Record the initial held-out losses ``(run,)``."""
        self.least[:] = losses
        self._first[:] = losses

    @torch.no_grad()
    def stepped(self, step: int, embeddings: Tensor, weights: Tensor, held_out: Callable[[Tensor, Tensor, Tensor], Tensor]) -> bool:
        """Record a step, and at the end of a round stop runs without gain.

        Args:
            step: number of the step from 0.
            embeddings, weights: parameters of every run after the step.
            held_out: ``(embeddings, weights, runs) -> losses`` of the runs in the mask ``runs (run,)``.

        Returns:
            Whether any run is active.
        """
        self._sums += embeddings
        self._weight_sums += weights
        if (step + 1) % ROUND:
            return True
        self.rounds += 1
        mean, weight_mean = self._sums / ROUND, self._weight_sums / ROUND
        losses = torch.full_like(self.least, torch.inf)
        losses[self.going] = held_out(mean, weight_mean, self.going)
        better = losses < self.least  # false for stopped runs
        gained = (self.least - losses).clamp(min=0)
        self.embeddings[better], self.weights[better], self.least[better] = mean[better], weight_mean[better], losses[better]
        little = gained <= self.tolerance * (self._first - self.least)
        self._idle[:] = torch.where(little, self._idle + 1, 0)
        self.going &= self._idle < IDLE
        self._sums.zero_()
        self._weight_sums.zero_()
        return bool(self.going.any())
