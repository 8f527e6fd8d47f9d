"""Early stopping of an inversion: a run stops when its held-out loss no longer falls."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

ROUND = 10
"""Steps between two evaluations of the held-out loss."""
IDLE = 2
"""Patience: consecutive idle rounds after which a run stops."""


class Stopping(nn.Module):
    """Rule of early stopping, and the result of every run.

    A round is :data:`ROUND` gradient steps. After each round, embeddings and weights are averaged over the steps of the round, and
    the held-out loss of the average is evaluated. The result of a run is the average with the lowest held-out loss, or the initial
    value if no average has a lower loss. Averages replace the decay of the learning rate, which requires the number of steps.

    A round is idle if it lowers the lowest held-out loss of the run by at most ``tolerance`` times the total decrease since the
    start. A run stops after :data:`IDLE` consecutive idle rounds. The state is in buffers: checkpoints resume exactly.

    Args:
        embeddings: initial embeddings ``(run, K, knots, n)``.
        weights: initial weights ``(run, K)``.
        tolerance: maximum relative decrease of an idle round, in [0, 1).

    Attributes:
        going: mask of active runs ``(run,)``.
        embeddings, weights: result of every run so far.
        least: held-out losses of the results ``(run,)``.
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
    def after_step(
        self, step: int, embeddings: Tensor, weights: Tensor, held_out: Callable[[Tensor, Tensor, Tensor], Tensor]
    ) -> bool:
        """Add the parameters to the averages of the round; at the end of a round, evaluate the averages and stop runs.

        Args:
            step: number of the step from 0.
            embeddings, weights: parameters of every run after the step.
            held_out: held-out loss ``(embeddings, weights, mask) -> losses`` of the runs in the mask ``(run,)``.

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
