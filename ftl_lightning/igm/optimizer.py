"""Adam for the few parameters of an inversion."""

import math

import torch
from torch import Tensor, nn
from torch.optim.adam import adam


class Adam:
    """Adam (Kingma & Ba, 2015) for one parameter, with cosine decay, in the arithmetic of torch's optimiser and scheduler.

    torch's optimiser classes import torch's compiler on first use, which may take longer than learning a concept.

    Args:
        parameter: parameter, changed in place.
        rate: initial learning rate.
    """

    def __init__(self, parameter: nn.Parameter, rate: float) -> None:
        self.parameter, self.rate = parameter, rate
        self._mean, self._square, self._count = torch.zeros_like(parameter), torch.zeros_like(parameter), torch.zeros(())

    @torch.no_grad()
    def step(self, gradient: Tensor, step: int, decay_steps: int | None) -> None:
        """Make gradient step ``step``, numbered from 0; ``decay_steps`` until the rate is 0, ``None`` for a constant rate."""
        self.parameter.grad = gradient
        rates = {"lr": self.rate, "beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "weight_decay": 0.0}
        state: list[list[Tensor]] = [[self._mean], [self._square], [], [self._count]]  # the empty list is of AMSGrad
        adam([self.parameter], [gradient], *state, amsgrad=False, maximize=False, **rates)  # type: ignore[arg-type]
        if decay_steps is not None:  # as a factor of the last rate, as in torch's CosineAnnealingLR
            after, before = (1 + math.cos(math.pi * done / decay_steps) for done in (step + 1, step))
            self.rate = after / before * self.rate
