"""A batch split over several processes, with the random numbers of a single process.

Process r of n has rows r, r + n, r + 2n and so on, so that earlier repetition of rows does not matter. Outside of :func:`rows_of`
there is a single process.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from torch import Tensor, distributed, nn
from torch.nn import functional


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
