"""When an inversion stops: each run by itself, once its loss on held-out noise no longer falls."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

ROUND = 10
"""Steps between two looks at the loss on held-out noise."""
IDLE = 2
"""Rounds that gain too little before a run stops."""


class Stopping(nn.Module):
    """The mean of every run's embeddings and weights over the round of :data:`ROUND` steps that had the least held-out loss.

    The mean over a round takes the place of a decaying learning rate, which would have to know the number of steps. All that is
    kept is in buffers, so that checkpoints resume exactly.

    Args:
        embeddings: where runs start ``(run, K, knots, n)``.
        weights: where the weights of runs start ``(run, K)``.
        tolerance: a run stops when :data:`IDLE` rounds one after another gained less than this share of its whole gain.

    Attributes:
        going: the runs ``(run,)`` that have not stopped.
        embeddings, weights: the best of every run so far.
        least: their held-out losses ``(run,)``.
        rounds: how many have ended.
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
        """Take note of the held-out losses ``(run,)`` before the first step."""
        self.least[:] = losses
        self._first[:] = losses

    @torch.no_grad()
    def stepped(self, step: int, embeddings: Tensor, weights: Tensor, held_out: Callable[[Tensor, Tensor, Tensor], Tensor]) -> bool:
        """Take note of a step, and at the end of a round stop the runs that gain no more.

        Args:
            step: its number from 0.
            embeddings, weights: of every run after it.
            held_out: ``(embeddings, weights, runs) -> losses`` of the runs that are true among ``runs (run,)``.

        Returns:
            Whether any run goes on.
        """
        self._sums += embeddings
        self._weight_sums += weights
        if (step + 1) % ROUND:
            return True
        self.rounds += 1
        mean, weight_mean = self._sums / ROUND, self._weight_sums / ROUND
        losses = torch.full_like(self.least, torch.inf)
        losses[self.going] = held_out(mean, weight_mean, self.going)
        better = losses < self.least  # of none that has stopped
        gained = (self.least - losses).clamp(min=0)
        self.embeddings[better], self.weights[better], self.least[better] = mean[better], weight_mean[better], losses[better]
        little = gained <= self.tolerance * (self._first - self.least)
        self._idle[:] = torch.where(little, self._idle + 1, 0)
        self.going &= self._idle < IDLE
        self._sums.zero_()
        self._weight_sums.zero_()
        return bool(self.going.any())
