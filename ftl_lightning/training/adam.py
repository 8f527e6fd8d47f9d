"""Adam without the optimiser classes of torch."""

import math

import torch
from torch import Tensor, nn
from torch.optim.adam import adam


class Group:
    """A parameter and its state of Adam with cosine decay, with the arithmetic of torch's optimiser.

    torch's optimiser classes import its compiler on first use, which may take longer than learning a concept.
    """

    def __init__(self, parameter: nn.Parameter, rate: float) -> None:
        self.parameter, self.rate = parameter, rate
        self._mean, self._square = torch.zeros_like(parameter), torch.zeros_like(parameter)
        self._count = torch.zeros(())

    @torch.no_grad()
    def step(self, gradient: Tensor, decay: tuple[int, int] | None) -> None:
        """Make a gradient step; the next learning rate follows the decay's recursion in torch's order of arithmetic.

        Args:
            gradient: gradient of the parameter.
            decay: number of the step from 0 and total steps; ``None`` for a constant rate.
        """
        adam(
            [self.parameter],
            [gradient],
            [self._mean],
            [self._square],
            [],
            [self._count],
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
        if decay is not None:
            step, steps = decay
            after, before = (1 + math.cos(math.pi * done / steps) for done in (step + 1, step))
            self.rate = after / before * self.rate
