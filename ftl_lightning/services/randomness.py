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
    """Random generator seeded by a key of non-negative integers, for example ``(seed, step)``.

    The integers are mixed, since torch keeps 32 bits of a seed on CPUs.
    """
    seed = int(np.random.SeedSequence(key).generate_state(1)[0])
    return torch.Generator(device=device).manual_seed(seed)


def task_key(task: str) -> int:
    """Hash of a task for a key: equal on every machine, and collisions are rare."""
    return zlib.crc32(task.encode())


@dataclass
class _Rows:
    """Share of the joint batch: rows of process ``rank`` of ``world``."""

    rank: int = 0
    world: int = 1


_ROWS = _Rows()
"""Not a context variable, which compiled networks cannot read."""


@contextmanager
def rows_of(rank: int, world: int) -> Iterator[None]:
    """Within the block, draw and average over the joint batch of ``world`` processes, of which this is number ``rank``."""
    before = _ROWS.rank, _ROWS.world
    _ROWS.rank, _ROWS.world = rank, world
    try:
        yield
    finally:
        _ROWS.rank, _ROWS.world = before


def drawn(count: int, draw: Callable[[int], Tensor]) -> Tensor:
    """Random numbers of this process's rows ``(count, ...)``; ``draw`` maps the total number of rows to as many numbers."""
    return draw(count) if _ROWS.world == 1 else draw(count * _ROWS.world)[_ROWS.rank :: _ROWS.world]


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
