"""Random generators by key, and the draws of several processes."""

import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, distributed, nn
from torch.nn import functional

VALIDATION_SEED = 1_000_000
"""Seed offset of held-out demonstrations."""
DEMONSTRATION_SEED = 2_000_000
"""Seed offset of new tasks' demonstrations, so that they share no random stream with pretraining."""
EVALUATION_SEED = 3_000_000
"""Seed offset of new initial states, so that they share no random stream with demonstrations."""
FRESH_SEED = 4_000_000
"""Seed offset of fresh behaviour of a task, for comparison with generated behaviour, independent of training data."""


def generator(device: torch.device | str, *key: int) -> torch.Generator:
    """Random generator seeded by a key, for example ``(seed, step)``.

    Args:
        device: device of the generator.
        key: non-negative integers, which are mixed, since torch keeps 32 bits of a seed on CPUs.
    """
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    return torch.Generator(device=device).manual_seed(seed)


def task_key(task: str) -> int:
    """Hash of a task for a key: equal on every machine, and collisions are rare."""
    return zlib.crc32(task.encode())


@dataclass
class _Rows:
    """Rows of process ``rank`` of ``world``."""

    rank: int = 0
    world: int = 1


_ROWS = _Rows()
"""Not a context variable, which compiled networks cannot read."""


@contextmanager
def rows_of(rank: int, world: int) -> Iterator[None]:
    """Draw and average over the batch of all processes within the block.

    Args:
        rank: rank of this process.
        world: number of processes.
    """
    before = _ROWS.rank, _ROWS.world
    _ROWS.rank, _ROWS.world = rank, world
    try:
        yield
    finally:
        _ROWS.rank, _ROWS.world = before


def drawn(count: int, draw: Callable[[int], Tensor]) -> Tensor:
    """Random numbers of this process's rows ``(count, ...)``.

    Args:
        count: number of this process's rows.
        draw: called with the total number of rows; returns as many.
    """
    if _ROWS.world == 1:
        return draw(count)
    return draw(count * _ROWS.world)[_ROWS.rank :: _ROWS.world]


def mean(value: Tensor) -> Tensor:
    """Mean over all processes, without a gradient; with a single process the value itself."""
    if _ROWS.world == 1:
        return value
    total = value.detach().clone()
    distributed.all_reduce(total)
    return total / _ROWS.world


class Dropout(nn.Dropout):
    """Dropout with the mask of the batch of all processes."""

    def forward(self, input: Tensor) -> Tensor:
        """Apply dropout to ``(batch, ...)``."""
        if _ROWS.world == 1 or not self.training:
            return super().forward(input)
        return input * drawn(len(input), lambda count: functional.dropout(input.new_ones(count, *input.shape[1:]), self.p))
